"""Evidence for alignments, and scene surfaces as points and as distance grids."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt, label

from nerg_mi.errors import MissingFile, NergError, parameter
from nerg_mi.files.safe_read import read_npy
from nerg_mi.formats.alignments import Interval
from nerg_mi.formats.meshes import READERS, read_mesh_file
from nerg_mi.maths.coordinates import check_coordinates, check_near_origin
from nerg_mi.maths.sphere import sample_uniform_directions
from nerg_mi.maths.transforms import similarity_scale, transform_points
from nerg_mi.photos.posed import read_semidense
from nerg_mi.tracking.readers.tables import iterate_table, read_table_columns
from nerg_mi.transport.geometry import SURFACE_OPACITY, SceneGeometry, trace_depth
from nerg_mi.transport.medium import Medium

from .similarity import FULL_BASIS, LocalSimilarity, vertical_rotation

# ---- Distance grid ----


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Distances sampled on a lattice, interpolated trilinearly.

    ``values`` (nx, ny, nz) are at ``lower + step * (i, j, k)``. Outside the lattice the distance to it is added.
    """

    values: np.ndarray
    lower: np.ndarray
    step: float

    @property
    def upper(self) -> np.ndarray:
        """Last point (3,) of the lattice."""
        return self.lower + self.step * (np.array(self.values.shape) - 1)

    def interpolate(self, points: np.ndarray) -> np.ndarray:
        """Return distances (N,) at ``points`` (N, 3)."""
        return self.interpolate_with_gradient(points)[0]

    def interpolate_with_gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return distances (N,) at ``points`` (N, 3) and their gradients (N, 3)."""
        last = np.array(self.values.shape) - 1
        u = (points - self.lower) / self.step
        clipped = np.clip(u, 0, last)
        cell = np.minimum(clipped.astype(np.int64), np.maximum(last - 1, 0))
        f = clipped - cell
        strides = np.array([self.values.shape[1] * self.values.shape[2], self.values.shape[2], 1])
        first, flat = cell @ strides, self.values.reshape(-1)
        # A lattice with one layer has no second point on that axis.
        to_next = strides * (last > 0)
        v = [[[flat[first + to_next @ np.array((i, j, k))] for k in (0, 1)] for j in (0, 1)] for i in (0, 1)]
        x, y, z = f.T
        # Interpolate along z, then y, then x. The derivative along an edge is the difference of its end points.
        on_z = [[(1 - z) * v[i][j][0] + z * v[i][j][1] for j in (0, 1)] for i in (0, 1)]
        by_z = [[v[i][j][1] - v[i][j][0] for j in (0, 1)] for i in (0, 1)]
        on_y = [(1 - y) * on_z[i][0] + y * on_z[i][1] for i in (0, 1)]
        value = (1 - x) * on_y[0] + x * on_y[1]
        gradient = np.empty((len(points), 3))
        gradient[:, 0] = on_y[1] - on_y[0]
        gradient[:, 1] = (1 - x) * (on_z[0][1] - on_z[0][0]) + x * (on_z[1][1] - on_z[1][0])
        along = [(1 - y) * by_z[i][0] + y * by_z[i][1] for i in (0, 1)]
        gradient[:, 2] = (1 - x) * along[0] + x * along[1]
        gradient /= self.step
        beyond = self.step * (u - clipped)
        excess = np.linalg.norm(beyond, axis=1)
        is_outside = excess > 0
        gradient[is_outside] = np.where(
            beyond[is_outside] != 0, beyond[is_outside] / excess[is_outside, None], gradient[is_outside]
        )
        return value + excess, gradient


# ---- Surface files ----
#
# Meshes and point clouds (PLY, OBJ), tables (CSV, also Project Aria's), and arrays (.npy).

SUFFIXES = (*READERS, ".csv", ".csv.gz", ".npy")  # supported file suffixes
NUM_POINTS = 200_000  # number of points sampled from a mesh, uniformly by area, or from a larger cloud


def read_surface(path: Path, count: int = NUM_POINTS, on_note: Callable[[str], None] = lambda note: None) -> np.ndarray:
    """Read at most ``count`` points (N, 3) of the surface in a file, in its own frame and units.

    Points are sampled randomly with a fixed seed. ``on_note`` is called with warnings about unused content. Raises
    `NergError` for a file without finite points, and for points with implausibly large coordinates.
    """
    if not path.name.lower().endswith(SUFFIXES):
        raise NergError(f'"{path}" is not a supported surface file; give a mesh or points in {", ".join(SUFFIXES)}')
    if not path.exists():
        raise MissingFile(f'the surface "{path}" does not exist; check its name')
    if path.name.lower().endswith((".csv", ".csv.gz")):
        points = _read_table(path)
    elif path.suffix.lower() == ".npy":
        points = _read_array(path)
    else:
        mesh = read_mesh_file(path, allow_points=True)
        points = _sample_triangles(mesh.vertices, mesh.faces, count)
        for note in mesh.notes:
            on_note(f"of {path}: {note}")
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise NergError(f'the surface "{path}" has no points; export it again')
    check_coordinates(points, f'the points of "{path}"')
    check_near_origin(points, f'the surface "{path}"')
    rng = np.random.default_rng(0)
    return points if len(points) <= count else points[np.sort(rng.permutation(len(points))[:count])]


def _read_table(path: Path) -> np.ndarray:
    if "px_world" in read_table_columns(path):
        return read_semidense(path).astype(np.float64)
    blocks = [b.numbers for b in iterate_table(path, ("x", "y", "z"))]
    return np.concatenate(blocks) if blocks else np.zeros((0, 3))


def _read_array(path: Path) -> np.ndarray:
    points = read_npy(path, "surface")
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise NergError(f'the surface "{path}" holds an array of shape {points.shape}; it must be (N, 3) numbers')
    return points.astype(np.float64)


def _sample_triangles(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Sample points on triangles uniformly by area; return the vertices if there are no triangles."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    with np.errstate(over="ignore", invalid="ignore"):
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    area = np.where(np.isfinite(area), area, 0)
    if not area.sum() > 0:
        return vertices
    rng = np.random.default_rng(0)
    face = rng.choice(len(faces), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    fold = u + v > 1
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    return a[face] + u * (b[face] - a[face]) + v * (c[face] - a[face])


# ---- Scene surface ----
#
# Points on the surfaces of a scene, the distance to them, and the distance to free space.
#
# Traced rays end on surfaces, and the voxels they pass are free. Interiors of hollow objects are reached by rays that
# start there. They form pockets that are not connected to the rooms, and count as solid.

NUM_RAYS = 150_000  # number of rays that trace a scene
NUM_VOXELS = 1 << 20  # approximate number of voxels
# Padding in voxels, and the volume of a pocket relative to the largest room.
_PADDING, _MIN_ROOM_FRACTION = 3, 0.2


@dataclass(frozen=True, eq=False)
class SceneTraces:
    """Rays traced in a scene: start and end points (N, 3), and whether each ends on a surface (N,)."""

    start: np.ndarray
    end: np.ndarray
    is_hit: np.ndarray

    def transform(self, matrix: np.ndarray) -> SceneTraces:
        """Transform the rays by ``matrix`` (4, 4)."""
        return SceneTraces(transform_points(matrix, self.start), transform_points(matrix, self.end), self.is_hit)


@dataclass(frozen=True, eq=False)
class SceneSurface:
    """Surface of a scene.

    Parameters
    ----------
    points
        Points on surfaces, one per voxel, (M, 3).
    distance
        Distance to the nearest of these points, in scene units.
    free_space_distance
        Distance to free space, 0 within it.
    has_free_space
        Whether free space is known; it is not for bare points.
    """

    points: np.ndarray
    distance: DistanceGrid
    free_space_distance: DistanceGrid
    has_free_space: bool

    @property
    def step(self) -> float:
        """Edge length of a voxel."""
        return self.distance.step

    @property
    def diagonal(self) -> float:
        """Diagonal of the bounding box of the points, without the outer two percent on either side of each axis."""
        return float(np.linalg.norm(np.subtract(*np.percentile(self.points, [98, 2], axis=0))))

    def find_floor(self) -> float:
        """Estimate the height of the floor, z up: the lowest level with a large number of points."""
        z = self.points[:, 2]
        low, high = np.percentile(z, [0.5, 99.5])
        edges = np.arange(low - 2 * self.step, high + 2 * self.step, self.step)
        if len(edges) < 3:
            return float(low)
        count = np.histogram(z, edges)[0]
        # A level may lie on the boundary of two bins.
        count = np.convolve(count, [1, 1])[: len(edges) - 1]
        k = int(np.flatnonzero(count >= 0.3 * count[: max(1, len(count) // 2)].max())[0])
        while k + 1 < len(count) and count[k + 1] > count[k]:
            k += 1
        near = z[(z >= edges[max(k - 1, 0)]) & (z <= edges[k + 1])]
        return float(np.median(near)) if len(near) else float(edges[k])


def trace_scene(
    geometry: Medium | SceneGeometry, lower: np.ndarray, upper: np.ndarray, num_rays: int = NUM_RAYS, seed: int = 0
) -> SceneTraces:
    """Trace rays from random points of a box in random directions. Raises `NergError` if none meets a surface."""
    rng = np.random.default_rng(seed)
    start = rng.uniform(lower, upper, (num_rays, 3))
    direction = sample_uniform_directions(num_rays, rng)
    depth, opacity = trace_depth(geometry, start, direction)
    is_hit = opacity >= SURFACE_OPACITY
    if is_hit.mean() < 1e-3:
        raise NergError(
            "rays meet no surface in the scene, so nothing can be aligned with it; check the scene and its bounds"
        )
    max_length = np.linalg.norm(np.subtract(upper, lower))
    return SceneTraces(start, start + direction * np.where(is_hit, depth, max_length)[:, None], is_hit)


def surface_from_traces(traces: SceneTraces, num_voxels: int = NUM_VOXELS) -> SceneSurface:
    """Create the surface that traced rays meet."""
    points = traces.end[traces.is_hit]
    box = np.percentile(points, [0.2, 99.8], axis=0)
    lower, step, shape = _make_lattice(box[0], box[1], num_voxels)
    length = np.linalg.norm(traces.end - traces.start, axis=1)
    # Rays that end where they start are inside a solid.
    is_valid = length > 1.5 * step
    solid, means = _fill_voxels(traces.end[traces.is_hit & is_valid], lower, step, shape)
    free = np.zeros(shape, bool)
    start, segment, length = traces.start[is_valid], (traces.end - traces.start)[is_valid], length[is_valid]
    for t in np.arange(0, min(length.max(initial=0), float(np.linalg.norm(box[1] - box[0]))), 0.8 * step):
        is_inside = length - 0.7 * step > t
        points = start[is_inside] + segment[is_inside] * (t / length[is_inside, None])
        index = np.floor((points - lower) / step).astype(int)
        free[tuple(index[((index >= 0) & (index < shape)).all(axis=1)].T)] = True
    # Close gaps of one voxel between rays.
    free = np.asarray(binary_dilation(free), bool) & ~solid
    return _make_surface(means, solid, _remove_pockets(free), lower, step, True)


def surface_from_points(points: np.ndarray, num_voxels: int = NUM_VOXELS) -> SceneSurface:
    """Create a surface from bare ``points`` (N, 3), whose free space is unknown. Raises `NergError` for too few
    points."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        raise NergError(f"the scene has {len(points)} points, but an alignment needs at least 100")
    box = np.percentile(points, [0.2, 99.8], axis=0)
    lower, step, shape = _make_lattice(box[0], box[1], num_voxels)
    solid, means = _fill_voxels(points, lower, step, shape)
    return _make_surface(means, solid, ~solid, lower, step, False)


