"""Scene of AOI statistics: surfaces, gaze field, AOI geometry, what-if changes, and cohorts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError, sanitize, translate_mitsuba_errors
from nerg_mi.files.safe_read import read_json
from nerg_mi.files.tables import unescape_formula
from nerg_mi.files.values import normalize_name, to_name
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
    parse_box,
    resolve_mesh_path,
)
from nerg_mi.formats.fields import load_gaze
from nerg_mi.formats.meshes import MeshFile, read_mesh_file
from nerg_mi.maths.geometry import Similarity, intersect_box_numpy
from nerg_mi.maths.types import variant_types
from nerg_mi.measures.shares import DirectionQuery
from nerg_mi.measures.visits import Aoi, BoxAoi
from nerg_mi.ranges import COORDINATES
from nerg_mi.rays.readers.columns import open_named_table
from nerg_mi.rendering.bands import is_nerg
from nerg_mi.rendering.scene import load_scene
from nerg_mi.train.gaze_data import SURFACE_OPACITY
from nerg_mi.train.geometry_files import load_training_geometry, read_training_alignment
from nerg_mi.transport.extrapolation import describe_extrapolation
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings, shape_corners, trace_depth
from nerg_mi.transport.mitsuba_mesh import gather_corners, make_mesh, read_triangles
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.observer_gaze import GazeFieldInstance, make_gaze_evaluator

if TYPE_CHECKING:
    import mitsuba as mi


# ---- Cohorts ----

MAX_PARTICIPANTS = 10_000_000  # maximum number of participants in a table of cohorts


def read_cohorts(path: Path) -> dict[str, str]:
    """Read the cohort of each participant from a CSV file with columns ``person`` (or ``participant``) and ``cohort``.

    Rows without a name or a cohort, as at the end of many tables, are ignored. Raises `NergError` for missing columns,
    and for a participant in two cohorts.
    """
    cohorts: dict[str, str] = {}
    for block in open_named_table(path, (), ("person", "cohort"))[1]:
        for participant, cohort in (map(to_name, map(unescape_formula, row)) for row in block.texts.tolist()):
            if participant and cohort and cohorts.setdefault(participant, cohort) != cohort:
                raise NergError(f'"{path}" has "{sanitize(participant, 40)}" in two cohorts; remove one of them')
        if len(cohorts) > MAX_PARTICIPANTS:
            raise NergError(f'"{path}" names more than {MAX_PARTICIPANTS:,} participants; remove some')
    if not cohorts:
        raise NergError(
            f'"{path}" contains no participants; write the header person,cohort and one row per participant'
        )
    return cohorts


# ---- Scene and gaze field ----


@dataclass(frozen=True, eq=False)
class GazeScene:
    """Surfaces and gaze field of a scene.

    Parameters
    ----------
    geometry
        Surfaces that rays meet; None if unknown.
    gaze
        Gaze field, or None.
    align
        Similarity from the frame of the samples to the scene.
    scene
        Mitsuba scene with named shapes, or None.
    settings
        Settings of an observer's rays.
    observer
        Observer of the scene, (3,), or None.
    depth_kind
        Depth estimate of a ray in a medium.
    """

    geometry: SceneGeometry | None
    gaze: GazeFieldInstance | None
    align: Similarity
    scene: mi.Scene | None = None
    settings: ObserverSettings | None = None
    observer: np.ndarray | None = None
    depth_kind: str = "median"

    @property
    def scale(self) -> float:
        """Scene units per metre."""
        return float(self.align.scale)

    def transform_points(self, points: np.ndarray) -> np.ndarray:
        """Transform points (..., 3) from the frame of the samples to the scene."""
        return points @ self.align.matrix[:3, :3].T + self.align.matrix[:3, 3]

    def transform_directions(self, directions: np.ndarray) -> np.ndarray:
        """Rotate unit directions (..., 3) from the frame of the samples to the scene."""
        return directions @ (self.align.matrix[:3, :3] / self.scale).T

    def trace_depth(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Return the distance (N,) to the first surface on rays (N, 3), infinite if there is none."""
        if self.geometry is None:
            return np.full(len(o), np.inf)
        depth, opacity = trace_depth(self.geometry, o, d, kind=self.depth_kind)
        return np.where((opacity >= SURFACE_OPACITY) & (depth > 0), depth, np.inf).astype(np.float64)

    def query_from(self, observer: np.ndarray) -> DirectionQuery:
        """Return the `DirectionQuery` of an observer at a position (3,), as `gaze_shares` needs it."""
        assert self.gaze is not None
        geometry = self.geometry if self.geometry is not None else SceneGeometry(None)
        settings = self.settings or ObserverSettings(
            march=default_march_settings(geometry), depth=self.depth_kind, surface_opacity=SURFACE_OPACITY
        )
        query = make_gaze_evaluator(self.gaze, geometry, settings, observer)
        if self.geometry is not None:
            return query
        return lambda directions: (query(directions)[0], None)

    def support_at(self, observer: np.ndarray) -> float:
        """Return the number of training samples around a position (3,); NaN if the field does not contain it."""
        mi = variant_types()
        if self.gaze is None or self.gaze.field.support is None:
            return float("nan")
        p = self.gaze.to_world.point_to_local(mi.Point3f(*np.asarray(observer, float).tolist()))
        return float(np.array(self.gaze.field.support.evaluate(p)).ravel()[0])

    def describe_extrapolation(self, observers: np.ndarray) -> str:
        """Return a sentence on the ``observers`` (M, 3) whose values are extrapolated; "" if there are none."""
        return describe_extrapolation(self.geometry, self.gaze, observers)

    def bounds(self) -> np.ndarray:
        """Return the corners (2, 3) of the bounding box. Raises `NergError` if it is unknown."""
        bounds = None if self.geometry is None else self.geometry.bounds()
        if bounds is None:
            raise NergError("the bounds of the scene are unknown; give a scene or a radiance field")
        return np.array(bounds, float)

    def with_scene(self, scene: mi.Scene) -> GazeScene:
        """Return a copy with the shapes of another ``scene``."""
        assert self.geometry is not None
        return replace(self, geometry=SceneGeometry(self.geometry.medium, scene), scene=scene)


