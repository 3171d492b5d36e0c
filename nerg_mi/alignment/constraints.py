"""What an alignment is found from: kinds of evidence, and surfaces of a place as points and as distances on a
lattice."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt, label

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.files.safe_read import read_npy
from nerg_mi.formats.meshes import READERS, read_mesh_file
from nerg_mi.maths.coordinates import check_coordinates, check_near_origin
from nerg_mi.maths.sphere import sample_uniform_directions
from nerg_mi.photos.posed import read_semidense
from nerg_mi.rays.readers.tables import iterate_table, read_table_columns
from nerg_mi.transport.geometry import SceneGeometry, trace_depth
from nerg_mi.transport.medium import Medium

from .similarity import Chart, transform_points

# ---- Grid ----
#
# Distances on a lattice, between whose points they are interpolated trilinearly, with derivatives in closed form.


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """``values`` (nx, ny, nz) at ``lower + step * (i, j, k)``; beyond the lattice the distance to it is added."""

    values: np.ndarray
    lower: np.ndarray
    step: float

    @property
    def upper(self) -> np.ndarray:
        """The last point (3,) of the lattice."""
        return self.lower + self.step * (np.array(self.values.shape) - 1)

    def interpolate(self, points: np.ndarray) -> np.ndarray:
        """Distances (N,) of ``points`` (N, 3)."""
        return self.with_slope(points)[0]

    def with_slope(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (N,) of ``points`` (N, 3), and their gradients (N, 3)."""
        last = np.array(self.values.shape) - 1
        u = (points - self.lower) / self.step
        held = np.clip(u, 0, last)
        cell = np.minimum(held.astype(np.int64), np.maximum(last - 1, 0))
        f = held - cell
        strides = np.array([self.values.shape[1] * self.values.shape[2], self.values.shape[2], 1])
        first, flat = cell @ strides, self.values.reshape(-1)
        # A lattice of one layer has no second point.
        to_next = strides * (last > 0)
        v = [[[flat[first + to_next @ np.array((i, j, k))] for k in (0, 1)] for j in (0, 1)] for i in (0, 1)]
        x, y, z = f.T
        # Along z, then y, then x: on each line the slope is the difference of its ends.
        on_z = [[(1 - z) * v[i][j][0] + z * v[i][j][1] for j in (0, 1)] for i in (0, 1)]
        by_z = [[v[i][j][1] - v[i][j][0] for j in (0, 1)] for i in (0, 1)]
        on_y = [(1 - y) * on_z[i][0] + y * on_z[i][1] for i in (0, 1)]
        value = (1 - x) * on_y[0] + x * on_y[1]
        slope = np.empty((len(points), 3))
        slope[:, 0] = on_y[1] - on_y[0]
        slope[:, 1] = (1 - x) * (on_z[0][1] - on_z[0][0]) + x * (on_z[1][1] - on_z[1][0])
        along = [(1 - y) * by_z[i][0] + y * by_z[i][1] for i in (0, 1)]
        slope[:, 2] = (1 - x) * along[0] + x * along[1]
        slope /= self.step
        beyond = self.step * (u - held)
        far = np.linalg.norm(beyond, axis=1)
        out = far > 0
        slope[out] = np.where(beyond[out] != 0, beyond[out] / far[out, None], slope[out])
        return value + far, slope


# ---- Surfaces in files, as points: meshes and clouds (PLY, OBJ), tables (CSV, Project Aria's too), arrays (.npy) ----

SUFFIXES = (*READERS, ".csv", ".csv.gz", ".npy")  # Files that are read
POINTS = 200_000  # Points that are taken of a mesh, evenly by area, or of a larger cloud