def downsample(points: np.ndarray, step: float) -> np.ndarray:
    """Return the mean of the points in each voxel of edge ``step``, which makes the density on surfaces uniform."""
    index = np.floor((points - points.min(axis=0)) / step).astype(np.int64)
    _, voxel, count = np.unique(index, axis=0, return_inverse=True, return_counts=True)
    voxel = voxel.reshape(-1)
    return np.stack([np.bincount(voxel, c) / count for c in points.T], axis=1)


def _make_lattice(low: np.ndarray, high: np.ndarray, voxels: int) -> tuple[np.ndarray, float, tuple[int, int, int]]:
    size = np.maximum(high - low, 1e-3 * float(np.max(high - low)))
    if not size.max() > 0:
        raise NergError("all points of the scene coincide, so nothing can be aligned with it")
    # Limit the resolution along an axis, since a flat scene would otherwise get arbitrarily small voxels.
    step = max(float(np.cbrt(np.prod(size) / voxels)), float(size.max()) / 512)
    shape = np.ceil(size / step).astype(int) + 2 * _PADDING
    return low - _PADDING * step, step, (int(shape[0]), int(shape[1]), int(shape[2]))


def _fill_voxels(points: np.ndarray, lower: np.ndarray, step: float, shape) -> tuple[np.ndarray, np.ndarray]:
    """Return which voxels contain a point, (nx, ny, nz) bool, and the mean point of each, (nx, ny, nz, 3), NaN for
    empty voxels."""
    index = np.floor((points - lower) / step).astype(int)
    inside = ((index >= 0) & (index < shape)).all(axis=1)
    flat = np.ravel_multi_index(tuple(index[inside].T), shape)
    count = np.bincount(flat, minlength=int(np.prod(shape)))
    sums = [np.bincount(flat, c, minlength=len(count)) for c in points[inside].T]
    with np.errstate(invalid="ignore"):
        means = np.stack(sums, axis=1) / count[:, None]
    return (count > 0).reshape(shape), means.reshape(*shape, 3)