def load_scene_file(path: Path, gaze: Path | None, align: Similarity | None, ns: ModuleType) -> GazeScene:
    """Load the shapes of a scene file, and the fields of its integrator if it is a ``nerg``.

    ``gaze`` replaces the gaze field of the scene. Raises `NergError` for a scene without shapes and fields.
    """
    from nerg_mi.transport.observer import sensor_center

    scene = load_scene(path, merge=False)
    integrator: Any = scene.integrator()
    has_nerg = is_nerg(integrator)
    medium = integrator.medium if has_nerg else None
    geometry = SceneGeometry(medium, scene)
    if medium is None and geometry.scene is None:
        raise NergError(f'the scene "{path}" has neither shapes nor a radiance field; use another scene')
    sensor = integrator.observer if has_nerg else None
    observer = None if sensor is None else np.ravel(np.array(sensor_center(sensor), np.float64))
    if gaze is not None:
        field, metadata = load_gaze(gaze, ns)
        provenance = metadata.get("provenance", metadata)
        return GazeScene(
            geometry, GazeFieldInstance(field), align or read_training_alignment(provenance), scene, observer=observer
        )
    settings = integrator.observer_settings if has_nerg and integrator.gaze is not None else None
    gaze_field = integrator.gaze if has_nerg else None
    return GazeScene(geometry, gaze_field, align or Similarity(), scene, settings, observer)


def load_gaze_scene(
    scene: Path | None, field: Path | None, gaze: Path | None, align: Similarity | None, ns: ModuleType
) -> GazeScene:
    """Load a scene from the given files. Raises `NergError` for combinations that are not supported."""
    if scene is not None:
        if field is not None:
            raise NergError(
                f'"{scene}" and "{field}" both define the geometry; give the scene only, which refers to its field'
            )
        return load_scene_file(scene, gaze, align, ns)
    if gaze is not None:
        network, metadata = load_gaze(gaze, ns)
        provenance = metadata.get("provenance", metadata)
        training_geometry = load_training_geometry(gaze, provenance, network.box, field=field)
        return _gaze_scene_from_training(
            training_geometry, GazeFieldInstance(network), align or training_geometry.align
        )
    if field is not None:
        return _gaze_scene_from_training(Environment.open(field), None, align or Similarity())
    return GazeScene(None, None, align or Similarity())


def _gaze_scene_from_training(
    training_geometry: Environment, gaze: GazeFieldInstance | None, align: Similarity
) -> GazeScene:
    medium = training_geometry.medium
    geometry = medium if isinstance(medium, SceneGeometry) or medium is None else SceneGeometry(medium)
    return GazeScene(geometry, gaze, align, None if geometry is None else geometry.scene)


# ---- AOI geometry ----
#
# Boxes are intersected in closed form, meshes and shapes by ray casts in Mitsuba.

_RAY_BATCH = 1 << 20
_MIN_COSINE = 0.05  # limits the distance along a grazing ray that corresponds to the tolerance


