"""Areas of interest in an environment: their geometry, the rays that hit them, and the gaze field that predicts the
attention on them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from nerg_mi.environment.environment import Environment, no_geometry
from nerg_mi.environment.gaze import GazeField, read_training_alignment
from nerg_mi.environment.sampler import GazeSampler, make_sampler
from nerg_mi.errors import NergError, sanitize, translate_mitsuba_errors
from nerg_mi.formats.alignments import open_similarity
from nerg_mi.formats.boxes import Region
from nerg_mi.formats.meshes import MeshFile, read_mesh_file
from nerg_mi.maths.geometry import intersect_box_numpy
from nerg_mi.maths.vmf import tangent_frame
from nerg_mi.tracking_kinds import TRACKING_NOTES
from nerg_mi.transport.geometry import SceneGeometry, shape_corners
from nerg_mi.transport.mitsuba_mesh import gather_corners, make_mesh

from .areas import Areas, MeshPart, SceneShape
from .settings import AoiSampling

if TYPE_CHECKING:
    import mitsuba as mi


# ---- AOI geometry ----
#
# Boxes are intersected in closed form, meshes and shapes by ray casts in Mitsuba.

_RAY_BATCH = 1 << 20
_MIN_COSINE = 0.05  # limits the distance along a grazing ray that corresponds to the tolerance


class AoiTarget(Protocol):
    """What rays hit: an area of interest at rest, or in motion."""

    @property
    def is_surface(self) -> bool:
        """Whether it is a surface, which has no interior."""
        ...

    def intersect(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Intersect rays with the AOI.

        Parameters
        ----------
        o, d
            Origins and unit directions of the rays, (N, 3) each, in scene coordinates.

        Returns
        -------
        near, far
            Distances (N,) along the rays. For a solid: where the line of the ray enters and leaves it; ``near`` < 0 <
            ``far`` if the ray starts inside, and ``near`` >= ``far`` if the line misses it. For a surface
            (``is_surface``): ``near`` and ``far`` are both the distance to its first intersection, infinite for a miss.
        """
        ...


