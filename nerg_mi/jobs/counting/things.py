"""Areas of interest as things that rays meet: boxes in closed form, meshes and shapes by ray casts of Mitsuba."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.errors import NergError, mitsuba_says, plain
from nerg_mi.formats.areas.kinds import MeshPart, SceneShape
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.regions import Region
from nerg_mi.maths.geometry import box_interval
from nerg_mi.statistics.visits import Box, Thing
from nerg_mi.surfaces.mesh import mitsuba_mesh
from nerg_mi.transport.place import corners_of

if TYPE_CHECKING:
    import mitsuba as mi

_RAYS = 1 << 20


@dataclass(frozen=True, eq=False)
class ShapeThing:
    """A Mitsuba shape, of the scene or by itself."""

    name: str
    shape: Any
    alone: Any
    open = True

    def interval(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        import mitsuba as mi

        out = np.full(len(o), np.inf)
        for a in range(0, len(o), _RAYS):
            origin, along = (np.ascontiguousarray(v[a : a + _RAYS].T, np.float32) for v in (o, d))
            ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(along))
            found = np.array(self.alone.ray_intersect_preliminary(ray, coherent=False).t, np.float64)
            out[a : a + _RAYS] = found
        return out, out

    @cached_property
    def _corners(self) -> np.ndarray:
        """Corners (2, 3) of a box around it that is no flatter than single precision is exact."""
        lower, upper = (np.array(c, np.float64) for c in corners_of(self.shape))
        room = 1e-6 * np.maximum(np.abs([lower, upper]).max(), np.linalg.norm(upper - lower))
        return np.array([lower - room, upper + room])

    @property
    def ball(self) -> tuple[np.ndarray, float]:
        lower, upper = self._corners
        return (lower + upper) / 2, float(np.linalg.norm(upper - lower)) / 2

    def may_meet(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        near, far = box_interval(o, d, *self._corners)
        return (near < far) & (far > 0)

    def samples(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        import mitsuba as mi

        # The R2 sequence (Roberts 2018): points that are spread evenly, whatever their number.
        n = np.arange(1, count + 1)
        u, v = (np.mod(0.5 + n / g, 1.0) for g in (1.32471795724474602596, 1.32471795724474602596**2))
        found = self.shape.sample_position(0.0, mi.Point2f(u.astype(np.float32), v.astype(np.float32)))
        points = np.array(found.p, np.float64).T
        return points, np.zeros_like(points)


def things_of(areas: Sequence[Region | MeshPart | SceneShape], shapes: Mapping[str, Any]) -> list[Thing]:
    """``areas`` as things, in their order; ``shapes`` of the scene by name; the variant must be active. Raises
    `NergError` for shapes that there are not, and for meshes that cannot be read."""
    found: list[Thing] = []
    for area in areas:
        if isinstance(area, Region):
            found.append(Box(area))
        elif isinstance(area, MeshPart):
            found.append(thing_of_shape(area.name, load_mesh(area)))
        else:
            found.append(thing_of_shape(area.name, shape_named(shapes, area.shape)))
    return found


def thing_of_shape(name: str, shape: Any) -> ShapeThing:
    """A Mitsuba shape as a thing."""
    return ShapeThing(name, shape, scene_of({name: shape}))


def scene_of(shapes: Mapping[str, Any]) -> mi.Scene:
    """A scene of nothing but ``shapes``, which keep the names that they have: Mitsuba gives them others."""
    import mitsuba as mi

    names = [shape.id() for shape in shapes.values()]
    with mitsuba_says():
        made = {f"shape_{k}": shape for k, shape in enumerate(shapes.values())}
        scene = mi.load_dict({"type": "scene", **made}, optimize=False)
    for shape, name in zip(shapes.values(), names):
        shape.set_id(name)
    return scene


def shapes_of(scene: mi.Scene | None) -> dict[str, Any]:
    """The shapes of a scene by their ids."""
    return {} if scene is None else {shape.id(): shape for shape in scene.shapes()}


def shape_named(shapes: Mapping[str, Any], name: str) -> Any:
    """The shape of this name. Raises `NergError` where there is none, naming those that there are."""
    if name not in shapes:
        known = f"it has {', '.join(list(shapes)[:20])}" if shapes else "give a scene that has shapes"
        raise NergError(f'there is no shape "{plain(name, 40)}" in the scene; {known}')
    return shapes[name]


def load_mesh(part: MeshPart) -> Any:
    """The mesh of a part, with its faces alone, which are those of the file. Raises `NergError` for a file that is
    missing or damaged."""
    mesh = read_mesh_file(part.file)
    chosen = mesh.faces[part.chosen(int(mesh.polygons.max()) + 1)[mesh.polygons]]
    used, index = np.unique(chosen, return_inverse=True)
    return mitsuba_mesh(mesh.vertices[used], index.reshape(-1, 3), part.name)