def _remove_pockets(free: np.ndarray) -> np.ndarray:
    """Return the free voxels that are not pockets."""
    core = binary_erosion(free)
    parts = np.asarray(label(core)[0], np.int64)  # pyright: ignore[reportIndexIssue] # the stubs know no outputs
    size = np.bincount(parts.reshape(-1))[1:]
    if not len(size):
        return free
    is_room = np.concatenate([[False], size >= _MIN_ROOM_FRACTION * size.max()])[parts]
    return np.asarray(binary_dilation(is_room, iterations=2), bool) & free


def _make_surface(means, solid, free, lower, step, has_free_space: bool) -> SceneSurface:
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in solid.shape), indexing="ij"), axis=-1)
    nodes = lower + step * (nodes + 0.5)
    index = np.asarray(distance_transform_edt(~solid, return_distances=False, return_indices=True))
    to_surface = np.linalg.norm(nodes - means[tuple(index)], axis=-1)
    free_distance = distance_transform_edt(~free) if free.any() else np.zeros(solid.shape)
    # Distance from the centre of a voxel to the boundary of the free one.
    free_distance = np.maximum(np.asarray(free_distance) - 0.5, 0) * step
    first = lower + 0.5 * step
    grids = [DistanceGrid(np.ascontiguousarray(v, np.float64), first, step) for v in (to_surface, free_distance)]
    return SceneSurface(means[solid], grids[0], grids[1], has_free_space)