@dataclass(frozen=True, eq=False)
class ShapeAoi:
    """A Mitsuba shape as an AOI.

    Parameters
    ----------
    name
        Name of the area.
    shape
        The shape.
    isolated
        Scene that contains only this shape.
    scene
        Scene that contains the shape, whose other shapes occlude it: each ray hits one shape at most, also where shapes
        touch or coincide. None for a shape that is not part of the scene.
    two_sided
        Whether rays hit faces from behind. False requires a mesh; in front, vertices are counterclockwise.
    tolerance
        Distance in scene units above the faces at which rays hit them.
    """

    name: str
    shape: Any
    isolated: Any
    scene: Any = None
    two_sided: bool = True
    tolerance: float = 0.0
    is_surface = True

    def intersect(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        out = np.concatenate(
            [np.zeros(0), *(self._cast(*rays, self.scene or self.isolated) for rays in _batches(o, d))]
        )
        return out, out

    def _cast(self, o: np.ndarray, d: np.ndarray, scene: Any) -> np.ndarray:
        """Return the distances (N,) at which rays hit the shape first in ``scene``."""
        import drjit as dr
        import mitsuba as mi

        origin, direction = (np.ascontiguousarray(v.T, np.float32) for v in (o, d))
        ray: Any = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
        hit = scene.ray_intersect_preliminary(ray, coherent=False)
        shape = mi.ShapePtr(self.shape)
        is_hit, t = hit.is_valid() & ((hit.shape == shape) | (hit.instance == shape)), hit.t
        if self.tolerance > 0 or not self.two_sided:
            a, b, c = gather_corners(self.shape, dr.select(is_hit, hit.prim_index, 0))
            cosine = -dr.dot(dr.normalize(dr.cross(b - a, c - a)), ray.d)
            if not self.two_sided:
                is_hit &= cosine > 0
            t = dr.maximum(t - self.tolerance / dr.maximum(dr.abs(cosine), _MIN_COSINE), 0)
        return np.array(dr.select(is_hit, t, dr.inf), np.float64)

    @cached_property
    def _bounds(self) -> np.ndarray:
        """Corners (2, 3) of a bounding box, padded by the accuracy of single precision."""
        lower, upper = (np.array(c, np.float64) for c in shape_corners(self.shape))
        padding = 1e-6 * np.maximum(np.abs([lower, upper]).max(), np.linalg.norm(upper - lower))
        return np.array([lower - padding, upper + padding])

    @property
    def bounding_sphere(self) -> tuple[np.ndarray, float]:
        lower, upper = self._bounds
        return (lower + upper) / 2, float(np.linalg.norm(upper - lower)) / 2

    def hits_bounds(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        near, far = intersect_box_numpy(o, d, *self._bounds)
        is_hit = (near < far) & (far > 0)
        # The shape itself: of a thin shape, few of these directions hit more than the box.
        rays = np.flatnonzero(is_hit)
        is_hit[rays] = np.concatenate(
            [np.zeros(0, bool), *(np.isfinite(self._cast(*part, self.isolated)) for part in _batches(o[rays], d[rays]))]
        )
        return is_hit

    def sample_points(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        import mitsuba as mi

        # R2 sequence (Roberts 2018): uniformly distributed points for any number.
        n = np.arange(1, count + 1)
        u, v = (np.mod(0.5 + n / g, 1.0) for g in (1.32471795724474602596, 1.32471795724474602596**2))
        sample = self.shape.sample_position(0.0, mi.Point2f(u.astype(np.float32), v.astype(np.float32)))
        points = np.array(sample.p, np.float64).T
        return points, np.zeros_like(points)


def _batches(o: np.ndarray, d: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    return ((o[a : a + _RAY_BATCH], d[a : a + _RAY_BATCH]) for a in range(0, len(o), _RAY_BATCH))


def read_meshes(files: Iterable[Path]) -> dict[Path, MeshFile]:
    """Read the mesh of each file once. Raises `NergError` for missing and damaged files."""
    return {file: read_mesh_file(file) for file in dict.fromkeys(files)}


def make_aois(
    areas: Sequence[Region | MeshPart | SceneShape],
    shapes: Mapping[str, Any],
    meshes: Mapping[Path, MeshFile],
    scene: mi.Scene | None = None,
) -> list[Aoi]:
    """Create the elementary AOIs of ``areas``, in the same order.

    ``shapes`` are those of ``scene`` by name (see `ShapeAoi`), ``meshes`` those of mesh parts by file. A Mitsuba
    variant must be active. Raises `NergError` for unknown shapes and faces.
    """
    aois: list[Aoi] = []
    for area in areas:
        if isinstance(area, Region):
            aois.append(BoxAoi(area))
        elif isinstance(area, MeshPart):
            aois.append(aoi_from_shape(area.name, _make_part_mesh(area, meshes[area.file])))
        else:
            aois.append(aoi_from_shape(area.name, find_shape(shapes, area.shape), scene))
    return aois


def aoi_from_shape(name: str, shape: Any, scene: Any = None, **options: Any) -> ShapeAoi:
    """Create an AOI from a Mitsuba shape; ``scene`` and ``options`` are those of `ShapeAoi`."""
    return ShapeAoi(name, shape, scene_from_shapes({name: shape}), scene, **options)


def scene_from_shapes(shapes: Mapping[str, Any]) -> mi.Scene:
    """Create a scene of ``shapes``. Mitsuba renames the shapes it is given, so their names are restored."""
    import mitsuba as mi

    names = [shape.id() for shape in shapes.values()]
    with translate_mitsuba_errors():
        children = {f"shape_{k}": shape for k, shape in enumerate(shapes.values())}
        scene = mi.load_dict({"type": "scene", **children}, optimize=False)
    for shape, name in zip(shapes.values(), names):
        shape.set_id(name)
    return scene


def shapes_by_id(scene: mi.Scene | None) -> dict[str, Any]:
    """Return the shapes of a scene by id."""
    return {} if scene is None else {normalize_name(shape.id()): shape for shape in scene.shapes()}


def find_shape(shapes: Mapping[str, Any], name: str) -> Any:
    """Return the shape with this name. Raises `NergError`, listing the available names, if there is none."""
    if name not in shapes:
        remedy = f"its shapes are {', '.join(list(shapes)[:20])}" if shapes else "use a scene with shapes"
        raise NergError(f'there is no shape "{sanitize(name, 40)}" in the scene; {remedy}')
    return shapes[name]


def _make_part_mesh(part: MeshPart, mesh: MeshFile) -> Any:
    """Create a mesh of the faces of ``part``, whose numbers refer to the file of the mesh."""
    faces = mesh.faces[part.select_faces(int(mesh.polygons.max()) + 1)[mesh.polygons]]
    used, index = np.unique(faces, return_inverse=True)
    return make_mesh(mesh.vertices[used], index.reshape(-1, 3), part.name)


# ---- What-if changes ----
#
# A file of changes to a scene and its observers:
#
# .. code-block:: json
#
#     {"move": [{"shape": "sign", "by": [0.5, 0, 0], "turn": 90}, {"area": "shelf", "by": [0, 1, 0]}],
#      "remove": ["stand"], "add": [{"name": "poster", "min": [1, 0, 1], "max": [2, 0.1, 2]}],
#      "swap": [{"shape": "till", "mesh": "till2.ply"}],
#      "observers": [[1, 2, 1.6]], "shift": [0, 0, -0.2]}
#
# A turn is in degrees about the vertical axis through the centre of the moved object, counter-clockwise seen from
# above. Areas that refer to a moved shape move with it; boxes, which refer to no shape, are moved as areas. The gaze
# field is not retrained: it predicts the gaze on surfaces at the new position from what it learnt there.

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


def read_changes(path: str | Path) -> Changes:
    """Read changes from a JSON file. Raises `NergError` for invalid files."""
    path = Path(path)
    data = read_json(path, "file of changes", MAX_CHANGES_BYTES)
    unknown = next((k for k in data if k not in _CHANGE_KEYS), None) if isinstance(data, dict) else ""
    if not isinstance(data, dict) or not data or unknown is not None:
        detail = "" if not unknown else f'; "{sanitize(unknown, 40)}" is not one of {", ".join(_CHANGE_KEYS)}'
        raise NergError(f'"{path}" contains no valid changes; write {_EXAMPLE}{detail}')
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
        raise NergError(f'"{path}": {error}') from error


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


def apply_to_areas(areas: AreaSet, changes: Changes) -> AreaSet:
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
    return AreaSet(tuple(remaining))


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


def apply_to_scene(
    scene: mi.Scene | None, changes: Changes, meshes: Mapping[Path, MeshFile]
) -> tuple[mi.Scene, dict[str, Any]]:
    """Create a scene with the changed shapes; unchanged shapes are shared with ``scene``. Return it with all shapes by
    name.

    ``meshes`` are those of added shapes, by file. Raises `NergError` for shapes that are unknown or cannot be moved.
    """
    if scene is None:
        raise NergError("changes of shapes need a scene (.xml), since a radiance field has no shapes")
    shapes = shapes_by_id(scene)
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
    return scene_from_shapes(shapes), shapes


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
