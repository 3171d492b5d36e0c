"""What-if changes of shapes, areas and observers.

A JSON file of changes may have these keys. Lengths are in scene units:

- ``move``: translate a ``shape`` of the scene (its id) or an ``area`` (the name of a box) by the vector ``by``,
  after turning it by ``turn`` degrees about the vertical axis through its centre, counter-clockwise seen from above.
  AOIs that refer to a shape move with it. Only shapes that are meshes can be moved; others can be swapped for a
  mesh. A radiance field has no shapes, so nothing in it can be moved or removed.
- ``remove``: ids of shapes. AOIs that refer to them are removed, too.
- ``add``: new shapes, each with a ``name`` and either the corners ``min`` and ``max`` of a box (and a ``turn``) or a
  ``mesh`` file. Each becomes an AOI, unless an AOI has its name.
- ``swap``: shapes to replace; ``shape`` is the id, and the new shape is described as in ``add``.
- ``observers``: positions of the observers after the change, in place of the recorded ones.
- ``shift``: a vector that is added to the positions of all observers after the change.

The gaze field is not trained again: it predicts the gaze on surfaces at the new position from what it learnt there.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import read_json
from nerg_mi.files.values import normalize_name
from nerg_mi.formats.boxes import AreaEntry, Region, check_area_name, is_number, parse_box
from nerg_mi.formats.meshes import MeshFile
from nerg_mi.ranges import COORDINATES
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.mitsuba_mesh import make_mesh, read_triangles

from .areas import Area, AreaGroup, Areas, SceneShape, resolve_mesh_path, to_json_values
from .placed import PlacedAreas, find_shape, place_areas, read_meshes, scene_from_shapes

MAX_CHANGES_BYTES = 1 << 20  # maximum size of a file of changes
MAX_CHANGES = 1000  # maximum number of changes of each kind, and of observers
_CHANGE_KEYS = ("move", "remove", "add", "swap", "observers", "shift")
_EXAMPLE = '{"move": [{"shape": "sign", "by": [0.5, 0, 0]}], "remove": ["stand"]}'


@dataclass(frozen=True)
class Move:
    """Move a shape (or an area): rotate it about the vertical axis through its centre, then translate it."""

    name: str
    is_shape: bool
    offset: tuple[float, float, float]
    rotation_degrees: float


@dataclass(frozen=True)
class NewShape:
    """A box or a mesh that is added, or that replaces the shape of the same name."""

    name: str
    geometry: Region | Path


@dataclass(frozen=True)
class Changes:
    """All changes; ``observers`` (M, 3) replace the recorded ones, ``shift`` (3,) translates them."""

    move: tuple[Move, ...] = ()
    remove: tuple[str, ...] = ()
    add: tuple[NewShape, ...] = ()
    swap: tuple[NewShape, ...] = ()
    observers: np.ndarray | None = None
    shift: np.ndarray | None = None

    @property
    def meshes(self) -> list[Path]:
        """Files of the added and replacement meshes."""
        return [put.geometry for put in (*self.add, *self.swap) if isinstance(put.geometry, Path)]

    @property
    def changes_shapes(self) -> bool:
        """Whether the shapes of the scene change."""
        return bool(self.remove or self.add or self.swap or any(m.is_shape for m in self.move))


def open_changes(changes: Any) -> Changes:
    """Return changes: those of a JSON file, or of a dict as in one. Raises `NergError` for invalid ones."""
    if isinstance(changes, (str, os.PathLike)):
        return read_changes(Path(changes))
    return _parse_changes(to_json_values(changes), Path("changes"), "the dict of changes")


def read_changes(path: str | Path) -> Changes:
    """Read changes from a JSON file. Raises `NergError` for invalid files."""
    return _parse_changes(read_json(path, "file of changes", MAX_CHANGES_BYTES), Path(path), f'"{path}"')


def _parse_changes(data: Any, path: Path, source: str) -> Changes:
    """Parse the content of a file of changes; meshes are in the folder of ``path``."""
    unknown = next((k for k in data if k not in _CHANGE_KEYS), None) if isinstance(data, dict) else ""
    if not isinstance(data, dict) or not data or unknown is not None:
        detail = "" if not unknown else f'; "{sanitize(unknown, 40)}" is not one of {", ".join(_CHANGE_KEYS)}'
        raise NergError(f"{source} contains no valid changes; write {_EXAMPLE}{detail}")
    try:
        lists = {key: _get_list(data, key) for key in _CHANGE_KEYS[:5]}
        observers = lists["observers"]
        return Changes(
            tuple(_parse_move(entry) for entry in lists["move"]),
            tuple(_parse_name(entry, "remove") for entry in lists["remove"]),
            tuple(_parse_new_shape(entry, "name", path) for entry in lists["add"]),
            tuple(_parse_new_shape(entry, "shape", path) for entry in lists["swap"]),
            np.array([_parse_vector(entry, "observers") for entry in observers]) if observers else None,
            np.array(_parse_vector(data["shift"], "shift")) if "shift" in data else None,
        )
    except NergError as error:
        raise NergError(f"{source}: {error}") from error


def list_change_files(path: str | Path, changes: Changes) -> list[Path]:
    """Return the file of the changes and the files of its meshes."""
    return list(dict.fromkeys([Path(path), *changes.meshes]))


def _get_list(data: dict[str, Any], key: str) -> list[Any]:
    entries = data.get(key, [])
    if not isinstance(entries, list) or len(entries) > MAX_CHANGES or (key in data and not entries):
        raise NergError(f'"{key}" must be a list of 1 to {MAX_CHANGES}, as in {_EXAMPLE}')
    return entries


def _parse_move(entry: Any) -> Move:
    keys = [k for k in ("shape", "area") if isinstance(entry, dict) and k in entry]
    if len(keys) != 1 or set(entry) - {keys[0], "by", "turn"}:
        raise NergError(f'a "move" needs a "shape" or an "area", and "by" or a "turn" in degrees, as in {_EXAMPLE}')
    turn = entry.get("turn", 0)
    if not is_number(turn) or not abs(turn) <= 1e6:
        raise NergError('a "turn" must be a number of degrees up to 1e6')
    offset = _parse_vector(entry.get("by", [0, 0, 0]), "by")
    return Move(_parse_name(entry[keys[0]], keys[0]), keys[0] == "shape", offset, float(turn))


def _parse_new_shape(entry: Any, key: str, path: Path) -> NewShape:
    if not isinstance(entry, dict) or not isinstance(entry.get(key), str):
        raise NergError(f'an entry of "add" needs a "name", and one of "swap" a "shape", as in {_EXAMPLE}')
    name = _parse_name(entry[key], key)
    check_area_name(name)
    if "mesh" not in entry:
        return NewShape(name, parse_box(AreaEntry(name, entry, f'"{sanitize(name, 40)}"')))
    return NewShape(name, resolve_mesh_path(entry["mesh"], path, "changes"))


def _parse_name(value: Any, key: str) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= 1000 or "\0" in value:
        raise NergError(f'"{key}" must be a name, as in {_EXAMPLE}')
    return normalize_name(value)


def _parse_vector(value: Any, key: str) -> tuple[float, float, float]:
    is_vector = isinstance(value, list) and len(value) == 3 and all(is_number(v) for v in value)
    if not is_vector or not all(v in COORDINATES for v in value):
        raise NergError(f'"{key}" must be three numbers x, y, z of {COORDINATES}')
    return float(value[0]), float(value[1]), float(value[2])


def apply_to_areas(areas: Areas, changes: Changes) -> Areas:
    """Apply changes to areas: drop areas of removed shapes, move boxes, and add an area for each added shape without
    one.

    Raises `NergError` if an area to be moved is unknown or not a box.
    """
    area_of: dict[str, Area] = {area.name: area for area in areas.areas}
    for move in changes.move:
        if move.is_shape:
            continue
        area = area_of.get(move.name)
        if not isinstance(area, Region):
            reason = "is not a box; move its shape" if area is not None else "is not in the file of areas"
            raise NergError(f'"{sanitize(move.name, 40)}" cannot be moved as an area: it {reason}')
        area_of[move.name] = _move_box(area, move)
    for put in changes.add:
        area_of.setdefault(put.name, SceneShape(put.name, put.name))
    # Remove areas of removed shapes, and groups that would become empty.
    removed = {a.name for a in area_of.values() if isinstance(a, SceneShape) and a.shape in changes.remove}
    remaining: list[Area] = []
    for area in area_of.values():
        if isinstance(area, AreaGroup):
            parts = tuple(p for p in area.parts if p not in removed)
            removed |= set() if parts else {area.name}
            area = AreaGroup(area.name, parts)
        if area.name not in removed:
            remaining.append(area)
    return Areas(tuple(remaining))


def _move_box(box: Region, move: Move) -> Region:
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_euler("z", move.rotation_degrees, degrees=True)
    turn = (
        None
        if box.rotation is None and move.rotation_degrees == 0
        else (rotation * Rotation.from_matrix(box.rotation_matrix)).as_quat()
    )
    offset = np.array(move.offset)
    return Region.create(box.name, np.array(box.lower) + offset, np.array(box.upper) + offset, turn)


def apply_to_shapes(shapes: Mapping[str, Any], changes: Changes, meshes: Mapping[Path, MeshFile]) -> dict[str, Any]:
    """Return the changed ``shapes`` by name; unchanged ones are the same objects.

    ``meshes`` are those of added shapes, by file. Raises `NergError` for shapes that are unknown or cannot be moved.
    """
    shapes = dict(shapes)
    removed = {*changes.remove, *(put.name for put in changes.swap)}
    for name in removed:
        find_shape(shapes, name)
    for name in removed:
        del shapes[name]
    for move in changes.move:
        if move.is_shape:
            if move.name in removed:
                raise NergError(
                    f'the shape "{sanitize(move.name, 40)}" is both moved and removed; remove one of the changes'
                )
            shapes[move.name] = _move_shape(find_shape(shapes, move.name), move)
    for put in (*changes.add, *changes.swap):
        if put.name in shapes:
            raise NergError(f'there already is a shape "{sanitize(put.name, 40)}"; "swap" it, or choose another name')
        shapes[put.name] = _make_shape(put, meshes)
    if not shapes:
        raise NergError("the changes remove all shapes; keep at least one")
    return shapes


def _move_shape(shape: Any, move: Move) -> Any:
    if not shape.is_mesh():
        raise NergError(
            f'the shape "{sanitize(move.name, 40)}" is not a mesh and cannot be moved; "swap" it for a mesh'
        )
    vertices, faces = read_triangles(shape)
    center = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    c, s = np.cos(np.radians(move.rotation_degrees)), np.sin(np.radians(move.rotation_degrees))
    moved = (vertices - center) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + center + move.offset
    return make_mesh(moved, faces, move.name)


def _make_shape(new_shape: NewShape, meshes: Mapping[Path, MeshFile]) -> Any:
    if isinstance(new_shape.geometry, Path):
        mesh = meshes[new_shape.geometry]
        return make_mesh(mesh.vertices, mesh.faces, new_shape.name)
    corner = lambda *bits: sum(b << k for k, b in enumerate(bits))
    faces = []
    for axis in range(3):
        u, v = (k for k in range(3) if k != axis)
        for side in (0, 1):
            at = [[0, 0, 0] for _ in range(4)]
            for n, (a, b) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
                at[n][axis], at[n][u], at[n][v] = side, a, b
            q = [corner(*bits) for bits in at]
            faces += [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]
    return make_mesh(new_shape.geometry.vertices, np.array(faces), new_shape.name)


def apply_changes(placed: PlacedAreas, changes: Changes) -> PlacedAreas:
    """Return areas and their environment after ``changes``. Raises `NergError` for invalid changes."""
    areas = apply_to_areas(placed.areas, changes)
    meshes = {**placed.meshes, **read_meshes(file for file in changes.meshes if file not in placed.meshes)}
    environment, sampler = placed.environment, placed.sampler
    if changes.changes_shapes:
        if not environment.shapes:
            raise NergError("changes of shapes need a scene (.xml), since a radiance field has no shapes")
        scene = scene_from_shapes(apply_to_shapes(environment.shapes, changes, meshes))
        geometry = SceneGeometry(environment.scene_geometry.medium, scene)
        environment = replace(environment, medium=geometry)
        sampler = None if sampler is None else replace(sampler, geometry=geometry)
    return place_areas(environment, sampler, areas, meshes, placed.sampling, placed.doubts)