def read_surface(path: Path, count: int = POINTS, on_note: Callable[[str], None] = lambda note: None) -> np.ndarray:
    """At most ``count`` points (N, 3) on the surface in ``path``, in its own frame and units; drawn at random, with the
    same result every time. ``on_note`` is called with sentences on what of the file is not used. Raises `NergError` for
    a file without finite points, or with some beyond all places."""
    if not path.name.lower().endswith(SUFFIXES):
        raise NergError(f'"{path}" is no surface that is read; give a mesh or points in {", ".join(SUFFIXES)}')
    if not path.exists():
        raise MissingFile(f'there is no surface "{path}"; correct its name')
    if path.name.lower().endswith((".csv", ".csv.gz")):
        points = _table(path)
    elif path.suffix.lower() == ".npy":
        points = _array(path)
    else:
        mesh = read_mesh_file(path, allow_points=True)
        points = _sampled(mesh.vertices, mesh.faces, count)
        for note in mesh.notes:
            on_note(f"of {path}: {note}")
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise NergError(f'the surface "{path}" has no points; export it again')
    check_coordinates(points, f'the points of "{path}"')
    check_near_origin(points, f'the surface "{path}"')
    rng = np.random.default_rng(0)
    return points if len(points) <= count else points[np.sort(rng.permutation(len(points))[:count])]


def _table(path: Path) -> np.ndarray:
    if "px_world" in read_table_columns(path):
        return read_semidense(path).astype(np.float64)
    blocks = [b.numbers for b in iterate_table(path, ("x", "y", "z"))]
    return np.concatenate(blocks) if blocks else np.zeros((0, 3))


def _array(path: Path) -> np.ndarray:
    points = read_npy(path, "surface")
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise NergError(f'the surface "{path}" holds an array of shape {points.shape}; it must be (N, 3) numbers')
    return points.astype(np.float64)


