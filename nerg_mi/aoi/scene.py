"""The scene of a count: areas as what rays meet, surfaces and observers around them, changes to both, and cohorts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.errors import NergError, translate_mitsuba_errors, sanitize
from nerg_mi.files.safe_read import read_json
from nerg_mi.files.tables import unescape_formula
from nerg_mi.formats.areas import (
    Area,
    AreaEntry,
    AreaGroup,
    AreaSet,
    MeshPart,
    Region,
    SceneShape,
    check_area_name,
    is_number,
    resolve_mesh_path,
    parse_box,
)
from nerg_mi.formats.fields import load_gaze
from nerg_mi.formats.meshes import MeshFile, read_mesh_file
from nerg_mi.maths.geometry import Similarity, intersect_box_numpy
from nerg_mi.maths.types import variant_types
from nerg_mi.ranges import COORDINATES
from nerg_mi.rays.readers.tables import iterate_table
from nerg_mi.rendering.bands import is_nerg
from nerg_mi.rendering.scene import load_scene
from nerg_mi.statistics.shares import DirectionQuery
from nerg_mi.statistics.visits import Aoi, BoxAoi
from nerg_mi.surfaces.mesh import mitsuba_mesh
from nerg_mi.train import geometry
from nerg_mi.train.gaze_data import SURFACE_OPACITY
from nerg_mi.train.geometry import TrainingGeometry
from nerg_mi.transport.geometry import SceneGeometry, shape_corners, default_march_settings, trace_depth
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.observer_gaze import GazeFieldInstance, make_gaze_evaluator
from nerg_mi.workflows.gaze_commands import GazeEvaluationOptions
from nerg_mi.workflows.geometry import read_training_alignment, load_training_geometry

if TYPE_CHECKING:
    import mitsuba as mi


# ---- Which cohort people are of, from a table ----

MOST_PEOPLE = 10_000_000  # so many people may have a cohort


def read_cohorts(path: Path) -> dict[str, str]:
    """The cohort of each person, from the columns ``person`` and ``cohort`` of a CSV. Raises `NergError` for a table
    without them, and for somebody who is of two."""
    found: dict[str, str] = {}
    for block in iterate_table(path, (), ("person", "cohort")):
        for person, cohort in (map(unescape_formula, row) for row in block.texts.tolist()):
            if found.setdefault(person, cohort) != cohort:
                raise NergError(f'"{path}" has "{sanitize(person, 40)}" in two cohorts; leave one')
        if len(found) > MOST_PEOPLE:
            raise NergError(f'"{path}" names more than {MOST_PEOPLE:,} people; give fewer')
    if not found:
        raise NergError(f'"{path}" names nobody; write a line person,cohort and one for each')
    return found


# ---- Surroundings ----
#
# What people have around them: surfaces that rays meet, and the gaze that a field foretells there.


@dataclass(frozen=True, eq=False)
class GazeScene:
    """``place``: what rays meet, None where nothing is known; ``gaze`` of a field, or None; ``align``: from the rays'
    frame; ``scene``: whose shapes they are, or None; ``observer`` (3,): the scene's own; ``kind`` of depth."""

    geometry: SceneGeometry | None
    gaze: GazeFieldInstance | None
    align: Similarity
    scene: mi.Scene | None = None
    settings: ObserverSettings | None = None
    observer: np.ndarray | None = None
    depth_kind: str = "median"

    @property
    def scale(self) -> float:
        """Units of the place a metre."""
        return float(self.align.scale)

    def transform_points(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of the rays' frame in the place."""
        return points @ self.align.matrix[:3, :3].T + self.align.matrix[:3, 3]

    def transform_directions(self, directions: np.ndarray) -> np.ndarray:
        """Unit directions (..., 3) of the rays' frame in the place."""
        return directions @ (self.align.matrix[:3, :3] / self.scale).T

    def trace_depth(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Distance (N,) to the first surface along rays (N, 3) of the place, infinite where there is none."""
        if self.geometry is None:
            return np.full(len(o), np.inf)
        depth, opacity = trace_depth(self.geometry, o, d, kind=self.depth_kind)
        return np.where((opacity >= SURFACE_OPACITY) & (depth > 0), depth, np.inf).astype(np.float64)

    def query_from(self, observer: np.ndarray) -> DirectionQuery:
        """A function of unit directions (D, 3), as `nerg_mi.statistics.shares.gaze_shares` wants it of an observer at
        ``eye`` (3,)."""
        assert self.gaze is not None
        place = self.geometry if self.geometry is not None else SceneGeometry(None)
        settings = self.settings or ObserverSettings(
            march=default_march_settings(place), depth=self.depth_kind, surface_opacity=SURFACE_OPACITY
        )
        look = make_gaze_evaluator(self.gaze, place, settings, observer)
        if self.geometry is not None:
            return look
        return lambda directions: (look(directions)[0], None)

    def support_at(self, observer: np.ndarray) -> float:
        """Rays that the field learnt from around ``eye`` (3,); NaN where it does not say."""
        mi = variant_types()
        if self.gaze is None or self.gaze.field.support is None:
            return float("nan")
        p = self.gaze.to_world.point_to_local(mi.Point3f(*np.asarray(observer, float).tolist()))
        return float(np.array(self.gaze.field.support.evaluate(p)).ravel()[0])

    def bounds(self) -> np.ndarray:
        """Corners (2, 3) of the place. Raises `NergError` where none is known."""
        bounds = None if self.geometry is None else self.geometry.bounds()
        if bounds is None:
            raise NergError("there is no place whose bounds are known; give a scene or a radiance field")
        return np.array(bounds, float)

    def with_scene(self, scene: mi.Scene) -> GazeScene:
        """The same with the shapes of another ``scene``."""
        assert self.geometry is not None
        return replace(self, geometry=SceneGeometry(self.geometry.medium, scene), scene=scene)


def load_scene_file(path: Path, gaze: Path | None, align: Similarity | None, ns: ModuleType) -> GazeScene:
    """A scene's shapes, and the field and gaze of its integrator where that is a ``nerg``; ``gaze``: another gaze field
    in their stead. Raises `NergError` for a scene with neither shapes nor a field."""
    from nerg_mi.transport.observer import sensor_center

    scene = load_scene(path, merge=False)
    integrator: Any = scene.integrator()
    own = is_nerg(integrator)
    medium = integrator.medium if own else None
    place = SceneGeometry(medium, scene)
    if medium is None and place.scene is None:
        raise NergError(f'the scene "{path}" has neither shapes nor a field; name one that has')
    sensor = integrator.observer if own else None
    observer = None if sensor is None else np.ravel(np.array(sensor_center(sensor), np.float64))
    if gaze is not None:
        field, about = load_gaze(gaze, ns)
        provenance = about.get("provenance", about)
        return GazeScene(place, GazeFieldInstance(field), align or read_training_alignment(provenance), scene, observer=observer)
    settings = integrator.observer_settings if own and integrator.gaze is not None else None
    found = integrator.gaze if own else None
    return GazeScene(place, found, align or Similarity(), scene, settings, observer)


def surroundings_of_files(
    scene: Path | None, field: Path | None, gaze: Path | None, align: Similarity | None, ns: ModuleType
) -> GazeScene:
    """What the files that are given say. Raises `NergError` for those that cannot be used together."""
    if scene is not None:
        if field is not None:
            raise NergError(f'"{scene}" and "{field}" are both a place; a scene names its field itself')
        return load_scene_file(scene, gaze, align, ns)
    if gaze is not None:
        network, about = load_gaze(gaze, ns)
        options = GazeEvaluationOptions(field=field)
        made = load_training_geometry(gaze, about.get("provenance", about), network.box, options, ns)
        return _of_place(made, GazeFieldInstance(network), align or made.align)
    if field is not None:
        return _of_place(geometry.load_field_geometry(field, ns), None, align or Similarity())
    return GazeScene(None, None, align or Similarity())


def _of_place(place: TrainingGeometry, gaze: GazeFieldInstance | None, align: Similarity) -> GazeScene:
    medium = place.medium
    inside = medium if isinstance(medium, SceneGeometry) or medium is None else SceneGeometry(medium)
    return GazeScene(inside, gaze, align, None if inside is None else inside.scene)


# ---- Things ----
#
# Areas of interest as things that rays meet: boxes in closed form, meshes and shapes by ray casts of Mitsuba.

_RAYS = 1 << 20


@dataclass(frozen=True, eq=False)
class ShapeAoi:
    """A Mitsuba shape, of the scene or by itself."""

    name: str
    shape: Any
    alone: Any
    is_surface = True

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
        lower, upper = (np.array(c, np.float64) for c in shape_corners(self.shape))
        room = 1e-6 * np.maximum(np.abs([lower, upper]).max(), np.linalg.norm(upper - lower))
        return np.array([lower - room, upper + room])

    @property
    def ball(self) -> tuple[np.ndarray, float]:
        lower, upper = self._corners
        return (lower + upper) / 2, float(np.linalg.norm(upper - lower)) / 2

    def may_meet(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        near, far = intersect_box_numpy(o, d, *self._corners)
        return (near < far) & (far > 0)

    def sample_points(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        import mitsuba as mi

        # The R2 sequence (Roberts 2018): points that are spread evenly, whatever their number.
        n = np.arange(1, count + 1)
        u, v = (np.mod(0.5 + n / g, 1.0) for g in (1.32471795724474602596, 1.32471795724474602596**2))
        found = self.shape.sample_position(0.0, mi.Point2f(u.astype(np.float32), v.astype(np.float32)))
        points = np.array(found.p, np.float64).T
        return points, np.zeros_like(points)


def read_meshes(files: Iterable[Path]) -> dict[Path, MeshFile]:
    """The meshes in ``files``, each read once. Raises `NergError` for a file that is missing or damaged."""
    return {file: read_mesh_file(file) for file in dict.fromkeys(files)}


def make_aois(
    areas: Sequence[Region | MeshPart | SceneShape], shapes: Mapping[str, Any], meshes: Mapping[Path, MeshFile]
) -> list[Aoi]:
    """``areas`` as things, in their order; ``shapes`` of the scene by name, ``meshes`` of parts by file; the variant
    must be active. Raises `NergError` for shapes and faces that there are not."""
    found: list[Aoi] = []
    for area in areas:
        if isinstance(area, Region):
            found.append(BoxAoi(area))
        elif isinstance(area, MeshPart):
            found.append(thing_of_shape(area.name, _mesh_of_part(area, meshes[area.file])))
        else:
            found.append(thing_of_shape(area.name, shape_named(shapes, area.shape)))
    return found


def thing_of_shape(name: str, shape: Any) -> ShapeAoi:
    """A Mitsuba shape as a thing."""
    return ShapeAoi(name, shape, scene_from_shapes({name: shape}))


def scene_from_shapes(shapes: Mapping[str, Any]) -> mi.Scene:
    """A scene of nothing but ``shapes``, which keep the names that they have: Mitsuba gives them others."""
    import mitsuba as mi

    names = [shape.id() for shape in shapes.values()]
    with translate_mitsuba_errors():
        made = {f"shape_{k}": shape for k, shape in enumerate(shapes.values())}
        scene = mi.load_dict({"type": "scene", **made}, optimize=False)
    for shape, name in zip(shapes.values(), names):
        shape.set_id(name)
    return scene


def shapes_by_id(scene: mi.Scene | None) -> dict[str, Any]:
    """The shapes of a scene by their ids."""
    return {} if scene is None else {shape.id(): shape for shape in scene.shapes()}


def shape_named(shapes: Mapping[str, Any], name: str) -> Any:
    """The shape of this name. Raises `NergError` where there is none, naming those that there are."""
    if name not in shapes:
        known = f"it has {', '.join(list(shapes)[:20])}" if shapes else "give a scene that has shapes"
        raise NergError(f'there is no shape "{sanitize(name, 40)}" in the scene; {known}')
    return shapes[name]


def _mesh_of_part(part: MeshPart, mesh: MeshFile) -> Any:
    """The faces of a part alone, which are numbered as in the file of its ``mesh``."""
    chosen = mesh.faces[part.select_faces(int(mesh.polygons.max()) + 1)[mesh.polygons]]
    used, index = np.unique(chosen, return_inverse=True)
    return mitsuba_mesh(mesh.vertices[used], index.reshape(-1, 3), part.name)


# ---- Changes ----
#
# What if: a file of changes to a scene and its observers, read and made.
#
# .. code-block:: json
#
#     {"move": [{"shape": "sign", "by": [0.5, 0, 0], "turn": 90}, {"area": "shelf", "by": [0, 1, 0]}],
#      "remove": ["stand"], "add": [{"name": "poster", "min": [1, 0, 1], "max": [2, 0.1, 2]}],
#      "swap": [{"shape": "till", "mesh": "till2.ply"}],
#      "observers": [[1, 2, 1.6]], "shift": [0, 0, -0.2]}
#
# A turn is in degrees about the vertical through the middle of what is moved, counter-clockwise seen from above. Moved
# shapes keep the areas that name them; boxes, which name no shape, are moved as areas. The gaze field stays as it was
# trained: it knows places and what stood there, and says of a thing at its new place what it learnt of surfaces there.

MAX_CHANGES_BYTES = 1 << 20  # a file of changes may have so many bytes
MOST_CHANGES = 1000  # and so many changes, or observers, of a kind
_KEYS = ("move", "remove", "add", "swap", "observers", "shift")
_EXAMPLE = '{"move": [{"shape": "sign", "by": [0.5, 0, 0]}], "remove": ["stand"]}'


@dataclass(frozen=True)
class Move:
    """Of a shape, or, if not, an area: first turned by degrees about its middle's vertical, then moved ``by``."""

    name: str
    is_shape: bool
    offset: tuple[float, float, float]
    rotation_degrees: float


@dataclass(frozen=True)
class NewShape:
    """What is added, or stands in place of the shape of its name: a box or a mesh."""

    name: str
    geometry: Region | Path


@dataclass(frozen=True)
class Changes:
    """All changes; ``observers`` (M, 3) in place of those that there were, or None; ``shift`` of these (3,)."""

    move: tuple[Move, ...] = ()
    remove: tuple[str, ...] = ()
    add: tuple[NewShape, ...] = ()
    swap: tuple[NewShape, ...] = ()
    observers: np.ndarray | None = None
    shift: np.ndarray | None = None

    @property
    def meshes(self) -> list[Path]:
        """Files of what is added or swapped."""
        return [put.geometry for put in (*self.add, *self.swap) if isinstance(put.geometry, Path)]

    @property
    def of_shapes(self) -> bool:
        """Whether the scene is another one."""
        return bool(self.remove or self.add or self.swap or any(m.is_shape for m in self.move))


def read_changes(path: str | Path) -> Changes:
    """The changes of a JSON file. Raises `NergError` for what is none of them."""
    path = Path(path)
    found = read_json(path, "file of changes", MAX_CHANGES_BYTES)
    unknown = next((k for k in found if k not in _KEYS), None) if isinstance(found, dict) else ""
    if not isinstance(found, dict) or not found or unknown is not None:
        said = "" if not unknown else f'; "{sanitize(unknown, 40)}" is none of {", ".join(_KEYS)}'
        raise NergError(f'"{path}" holds no changes; write {_EXAMPLE}{said}')
    try:
        listed = {key: _listed(found, key) for key in _KEYS[:5]}
        observers = listed["observers"]
        return Changes(
            tuple(_move(one) for one in listed["move"]),
            tuple(_word(one, "remove") for one in listed["remove"]),
            tuple(_put(one, "name", path) for one in listed["add"]),
            tuple(_put(one, "shape", path) for one in listed["swap"]),
            np.array([_three(one, "observers") for one in observers]) if observers else None,
            np.array(_three(found["shift"], "shift")) if "shift" in found else None,
        )
    except NergError as error:
        raise NergError(f'"{path}": {error}') from error


def files_of_changes(path: str | Path, changes: Changes) -> list[Path]:
    """The files that ``changes`` were read from: the ``path`` and its meshes."""
    return list(dict.fromkeys([Path(path), *changes.meshes]))


def _listed(found: dict[str, Any], key: str) -> list[Any]:
    given = found.get(key, [])
    if not isinstance(given, list) or len(given) > MOST_CHANGES or (key in found and not given):
        raise NergError(f'"{key}" is a list of 1 to {MOST_CHANGES}, as in {_EXAMPLE}')
    return given


def _move(given: Any) -> Move:
    keys = [k for k in ("shape", "area") if isinstance(given, dict) and k in given]
    if len(keys) != 1 or set(given) - {keys[0], "by", "turn"}:
        raise NergError(f'a "move" names a "shape" or an "area", "by" what, and a "turn" in degrees, as in {_EXAMPLE}')
    turn = given.get("turn", 0)
    if not is_number(turn) or not abs(turn) <= 1e6:
        raise NergError('a "turn" must be in degrees')
    by = _three(given.get("by", [0, 0, 0]), "by")
    return Move(_word(given[keys[0]], keys[0]), keys[0] == "shape", by, float(turn))


def _put(given: Any, key: str, path: Path) -> NewShape:
    if not isinstance(given, dict) or not isinstance(given.get(key), str):
        raise NergError(f'what is added has a "name", and what is swapped a "shape", as in {_EXAMPLE}')
    name = _word(given[key], key)
    check_area_name(name)
    if "mesh" not in given:
        return NewShape(name, parse_box(AreaEntry(name, given, f'"{sanitize(name, 40)}"')))
    return NewShape(name, resolve_mesh_path(given["mesh"], path, "changes"))


def _word(given: Any, what: str) -> str:
    if not isinstance(given, str) or not 0 < len(given) <= 1000 or "\0" in given:
        raise NergError(f'"{what}" is a name, as in {_EXAMPLE}')
    return given


def _three(given: Any, what: str) -> tuple[float, float, float]:
    numbers = isinstance(given, list) and len(given) == 3 and all(is_number(v) for v in given)
    if not numbers or not all(v in COORDINATES for v in given):
        raise NergError(f'"{what}" is three numbers x, y, z of {COORDINATES}')
    return float(given[0]), float(given[1]), float(given[2])


def apply_to_areas(areas: AreaSet, changes: Changes) -> AreaSet:
    """The areas after the changes: without those of shapes that are gone, boxes moved, and one for each shape that was
    added and has none. Raises `NergError` for an area to be moved that there is not, or is no box."""
    found: dict[str, Area] = {area.name: area for area in areas.areas}
    for move in changes.move:
        if move.is_shape:
            continue
        area = found.get(move.name)
        if not isinstance(area, Region):
            what = "is no box, and moves with its shape" if area is not None else "is none of the areas"
            raise NergError(f'"{sanitize(move.name, 40)}" cannot be moved as an area: it {what}')
        found[move.name] = _moved(area, move)
    for put in changes.add:
        found.setdefault(put.name, SceneShape(put.name, put.name))
    # Areas of what is removed go, and groups with them that have nothing else.
    lost = {a.name for a in found.values() if isinstance(a, SceneShape) and a.shape in changes.remove}
    rest: list[Area] = []
    for area in found.values():
        if isinstance(area, AreaGroup):
            parts = tuple(p for p in area.parts if p not in lost)
            lost |= set() if parts else {area.name}
            area = AreaGroup(area.name, parts)
        if area.name not in lost:
            rest.append(area)
    return AreaSet(tuple(rest))


def _moved(box: Region, move: Move) -> Region:
    from scipy.spatial.transform import Rotation

    about = Rotation.from_euler("z", move.rotation_degrees, degrees=True)
    turn = None if box.rotation is None and move.rotation_degrees == 0 else (about * Rotation.from_matrix(box.rotation_matrix)).as_quat()
    by = np.array(move.offset)
    return Region.create(box.name, np.array(box.lower) + by, np.array(box.upper) + by, turn)


def changed_scene(
    scene: mi.Scene | None, changes: Changes, meshes: Mapping[Path, MeshFile]
) -> tuple[mi.Scene, dict[str, Any]]:
    """Another scene with the changed shapes, which has those that stay in common with ``scene``, and all of its shapes
    by name; ``meshes`` of what is added, by file. Raises `NergError` for shapes that there are not, or cannot be
    moved."""
    if scene is None:
        raise NergError("shapes are changed in a scene; give one (.xml), since a trained field cannot be taken apart")
    kept = shapes_by_id(scene)
    gone = {*changes.remove, *(put.name for put in changes.swap)}
    for name in gone:
        shape_named(kept, name)
    for name in gone:
        del kept[name]
    for move in changes.move:
        if move.is_shape:
            if move.name in gone:
                raise NergError(f'the shape "{sanitize(move.name, 40)}" is moved and taken away; do one of them')
            kept[move.name] = _moved_shape(shape_named(kept, move.name), move)
    for put in (*changes.add, *changes.swap):
        if put.name in kept:
            raise NergError(f'there is a shape "{sanitize(put.name, 40)}" already; "swap" it, or choose another name')
        kept[put.name] = _made(put, meshes)
    if not kept:
        raise NergError("no shape is left; leave one at least")
    return scene_from_shapes(kept), kept


def _moved_shape(shape: Any, move: Move) -> Any:
    import mitsuba as mi

    if not shape.is_mesh():
        raise NergError(f'the shape "{sanitize(move.name, 40)}" is no mesh, and only meshes are moved; "swap" it for one')
    params: Any = mi.traverse(shape)
    vertices = np.array(params["vertex_positions"], np.float64).reshape(-1, 3)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    c, s = np.cos(np.radians(move.rotation_degrees)), np.sin(np.radians(move.rotation_degrees))
    turned = (vertices - middle) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + middle + move.offset
    return mitsuba_mesh(turned, np.array(params["faces"]).reshape(-1, 3), move.name)


def _made(put: NewShape, meshes: Mapping[Path, MeshFile]) -> Any:
    if isinstance(put.geometry, Path):
        mesh = meshes[put.geometry]
        return mitsuba_mesh(mesh.vertices, mesh.faces, put.name)
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
    return mitsuba_mesh(put.geometry.vertices, np.array(faces), put.name)
