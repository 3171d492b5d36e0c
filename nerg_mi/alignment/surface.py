"""A place as alignments see it: points on its surfaces, where people can be, and the distances to both.

What rays end on is a surface, and what they pass on their way is free. Insides of hollow things are reached by rays
that begin there; they are pockets that no passage leads to, and count as solid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt, label

from nerg_mi.errors import NergError
from nerg_mi.maths.sphere import uniform_directions
from nerg_mi.transport.media.protocol import Medium
from nerg_mi.transport.place import Place
from nerg_mi.transport.trace import trace_depth

from .grid import DistanceGrid
from .umeyama import move

RAYS = 150_000
"""Rays by which a place is traced."""

VOXELS = 1 << 20
"""Voxels of its lattice, about."""

_SURFACE_OPACITY = 0.5
# Voxels around the place; a pocket has less than this share of the room of the largest.
_PAD, _POCKET = 3, 0.2


@dataclass(frozen=True, eq=False)
class PlaceTraces:
    """What rays found of a place: they ``begin`` and ``end``, (N, 3), the latter on surfaces where ``met`` (N,)."""

    begin: np.ndarray
    end: np.ndarray
    met: np.ndarray

    def moved(self, matrix: np.ndarray) -> PlaceTraces:
        """The same in another frame, to which ``matrix`` (4, 4) leads."""
        return PlaceTraces(move(matrix, self.begin), move(matrix, self.end), self.met)


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

    def floor(self) -> float:
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


def trace_place(
    subject: Medium | Place, lower: np.ndarray, upper: np.ndarray, rays: int = RAYS, seed: int = 0
) -> PlaceTraces:
    """Trace ``rays`` from all over the box between two corners of a place. Raises `NergError` where none meets
    anything."""
    rng = np.random.default_rng(seed)
    begin = rng.uniform(lower, upper, (rays, 3))
    along = uniform_directions(rays, rng)
    depth, opacity = trace_depth(subject, begin, along)
    met = opacity >= _SURFACE_OPACITY
    if met.mean() < 1e-3:
        raise NergError("the place has no surfaces that rays could meet, so that nothing can be aligned with it")
    far = np.linalg.norm(np.subtract(upper, lower))
    return PlaceTraces(begin, begin + along * np.where(met, depth, far)[:, None], met)


def surface_of_traces(traces: PlaceTraces, voxels: int = VOXELS) -> PlaceSurface:
    """The surface that rays have met."""
    points = traces.end[traces.met]
    box = np.percentile(points, [0.2, 99.8], axis=0)
    lower, step, shape = _lattice(box[0], box[1], voxels)
    length = np.linalg.norm(traces.end - traces.begin, axis=1)
    # Rays that end where they begin began in something solid.
    real = length > 1.5 * step
    solid, means = _voxels(traces.end[traces.met & real], lower, step, shape)
    passed = np.zeros(shape, bool)
    begin, way, length = traces.begin[real], (traces.end - traces.begin)[real], length[real]
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


def thinned(points: np.ndarray, step: float) -> np.ndarray:
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