def _sampled(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Points on triangles, evenly by area; the vertices where there are none."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    with np.errstate(over="ignore", invalid="ignore"):
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    area = np.where(np.isfinite(area), area, 0)
    if not area.sum() > 0:
        return vertices
    rng = np.random.default_rng(0)
    which = rng.choice(len(faces), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    fold = u + v > 1
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    return a[which] + u * (b[which] - a[which]) + v * (c[which] - a[which])


# ---- A place as alignments see it: points on its surfaces, where people can be, and the distances to both ----
#
# What rays end on is a surface, and what they pass on their way is free. Insides of hollow things are reached by rays
# that begin there; they are pockets that no passage leads to, and count as solid.

NUM_RAYS = 150_000  # Rays by which a place is traced
VOXELS = 1 << 20  # Voxels of its lattice, about
_SURFACE_OPACITY = 0.5
# Voxels around the place; a pocket has less than this share of the room of the largest.
_PAD, _POCKET = 3, 0.2


@dataclass(frozen=True, eq=False)
class SceneTraces:
    """What rays found of a place: they ``begin`` and ``end``, (N, 3), the latter on surfaces where ``met`` (N,)."""

    start: np.ndarray
    end: np.ndarray
    is_hit: np.ndarray

    def transform(self, matrix: np.ndarray) -> SceneTraces:
        """The same in another frame, to which ``matrix`` (4, 4) leads."""
        return SceneTraces(transform_points(matrix, self.start), transform_points(matrix, self.end), self.is_hit)


@dataclass(frozen=True, eq=False)
class PlaceSurface:
    """``points`` (M, 3) on surfaces, one a voxel; ``distance`` to the nearest of them and ``blocked``, the distance to
    free space (0 within), both in units of the place; ``lower`` corner and ``step`` of the voxels; ``bounded``: whether
    free space is known, which it is not of bare points."""

    points: np.ndarray
    distance: DistanceGrid
    blocked: DistanceGrid
    bounded: bool

    @property
    def step(self) -> float:
        """Edge of a voxel."""
        return self.distance.step

    @property
    def diagonal(self) -> float:
        """Of the box around the points, but for the two percent at either end of each axis."""
        return float(np.linalg.norm(np.subtract(*np.percentile(self.points, [98, 2], axis=0))))

    def find_floor(self) -> float:
        """Height of the floor, z up: the lowest level that holds a good share of the points."""
        z = self.points[:, 2]
        low, high = np.percentile(z, [0.5, 99.5])
        edges = np.arange(low - 2 * self.step, high + 2 * self.step, self.step)
        if len(edges) < 3:
            return float(low)
        count = np.histogram(z, edges)[0]
        # A level may lie on the edge between two bins.
        count = np.convolve(count, [1, 1])[: len(edges) - 1]
        k = int(np.flatnonzero(count >= 0.3 * count[: max(1, len(count) // 2)].max())[0])
        while k + 1 < len(count) and count[k + 1] > count[k]:
            k += 1
        near = z[(z >= edges[max(k - 1, 0)]) & (z <= edges[k + 1])]
        return float(np.median(near)) if len(near) else float(edges[k])


def trace_scene(
    subject: Medium | SceneGeometry, lower: np.ndarray, upper: np.ndarray, num_rays: int = NUM_RAYS, seed: int = 0
) -> SceneTraces:
    """Trace ``rays`` from all over the box between two corners of a place. Raises `NergError` where none meets
    anything."""
    rng = np.random.default_rng(seed)
    begin = rng.uniform(lower, upper, (num_rays, 3))
    along = sample_uniform_directions(num_rays, rng)
    depth, opacity = trace_depth(subject, begin, along)
    met = opacity >= _SURFACE_OPACITY
    if met.mean() < 1e-3:
        raise NergError("the place has no surfaces that rays could meet, so that nothing can be aligned with it")
    far = np.linalg.norm(np.subtract(upper, lower))
    return SceneTraces(begin, begin + along * np.where(met, depth, far)[:, None], met)


def surface_of_traces(traces: SceneTraces, voxels: int = VOXELS) -> PlaceSurface:
    """The surface that rays have met."""
    points = traces.end[traces.is_hit]
    box = np.percentile(points, [0.2, 99.8], axis=0)
    lower, step, shape = _lattice(box[0], box[1], voxels)
    length = np.linalg.norm(traces.end - traces.start, axis=1)
    # Rays that end where they begin began in something solid.
    real = length > 1.5 * step
    solid, means = _voxels(traces.end[traces.is_hit & real], lower, step, shape)
    passed = np.zeros(shape, bool)
    begin, way, length = traces.start[real], (traces.end - traces.start)[real], length[real]
    for t in np.arange(0, min(length.max(initial=0), float(np.linalg.norm(box[1] - box[0]))), 0.8 * step):
        on = length - 0.7 * step > t
        _mark(passed, begin[on] + way[on] * (t / length[on, None]), lower, step)
    # Rays leave gaps of a voxel between them.
    passed = np.asarray(binary_dilation(passed), bool) & ~solid
    return _finished(means, solid, _reachable(passed), lower, step, True)


def surface_of_points(points: np.ndarray, voxels: int = VOXELS) -> PlaceSurface:
    """The surface that bare ``points`` (N, 3) lie on: what is free between them is not known. Raises `NergError` for
    too few of them."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        raise NergError(f"the place has {len(points)} points, and 100 or more are needed to align anything with it")
    box = np.percentile(points, [0.2, 99.8], axis=0)
    lower, step, shape = _lattice(box[0], box[1], voxels)
    solid, means = _voxels(points, lower, step, shape)
    return _finished(means, solid, ~solid, lower, step, False)


def downsample(points: np.ndarray, step: float) -> np.ndarray:
    """One point, the mean, of each voxel of edge ``step``: points that are evenly dense on their surfaces."""
    index = np.floor((points - points.min(axis=0)) / step).astype(np.int64)
    _, where, count = np.unique(index, axis=0, return_inverse=True, return_counts=True)
    where = where.reshape(-1)
    return np.stack([np.bincount(where, c) / count for c in points.T], axis=1)


def _lattice(low: np.ndarray, high: np.ndarray, voxels: int) -> tuple[np.ndarray, float, tuple[int, int, int]]:
    size = np.maximum(high - low, 1e-3 * float(np.max(high - low)))
    if not size.max() > 0:
        raise NergError("the place is a single point, so that nothing can be aligned with it")
    # At most so many along an axis: a flat place is no reason for voxels of no size.
    step = max(float(np.cbrt(np.prod(size) / voxels)), float(size.max()) / 512)
    shape = np.ceil(size / step).astype(int) + 2 * _PAD
    return low - _PAD * step, step, (int(shape[0]), int(shape[1]), int(shape[2]))


def _mark(out: np.ndarray, points: np.ndarray, lower: np.ndarray, step: float) -> None:
    index = np.floor((points - lower) / step).astype(int)
    inside = ((index >= 0) & (index < out.shape)).all(axis=1)
    out[tuple(index[inside].T)] = True


def _voxels(points: np.ndarray, lower: np.ndarray, step: float, shape) -> tuple[np.ndarray, np.ndarray]:
    """Voxels that hold a point, and the mean of those in each: (nx, ny, nz) bool and (nx, ny, nz, 3), NaN elsewhere."""
    index = np.floor((points - lower) / step).astype(int)
    inside = ((index >= 0) & (index < shape)).all(axis=1)
    flat = np.ravel_multi_index(tuple(index[inside].T), shape)
    count = np.bincount(flat, minlength=int(np.prod(shape)))
    sums = [np.bincount(flat, c, minlength=len(count)) for c in points[inside].T]
    with np.errstate(invalid="ignore"):
        means = np.stack(sums, axis=1) / count[:, None]
    return (count > 0).reshape(shape), means.reshape(*shape, 3)


def _reachable(passed: np.ndarray) -> np.ndarray:
    """What of the voxels that rays ``passed`` is no pocket."""
    core = binary_erosion(passed)
    parts = np.asarray(label(core)[0], np.int64)  # pyright: ignore[reportIndexIssue] # the stubs know no outputs
    size = np.bincount(parts.reshape(-1))[1:]
    if not len(size):
        return passed
    kept = np.concatenate([[False], size >= _POCKET * size.max()])[parts]
    return np.asarray(binary_dilation(kept, iterations=2), bool) & passed


def _finished(means, solid, free, lower, step, bounded: bool) -> PlaceSurface:
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in solid.shape), indexing="ij"), axis=-1)
    nodes = lower + step * (nodes + 0.5)
    index = np.asarray(distance_transform_edt(~solid, return_distances=False, return_indices=True))
    to_surface = np.linalg.norm(nodes - means[tuple(index)], axis=-1)
    blocked = distance_transform_edt(~free) if free.any() else np.zeros(solid.shape)
    # From the middle of a voxel to the edge of the free one.
    blocked = np.maximum(np.asarray(blocked) - 0.5, 0) * step
    first = lower + 0.5 * step
    grids = [DistanceGrid(np.ascontiguousarray(v, np.float64), first, step) for v in (to_surface, blocked)]
    return PlaceSurface(means[solid], grids[0], grids[1], bounded)


# ---- What an alignment is found from: one file a kind, each a class that fulfils `Evidence` ----
#
# Another kind is another such file, and a line where the job chooses among them (`nerg_mi.workflows.align`).

Progress = Callable[[float, str], None]  # Told of a share of the work that is done, and of what is being done


@dataclass(frozen=True, eq=False)
class AlignmentTarget:
    """The place that tracking is aligned with, and what is known beforehand.

    ``traces``: what rays found of it, or ``points`` (N, 3) on its surfaces; neither where only its frame is needed.
    ``turn``: (4, 4) rotation from its frame to one in which z is up; ``upright``: whether that is known, so that the
    tracking's z stays up; ``floor``: height of the floor in the tracking, metres, None where it is not known;
    ``place_floor``: that of the place, along its up, None: to be found; ``scale``: units of the place a unit of the
    tracking, None: to be found.
    """

    traces: SceneTraces | None = None
    points: np.ndarray | None = None
    to_z_up: np.ndarray = field(default_factory=lambda: np.eye(4))
    is_upright: bool = True
    tracking_floor: float | None = 0.0
    scene_floor: float | None = None
    scale: float | None = None

    @cached_property
    def surface(self) -> PlaceSurface:
        """Its surface, z up. Raises `NergError` where no place was given."""
        if self.traces is not None:
            return surface_of_traces(self.traces.transform(self.to_z_up))
        if self.points is not None:
            return surface_of_points(transform_points(self.to_z_up, self.points))
        raise NergError(
            "this evidence needs the place itself: give --field FILE, --scene FILE or --surface FILE (a mesh or points)"
        )

    @property
    def place_level(self) -> float:
        """Height of the place's floor, z up."""
        return self.surface.find_floor() if self.scene_floor is None else self.scene_floor

    def to_place(self, matrix: np.ndarray) -> np.ndarray:
        """A similarity that leads to the place turned z up, as one that leads to the place."""
        return np.linalg.inv(self.to_z_up) @ matrix


@dataclass(frozen=True, eq=False)
class AlignmentFit:
    """An alignment that was found.

    ``matrix``: (4, 4) from the tracking to the place. ``centimetres`` (N,) and ``degrees`` (M,): residuals, in metres
    of the tracking times 100, and as angles; ``covariance`` (7, 7) of rotation vector, translation (place's units) and
    logarithm of the scale, None where it is not known; ``mirrored``: a sentence where a mirrored frame fits better;
    ``points``: of the tracking (N, 3), to be drawn; ``targets``: where those belong in the place, (N, 3) or None;
    ``about``: what else is recorded (JSON); ``notes``: what is told; ``doubts``: what is told as a warning.
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


class Evidence(Protocol):
    """One kind of evidence for an alignment."""

    @property
    def kind(self) -> str:
        """Its name, as alignment.json has it."""
        ...

    def fit(self, target: AlignmentTarget, progress: Progress) -> AlignmentFit:
        """The similarity from the tracking to the place of ``target``. Raises `NergError` where the evidence leaves it
        open, saying what would settle it."""
        ...


def mirror_sentence(what: str, mirrored: float, declared: float) -> str:
    """That ``what`` happens is so many metres nearer where the tracking is mirrored than as it was declared."""
    return f"with the x axis negated {what} to {100 * mirrored:.3g} cm, as declared to {100 * declared:.3g} cm only"


def angles_between(viewpoint: np.ndarray, at: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Angles in degrees (N,) between points ``at`` and ``to``, both (N, 3), as seen from ``viewpoint``, (3,) or (N, 3);
    those nearer than a millionth of the farthest are left out."""
    a, b = at - viewpoint, to - viewpoint
    length = np.minimum(np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1))
    seen = length > 1e-6 * max(float(length.max(initial=0)), 1e-300)
    a, b = a[seen], b[seen]
    # By both products: the arc of a cosine loses small angles.
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))


def pair_covariance(source: np.ndarray, target: np.ndarray, matrix: np.ndarray, basis: np.ndarray) -> np.ndarray | None:
    """Covariance (7, 7) of a least-squares fit of points to points, from its normal equations, about the points' mean;
    None where there are no more points than numbers to be found."""
    chart = Chart(matrix, transform_points(matrix, source).mean(axis=0), basis)
    start = np.zeros(chart.size)
    moved = chart.transform(start, source)
    by = np.concatenate([chart.pulled(start, moved, np.broadcast_to(e, moved.shape)) for e in np.eye(3)])
    free = by.shape[0] - chart.size
    if free < 1:
        return None
    variance = float(np.sum((moved - target) ** 2)) / free
    return basis @ (np.linalg.pinv(by.T @ by, hermitian=True) * variance) @ basis.T