class Aoi(AoiTarget, Protocol):
    """An elementary area of interest in scene coordinates. A named area consists of one or more of these."""

    @property
    def name(self) -> str:
        """Name of the area."""
        ...

    @property
    def bounding_sphere(self) -> tuple[np.ndarray, float]:
        """Centre (3,) and radius of a bounding sphere."""
        ...

    def hits_bounds(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Return whether rays with origins ``o`` and unit directions ``d``, (N, 3) each, intersect a bounding box of
        the AOI, (N,)."""
        ...

    def sample_points(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return about ``count`` points (S, 3), uniformly distributed over the surface, and their outward normals (S,
        3).

        Normals are zero for two-sided surfaces. The points are deterministic.
        """
        ...


@dataclass(frozen=True)
class BoxAoi:
    """An oriented or axis-aligned box."""

    region: Region
    is_surface = False

    @property
    def name(self) -> str:
        return self.region.name

    def intersect(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        region = self.region
        direction = d if region.rotation is None else d @ region.rotation_matrix
        return intersect_box_numpy(region.to_local(np.asarray(o, float)), direction, *region.corners)

    @property
    def bounding_sphere(self) -> tuple[np.ndarray, float]:
        lower, upper = self.region.corners
        return self.region.center, float(np.linalg.norm(upper - lower)) / 2

    def hits_bounds(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        near, far = self.intersect(o, d)
        return (near < far) & (far > 0)

    def sample_points(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = self.region.corners
        size = upper - lower
        # Edge length of squares that cover the surface with about `count` of them.
        faces = 2 * np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
        edge = np.sqrt(faces.sum() / count)
        points, normals = [], []
        for axis in range(3):
            u, v = (k for k in range(3) if k != axis)
            steps = [max(1, round(float(size[k] / edge))) for k in (u, v)]
            a, b = (lower[k] + (np.arange(n) + 0.5) / n * size[k] for k, n in zip((u, v), steps))
            grid = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
            for side, sign in ((lower, -1.0), (upper, 1.0)):
                face = np.empty((len(grid), 3))
                face[:, (u, v)], face[:, axis] = grid, side[axis]
                normal = np.zeros((len(grid), 3))
                normal[:, axis] = sign
                points.append(face)
                normals.append(normal)
        faces_and_normals = np.concatenate(points), np.concatenate(normals)
        return self.region.to_world(faces_and_normals[0]), faces_and_normals[1] @ self.region.rotation_matrix.T


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
            mesh = area.mesh if area.file is None else meshes[area.file]
            assert mesh is not None
            aois.append(aoi_from_shape(area.name, _make_part_mesh(area, mesh)))
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


# ---- Hits ----
#
# A sample hits a box if it crosses the box and the first surface on the ray lies in the box: near - margin <= depth <
# far + margin, for the entry distance ``near`` and the exit distance ``far``. A larger box therefore never has fewer
# hits, boxes that tile space partition all samples that meet a surface (for a margin of 0), and a sample that crosses a
# box and ends behind it does not hit it. A sample hits a mesh or a shape if it meets it before any other surface:
# ``near`` <= depth + margin. Without surface depths, AOIs are treated as solids: an AOI occludes another one that the
# ray enters after it has left the first; AOIs that overlap along the ray are both hit.

MARGIN = AoiSampling().margin  # in metres, about the accuracy of surfaces in a radiance field


@dataclass(frozen=True)
class HitAssignment:
    """Hits of N samples on AOIs: for each AOI the ascending ``rows`` of the samples that hit it, and the ``distance``
    at which they enter it.

    For a sample that starts inside an AOI, the distance is that of the surface it meets there.
    """

    count: int
    rows: tuple[np.ndarray, ...]
    distance: tuple[np.ndarray, ...]


def assign_hits(
    aois: Sequence[AoiTarget],
    o: np.ndarray,
    d: np.ndarray,
    depth: np.ndarray | None,
    margin: float = 0.0,
    candidates: Sequence[np.ndarray] | None = None,
) -> HitAssignment:
    """Assign rays with origins ``o`` and unit directions ``d``, (N, 3) each, to the AOIs that they hit.

    Parameters
    ----------
    aois
        Elementary AOIs.
    depth
        Distance of the first surface on each ray, (N,), infinite if there is none. None: surfaces are unknown.
    margin
        Distance by which a surface may lie in front of an AOI, or behind the end of a box, and still belong to it.
    candidates
        For each AOI the sorted indices of the rays that may hit it. None: all rays.
    """
    if depth is None:
        return _assign_hits_to_solids(aois, o, d, margin)
    rows, distance = [], []
    for k, aoi in enumerate(aois):
        subset = slice(None) if candidates is None else candidates[k]
        near, far = aoi.intersect(o[subset], d[subset])
        surface_depth = depth[subset]
        if aoi.is_surface:
            is_hit, entry = np.isfinite(near) & (near >= 0) & (near <= surface_depth + margin), near
        else:
            ends_inside = (near - margin <= surface_depth) & (surface_depth < far + margin)
            is_hit, entry = (
                (near < far) & (far > 0) & ends_inside & np.isfinite(surface_depth),
                np.where(near < 0, surface_depth, near),
            )
        hit_rows = np.flatnonzero(is_hit)
        rows.append(hit_rows if candidates is None else candidates[k][hit_rows])
        distance.append(entry[hit_rows].astype(np.float64))
    return HitAssignment(len(o), tuple(rows), tuple(distance))


def _assign_hits_to_solids(aois: Sequence[AoiTarget], o: np.ndarray, d: np.ndarray, margin: float) -> HitAssignment:
    """Assign rays to AOIs without surface depths; AOIs are solids that occlude each other."""
    spans = [aoi.intersect(o, d) for aoi in aois]
    entries = [
        (near >= 0) & (np.isfinite(near) if aoi.is_surface else near < far) for aoi, (near, far) in zip(aois, spans)
    ]
    nearest_exit = np.full(len(o), np.inf)
    for (_, far), is_entered in zip(spans, entries):
        nearest_exit = np.where(is_entered, np.minimum(nearest_exit, far), nearest_exit)
    rows = [
        np.flatnonzero(is_entered & (near <= nearest_exit + margin)) for (near, _), is_entered in zip(spans, entries)
    ]
    return HitAssignment(len(o), tuple(rows), tuple(near[r].astype(np.float64) for (near, _), r in zip(spans, rows)))


def find_nearest_entry(aois: Sequence[AoiTarget], o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return the distance (N,) at which rays enter the nearest AOI, infinite if there is none."""
    depth = np.full(len(o), np.inf)
    for aoi in aois:
        near, far = aoi.intersect(o, d)
        is_hit = (near >= 0) & (np.isfinite(near) if aoi.is_surface else near < far)
        depth = np.where(is_hit, np.minimum(depth, near), depth)
    return depth


def merge_members(hits: HitAssignment, members: Sequence[tuple[int, ...]]) -> HitAssignment:
    """Combine hits on elementary AOIs into hits on areas.

    Each area consists of the AOIs whose indices are listed in ``members``. A sample hits an area if it hits any of
    them; the distance is the smallest one.
    """
    rows, distance = [], []
    for indices in members:
        if len(indices) == 1:
            rows.append(hits.rows[indices[0]])
            distance.append(hits.distance[indices[0]])
            continue
        all_rows = np.concatenate([hits.rows[k] for k in indices])
        all_distances = np.concatenate([hits.distance[k] for k in indices])
        order = np.lexsort((all_distances, all_rows))
        hit_rows, first = np.unique(all_rows[order], return_index=True)
        rows.append(hit_rows)
        distance.append(all_distances[order][first])
    return HitAssignment(hits.count, tuple(rows), tuple(distance))


def merge_directions(parts: Sequence[HitAssignment]) -> HitAssignment:
    """Combine the hits of the same samples along several directions, such as those of a cone.

    A sample hits an AOI if any of its directions does; the distance is that of the first such direction.
    """
    count, num_aois = parts[0].count, len(parts[0].rows)
    rows, distance = [], []
    for k in range(num_aois):
        all_rows = np.concatenate([part.rows[k] for part in parts])
        all_distances = np.concatenate([part.distance[k] for part in parts])
        hit_rows, first = np.unique(all_rows, return_index=True)
        rows.append(hit_rows)
        distance.append(all_distances[first])
    return HitAssignment(count, tuple(rows), tuple(distance))


def concatenate_hits(parts: Sequence[HitAssignment]) -> HitAssignment:
    """Concatenate the hits of consecutive blocks of samples."""
    starts = np.cumsum([0, *(part.count for part in parts)])
    num_aois = len(parts[0].rows)
    rows = [np.concatenate([part.rows[k] + a for part, a in zip(parts, starts)]) for k in range(num_aois)]
    distance = [np.concatenate([part.distance[k] for part in parts]) for k in range(num_aois)]
    return HitAssignment(int(starts[-1]), tuple(rows), tuple(distance))


def sample_cone(
    d: np.ndarray, degrees: float, rings: Sequence[tuple[float, int]] = ((0.5, 6), (1.0, 12))
) -> list[np.ndarray]:
    """Return unit directions (N, 3) in a cone around each of ``d`` (N, 3), the axis first.

    ``rings`` lists pairs of a fraction of the half-angle ``degrees`` and a number of directions. The default of 19
    directions leaves no gap wider than half of the angle.
    """
    d = np.asarray(d, float)
    u, v = tangent_frame(d)
    directions = [d]
    for fraction, number in rings:
        angle = np.radians(degrees * fraction)
        for turn in 2 * np.pi * np.arange(number) / number:
            directions.append(np.cos(angle) * d + np.sin(angle) * (np.cos(turn) * u + np.sin(turn) * v))
    return directions


# ---- Areas in an environment ----


@dataclass(frozen=True, eq=False)
class PlacedAreas:
    """Areas of interest in an environment.

    Parameters
    ----------
    environment
        What participants see, with the alignment of the rays.
    sampler
        Gaze field in the environment, or None.
    areas
        Areas.
    aois
        Elementary AOIs of the areas.
    meshes
        Meshes of AOIs and changes, by file.
    sampling
        How rays are assigned to AOIs, and how visibility and the gaze field are sampled.
    doubts
        Messages about an alignment that its evidence did not determine.
    """

    environment: Environment
    sampler: GazeSampler | None
    areas: Areas
    aois: Sequence[Aoi]
    meshes: Mapping[Path, MeshFile]
    sampling: AoiSampling = AoiSampling()
    doubts: tuple[str, ...] = ()

    @property
    def warnings(self) -> list[str]:
        """Warnings about the alignment, about a gaze field of heads, and about unused content of the meshes."""
        basis = None if self.sampler is None else self.sampler.gaze.field.basis
        note = None if basis is None else TRACKING_NOTES.get(basis.tracking)
        of_heads = f"the gaze field was trained on {note}: predictions are those of heads, not of eyes"
        return [
            *self.doubts,
            *([of_heads] if note else []),
            *(f"of {file}: {note}" for file, mesh in self.meshes.items() for note in mesh.notes),
        ]

    @cached_property
    def members(self) -> list[tuple[int, ...]]:
        """Indices of the elementary AOIs of each area."""
        return list(self.areas.element_indices().values())

    @property
    def scale(self) -> float:
        """Scene units per metre."""
        return float(self.environment.align.scale)

    @property
    def margin(self) -> float:
        """Surface tolerance in scene units."""
        return self.sampling.margin * self.scale

    def trace_depth(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Return the distance to the surfaces of the environment or, if they are unknown, to the nearest AOI."""
        if self.environment.has_surfaces:
            return self.environment.trace_depth(o, d)
        return find_nearest_entry(self.aois, o, d)


def place_areas(
    environment: Environment,
    sampler: GazeSampler | None,
    areas: Areas,
    meshes: Mapping[Path, MeshFile],
    sampling: AoiSampling = AoiSampling(),
    doubts: tuple[str, ...] = (),
) -> PlacedAreas:
    """Place ``areas`` in an environment, see `PlacedAreas`. Raises `NergError` for unknown shapes and faces."""
    areas = areas.match_shapes(environment.shapes)
    aois = make_aois(areas.elements, environment.shapes, meshes, environment.scene_geometry.scene)
    return PlacedAreas(environment, sampler, areas, aois, meshes, sampling, doubts)


def open_placed_areas(
    environment: Any, gaze: Any, areas: Areas, align: Any = None, sampling: AoiSampling = AoiSampling()
) -> PlacedAreas:
    """Open an environment and a gaze field, in memory or as files, and place ``areas`` there.

    The default environment is that of the training of ``gaze``, and the default gaze field that of a scene. An
    environment without shapes must be that of the training. ``align`` is a similarity or its file, by default that of
    the training. Raises `NergError`.
    """
    doubts: list[str] = []
    to_scene = None if align is None else open_similarity(align, "rays to scene", doubts.append)
    field = None if gaze is None else GazeField.open(gaze)
    if environment is not None:
        opened = Environment.open(environment, keep_shapes=True)
        if field is not None and isinstance(opened.medium, SceneGeometry):
            opened = replace(opened, align=read_training_alignment(field.provenance))
        elif field is not None:
            opened = field.open_environment(opened)
    else:
        opened = no_geometry(np.zeros((1, 3))) if field is None else field.open_environment()
    opened = opened if to_scene is None else replace(opened, align=to_scene)
    return place_areas(opened, make_sampler(opened, field), areas, read_meshes(areas.meshes), sampling, tuple(doubts))