# ---- Evidence ----
#
# Each kind of evidence is a class that implements `Evidence`. Register a new kind in `nerg_mi.alignment.align`.

ProgressCallback = Callable[[float, str], None]  # called with the completed fraction and a description


@dataclass(frozen=True, eq=False)
class AlignmentTarget:
    """The scene that tracking is aligned with, and prior knowledge.

    Parameters
    ----------
    traces, points
        Traced rays, or points (N, 3) on surfaces; neither if only the frame of the scene is needed.
    to_z_up
        Rotation (4, 4) from the frame of the scene to one with z up.
    is_upright
        Whether the up direction is known, so that the z axis of the tracking stays vertical.
    tracking_floor
        Height of the floor in the tracking, in metres; None if unknown.
    scene_floor
        Height of the floor in the scene, along its up direction; None to estimate it.
    scale
        Scene units per unit of the tracking; None to estimate it.
    turn
        Rotation about z from the tracking to the z-up frame, in radians; None to estimate it.
    shift
        Position (3,) of the tracking's origin in the z-up frame; None to estimate it.
    """

    traces: SceneTraces | None = None
    points: np.ndarray | None = None
    to_z_up: np.ndarray = field(default_factory=lambda: np.eye(4))
    is_upright: bool = True
    tracking_floor: float | None = 0.0
    scene_floor: float | None = None
    scale: float | None = None
    turn: float | None = None
    shift: np.ndarray | None = None

    @property
    def constraints(self) -> dict[str, Any]:
        """Constraints, as keywords of `nerg_mi.alignment.similarity.fit_similarity`."""
        return {"upright": self.is_upright, "scale": self.scale, "turn": self.turn, "shift": self.shift}

    def parametrize(self, base: np.ndarray, center: np.ndarray, fix_floor: bool = False) -> LocalSimilarity:
        """Return the similarities near ``base`` (4, 4) that satisfy the constraints.

        ``center`` (3,), z up, is a centre of rotation and scale; with ``fix_floor`` it lies on the floor, and the floor
        stays in place. The constraints must hold for ``base`` (`constrain`).
        """
        free = [0, 1, 2] if not self.is_upright else [2] if self.turn is None else []
        if self.shift is None:
            free += [3, 4] if fix_floor else [3, 4, 5]
        free += [6] if self.scale is None else []
        return LocalSimilarity(base, center if self.shift is None else self.shift, FULL_BASIS[:, free])

    def constrain(self, matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return ``matrix`` (4, 4) with the given scale, turn and shift, which keeps the mean of ``points`` (N, 3) in
        place if the shift is free."""
        scale = similarity_scale(matrix) if self.scale is None else self.scale
        rotation = matrix[:3, :3] / similarity_scale(matrix)
        if self.turn is not None:
            rotation = vertical_rotation(self.turn)
        out = np.eye(4)
        out[:3, :3] = scale * rotation
        center = points.mean(axis=0)
        at = transform_points(matrix, center) - out[:3, :3] @ center
        out[:3, 3] = at if self.shift is None else self.shift
        return out

    @cached_property
    def surface(self) -> SceneSurface:
        """Surface of the scene, z up. Raises `NergError` if no geometry was given."""
        if self.traces is not None:
            return surface_from_traces(self.traces.transform(self.to_z_up))
        if self.points is not None:
            return surface_from_points(transform_points(self.to_z_up, self.points))
        raise NergError(
            f"this evidence needs the geometry of the scene: give {parameter('environment', 'FILE')} or "
            f"{parameter('surface', 'FILE')} (a mesh or points)"
        )

    @cached_property
    def floor_height(self) -> float:
        """Height of the floor of the scene, z up."""
        return self.surface.find_floor() if self.scene_floor is None else self.scene_floor

    def to_scene_frame(self, matrix: np.ndarray) -> np.ndarray:
        """Convert a similarity to the z-up frame into one to the frame of the scene."""
        return np.linalg.inv(self.to_z_up) @ matrix


@dataclass(frozen=True, eq=False)
class AlignmentFit:
    """Result of an alignment.

    Parameters
    ----------
    matrix
        Similarity (4, 4) from the tracking to the scene.
    residuals_cm, residuals_deg
        Residuals as distances in units of the tracking times 100, (N,), and as angles in degrees, (M,).
    covariance
        Covariance (7, 7) of rotation vector, translation (scene units) and logarithm of the scale; None if unknown.
    mirrored
        Message if a mirrored frame fits better, else None.
    points, targets
        Points of the tracking (N, 3) and their targets in the scene (N, 3), for figures.
    metadata
        Further JSON values of the record.
    notes, warnings
        Messages for the user.
    interval
        What samples without hit points leave open; None with other evidence.
    """

    matrix: np.ndarray
    residuals_cm: np.ndarray
    residuals_deg: np.ndarray
    covariance: np.ndarray | None = None
    mirrored: str | None = None
    points: np.ndarray | None = None
    targets: np.ndarray | None = None
    metadata: dict[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()
    warnings: Sequence[str] = ()
    interval: Interval | None = None


class Evidence(Protocol):
    """One kind of evidence for an alignment."""

    @property
    def kind(self) -> str:
        """Name of the kind in alignment.json."""
        ...

    def fit(self, target: AlignmentTarget, progress: ProgressCallback) -> AlignmentFit:
        """Fit the similarity from the tracking to the scene.

        Raises `NergError` with a remedy if the evidence does not determine the similarity.
        """
        ...


def describe_mirror(what: str, mirrored: float, declared: float) -> str:
    """Return the message that a mirrored tracking frame fits better; distances are in metres."""
    return f"{what} to {100 * mirrored:.3g} cm with the x axis negated, but only to {100 * declared:.3g} cm as declared"


def angles_between(viewpoint: np.ndarray, at: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Return the angles in degrees (N,) between points ``at`` and ``to``, (N, 3) each, as seen from ``viewpoint``, (3,)
    or (N, 3).

    Points closer to the viewpoint than a millionth of the largest distance are omitted.
    """
    a, b = at - viewpoint, to - viewpoint
    length = np.minimum(np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1))
    is_far = length > 1e-6 * max(float(length.max(initial=0)), 1e-300)
    a, b = a[is_far], b[is_far]
    # arccos is inaccurate for small angles.
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))


def pair_covariance(source: np.ndarray, target: np.ndarray, chart: LocalSimilarity) -> np.ndarray | None:
    """Return the covariance (7, 7) of a least-squares fit of point pairs, the base of ``chart``, from its normal
    equations.

    The result is None if there are no more residuals than parameters.
    """
    basis = chart.basis
    zero = np.zeros(chart.size)
    moved = chart.transform(zero, source)
    jacobian = np.concatenate([chart.gradient(zero, moved, np.broadcast_to(e, moved.shape)) for e in np.eye(3)])
    degrees_of_freedom = jacobian.shape[0] - chart.size
    if degrees_of_freedom < 1:
        return None
    variance = float(np.sum((moved - target) ** 2)) / degrees_of_freedom
    return basis @ (np.linalg.pinv(jacobian.T @ jacobian, hermitian=True) * variance) @ basis.T
