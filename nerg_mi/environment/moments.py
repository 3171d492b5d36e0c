"""Scenes at a moment: the shapes of loaded scenes where objects were at a time."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.values import normalize_name, to_name
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.transforms import transform_points
from nerg_mi.maths.types import variant_types
from nerg_mi.tracking.objects import ObjectPoses
from nerg_mi.transport.mitsuba_mesh import pack_positions, positions_key, unpack_positions

_ABSENT_SIZE = 1e-6  # of a shape that is absent and no mesh, relative to its own


@dataclass(frozen=True, eq=False)
class Moment:
    """Where objects were at a ``time`` in seconds: their ``poses`` for a participant, the similarity ``align`` from the
    frame of these to that of the scene, and the ``files`` that they are from."""

    poses: ObjectPoses
    time: float | None = None
    person: str = ""
    align: Similarity = field(default_factory=Similarity)
    files: tuple[Path, ...] = ()


class ShapeMover:
    """Moves shapes of a loaded ``scene`` in place."""

    def __init__(self, scene: Any):
        self._scene = scene
        self._shapes = {normalize_name(shape.id()): shape for shape in scene.shapes()}
        self._rest: dict[str, tuple[str, Any]] = {}

    def move(self, moment: Moment, time: float) -> list[str]:
        """Move shapes to where objects were at a time, and all others back to where the scene shows them.

        Objects that are absent, or whose pose is unknown, are shrunk to a point. Returns the names of the latter.
        Raises `NergError` if no object is a shape of the scene, and for a shape that cannot be moved.
        """
        import mitsuba as mi

        names = [name for name in moment.poses.names if name in self._shapes]
        if not names:
            raise NergError(
                f"no object of {parameter('objects')} is a shape of the scene: they are "
                f"{', '.join(moment.poses.names[:20])}, and its shapes are {', '.join(list(self._shapes)[:20])}"
            )
        params, unknown = mi.traverse(self._scene), list[str]()
        for name in names:
            if name not in self._rest:
                self._rest[name] = self._read_place(name, params)
        for name, (key, rest) in self._rest.items():
            matrix = np.eye(4)
            if name in names:
                motion = moment.poses.find_motion_at(name, time, to_name(moment.person)).in_frame(moment.align)
                unknown += [name] if motion.is_unknown[0] else []
                matrix[:3, :3], matrix[:3, 3] = motion.rotation[0], motion.translation[0]
                matrix = matrix if motion.is_present[0] else None
            params[key] = _move_points(rest, matrix) if key.endswith(positions_key()) else _move_frame(rest, matrix)
        params.update()
        return unknown

    def _read_place(self, name: str, params: Any) -> tuple[str, Any]:
        """Return the parameter of a shape with its place, and a copy of its value."""
        shape = self._shapes[name]
        key = next((key for p in (positions_key(), "to_world") if (key := f"{shape.id()}.{p}") in params), None)
        if key is None:
            raise NergError(
                f'the shape "{sanitize(name, 40)}" is a {shape.class_name()} and cannot be moved; replace it by a mesh'
            )
        return key, type(params[key])(params[key])


def _move_points(rest: Any, matrix: np.ndarray | None) -> Any:
    """Return positions of a mesh that are moved by a matrix; all of them at the first one without a matrix."""
    points = np.array(unpack_positions(rest), np.float64).T
    moved = np.repeat(points[:1], len(points), axis=0) if matrix is None else transform_points(matrix, points)
    return pack_positions(variant_types().Point3f(np.ascontiguousarray(moved.T, np.float32)))


def _move_frame(rest: Any, matrix: np.ndarray | None) -> Any:
    """Return the ``to_world`` of a shape that is moved by a matrix, or shrunk without one."""
    to_world = np.array(rest.matrix, np.float64).reshape(4, 4)
    if matrix is None:
        matrix = np.diag([_ABSENT_SIZE] * 3 + [1.0])
        matrix[:3, 3] = (1 - _ABSENT_SIZE) * to_world[:3, 3]
    return type(rest)((matrix @ to_world).tolist())
