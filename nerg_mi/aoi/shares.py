"""Attention shares of AOIs in an observer's gaze, and visibility of AOIs.

An attention share is the part of the integral of the gaze density over all directions that hits an area. A direction
hits an AOI by the rule of `nerg_mi.aoi.placed.assign_hits`.

Integrals use equal-area directions on a Fibonacci (golden-angle) spiral. The number of directions is increased for each
area until its estimated error meets the tolerance. On a finer spiral only the directions that may hit the area are
evaluated, so that small areas cost no more than large ones, and areas that need the same spiral share its directions.
The normalising integral over the whole sphere, including directions that meet no surface, is computed in the same way.

The error is estimated from the scatter of the sums over every eighth direction, as for the integral over an observer's
sphere (`nerg_mi.transport.observer_gaze`). That estimate holds for areas that contain many directions. Directions meet
an area that is thinner than their spacing at random, or not at all. The error of an area therefore also contains
`_RANDOM_ERRORS` standard errors of random directions, times the ratio (at most 1) of the variance between the partial
sums and that of random directions, and at least the gaze of `_RANDOM_ERRORS` directions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nerg_mi.environment.sampler import DirectionQuery
from nerg_mi.errors import NergError, parameter
from nerg_mi.maths.sphere import fibonacci_directions, indices_in_cone
from nerg_mi.ranges import LENGTHS, check_number
from nerg_mi.transport.observer_gaze import ERROR_EXPONENT, ERROR_PARTS

from .placed import Aoi, assign_hits, merge_members

INITIAL_DIRECTIONS = 1 << 13  # initial number of directions over the sphere
MAX_DIRECTIONS = 1 << 24  # maximum number of directions of a spiral, a twentieth of a degree apart
MAX_BAND_DIRECTIONS = 1 << 20  # maximum number of directions among which those that may hit an area are searched
MAX_SPHERE_DIRECTIONS = 1 << 17  # maximum number of directions for the integral over the whole sphere
MIN_AOI_DIRECTIONS = 64  # minimum number of directions that may hit an area, if the spiral has as many
MAX_AOI_DIRECTIONS = 1 << 16  # number of directions that may hit an area beyond which it is not refined
_RANDOM_ERRORS = 3.0
_RAY_BATCH = 1 << 17
_SPHERE_AREA = 4 * math.pi


@dataclass(frozen=True, eq=False)
class Shares:
    """Attention shares of A areas for E observers.

    Parameters
    ----------
    share
        Attention share, (E, A).
    error
        Estimated maximum error of the share, (E, A).
    is_hit
        Whether any direction hits the area, (E, A).
    distance
        Mean distance to the area times the share, (E, A), in scene units.
    escaped
        Share of the gaze that meets no surface, (E,); NaN if surfaces are unknown.
    integral
        Integral of the gaze density over the sphere, (E,).
    members
        Attention share predicted by each member of an ensemble, (M, E, A); for a single field the share again.
    """

    share: np.ndarray
    error: np.ndarray
    is_hit: np.ndarray
    distance: np.ndarray
    escaped: np.ndarray
    integral: np.ndarray
    members: np.ndarray


@dataclass(frozen=True, kw_only=True)
class SummationRule:
    """Accuracy of the integrals: relative tolerance, absolute tolerance as a share of the gaze, and initial number
    of directions."""

    rtol: float = 1e-2
    atol: float = 1e-5
    initial_directions: int = INITIAL_DIRECTIONS


# For many areas, or for averages over many observers: maximum errors that hardly show with one decimal of a per cent.
# Usual errors are a tenth of them.
COARSE = SummationRule(rtol=0.02, atol=5e-4)


def gaze_shares(
    query_from: Callable[[np.ndarray], DirectionQuery],
    observers: np.ndarray,
    aois: Sequence[Aoi],
    members: Sequence[tuple[int, ...]],
    margin: float,
    rule: SummationRule | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> Shares:
    """Compute the attention shares of areas in the gaze of observers.

    Parameters
    ----------
    query_from
        Returns the `DirectionQuery` of an observer at a position (3,).
    observers
        Positions of the observers, (E, 3).
    aois
        Elementary AOIs.
    members
        Indices into ``aois`` of each area.
    margin
        Tolerance in scene units, as for `placed.assign_hits`.
    rule
        Accuracy of the integrals.
    on_progress
        Called with the number of observers that are done.

    Raises
    ------
    NergError
        If the gaze density is not finite.
    """
    rule = rule or SummationRule()
    observers = np.asarray(observers, float)
    blocks: list[Shares] = []
    block_size = max(1, _RAY_BATCH // rule.initial_directions)
    for a in range(0, len(observers), block_size):
        subset = observers[a : a + block_size]
        blocks.append(_AdaptiveSums(query_from, subset, aois, members, margin, rule).shares())
        if on_progress is not None:
            on_progress(a + len(subset))
    if not blocks:
        empty = np.zeros((0, len(members)))
        return Shares(empty, empty, empty.astype(bool), empty, np.zeros(0), np.zeros(0), empty[None])
    names = ("share", "error", "is_hit", "distance", "escaped", "integral")
    joined = {name: np.concatenate([getattr(f, name) for f in blocks]) for name in names}
    return Shares(**joined, members=np.concatenate([f.members for f in blocks], axis=1))


class _AdaptiveSums:
    """Adaptive integrals for some observers. The last of the A + 1 columns is the integral over the whole sphere."""

    def __init__(
        self,
        query_from: Callable[[np.ndarray], DirectionQuery],
        observers: np.ndarray,
        aois: Sequence[Aoi],
        members: Sequence[tuple[int, ...]],
        margin: float,
        rule: SummationRule,
    ):
        self.query_from, self.observers, self.aois, self.members = query_from, observers, aois, members
        self.queries: dict[int, DirectionQuery] = {}
        self.margin, self.rule = margin, rule
        E, A = len(observers), len(members)
        # Integrals over the parts of the spiral: of the mean density, then of each ensemble member.
        self.parts: np.ndarray = np.zeros((1, E, A + 1, ERROR_PARTS))
        # Sums of the squared gaze of directions that hit an area, and the maximum of those that may hit it.
        self.square, self.peak = np.zeros((E, A)), np.zeros((E, A))
        self.distance, self.escaped = np.zeros((E, A)), np.zeros(E)
        self.seen = np.zeros((E, A), bool)
        self.count = np.full((E, A + 1), rule.initial_directions)
        self.max_count = np.full((E, A + 1), MAX_SPHERE_DIRECTIONS)
        # Candidate directions of each area on its current spiral.
        self._crossing: dict[tuple[int, int], tuple[int, np.ndarray]] = {}
        for e in range(E):
            for a in range(A):
                self.max_count[e, a] = self._find_max_count(e, a)
                self.count[e, a] = self._initial_count(e, a)
        is_open = np.ones((E, A + 1), bool)
        while is_open.any():
            for count in np.unique(self.count[is_open]).tolist():
                self._sum(int(count), is_open & (self.count == count))
            is_open = self._refine(is_open)

    def shares(self) -> Shares:
        value, error = self._integrals()
        integral = value[:, :, -1]
        if not np.isfinite(value).all():
            observer = self.observers[np.flatnonzero(~np.isfinite(value).all(axis=(0, 2)))[0]]
            raise NergError(
                f"the gaze of the observer at {observer.tolist()} is not finite; move the observer into the scene"
            )
        divisor = np.where(integral > 0, integral, 1)
        share = value[:, :, :-1] / divisor[:, :, None]
        relative = error / divisor[0, :, None]
        error = np.hypot(relative[:, :-1], share[0] * relative[:, -1:])
        members = share[1:] if len(share) > 1 else share
        distance, escaped = self.distance / divisor[0, :, None], self.escaped / divisor[0]
        return Shares(share[0], error, self.seen, distance, escaped, integral[0], members)

    def _integrals(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the integrals (M, E, A + 1) and the error of the mean density's integral (E, A + 1)."""
        scatter = self.parts[0].std(axis=-1, ddof=1)
        error = scatter * ERROR_PARTS**-ERROR_EXPONENT
        # The variance of a partial sum of random directions.
        random_variance = np.maximum(ERROR_PARTS * self.square, np.finfo(float).tiny)
        variance_ratio = np.minimum(scatter[:, :-1] ** 2 / random_variance, 1)
        error[:, :-1] += _RANDOM_ERRORS * np.maximum(variance_ratio * np.sqrt(self.square), self.peak)
        return self.parts.mean(axis=-1), error

    def _refine(self, is_open: np.ndarray) -> np.ndarray:
        """Increase the number of directions of the integrals whose error exceeds the tolerance, and return their
        mask (E, A + 1)."""
        value, error = self._integrals()
        tolerance = self.rule.rtol * np.abs(value[0]) + self.rule.atol * value[0, :, -1:]
        needs_more = is_open & (error > tolerance) & (self.count < self.max_count)
        for e, a in np.argwhere(needs_more).tolist():
            # The error is roughly inversely proportional to the number of directions.
            factor = 1 << max(1, math.ceil(math.log2(error[e, a] / tolerance[e, a])))
            if a < len(self.members):
                crossing = max(1, len(self._candidate_directions(int(self.count[e, a]), e, a)))
                factor = min(factor, MAX_AOI_DIRECTIONS // crossing)
            count = min(int(self.count[e, a]) * factor, int(self.max_count[e, a]))
            needs_more[e, a] = count > self.count[e, a]
            self.count[e, a] = count
        return needs_more

    def _initial_count(self, e: int, a: int) -> int:
        """Return a number of directions of which at least `MIN_AOI_DIRECTIONS` may hit the area, or the maximum."""
        count = self.rule.initial_directions
        max_count = int(self.max_count[e, a])
        while count < max_count and (crossing := len(self._candidate_directions(count, e, a))) < MIN_AOI_DIRECTIONS:
            count = min(max_count, count << max(1, math.ceil(math.log2(MIN_AOI_DIRECTIONS / max(crossing, 0.5)))))
        return count

    def _find_max_count(self, e: int, a: int) -> int:
        """Return the maximum number of directions for an area: more for one of a smaller bounding cone."""
        sines = [
            min(radius / max(float(np.linalg.norm(center - self.observers[e])), radius, 1e-30), 1.0)
            for center, radius in (self.aois[k].bounding_sphere for k in self.members[a])
        ]
        return int(np.clip(MAX_BAND_DIRECTIONS / max(sum(sines), 1e-9), MAX_BAND_DIRECTIONS, MAX_DIRECTIONS))

    def _candidate_directions(self, count: int, e: int, a: int) -> np.ndarray:
        """Return the indices of the directions, out of ``count``, that may hit the area."""
        if self._crossing.get((e, a), (0, None))[0] == count:
            return self._crossing[e, a][1]
        candidates = []
        for k in self.members[a]:
            center, radius = self.aois[k].bounding_sphere
            to_center = center - self.observers[e]
            distance = float(np.linalg.norm(to_center))
            axis = to_center / distance if distance > 0 else np.array([0.0, 0.0, 1.0])
            numbers = indices_in_cone(
                count, axis, math.asin(min(radius / distance, 1.0)) if distance > radius else math.pi
            )
            d = fibonacci_directions(count, numbers)
            candidates.append(numbers[self.aois[k].hits_bounds(np.broadcast_to(self.observers[e], d.shape), d)])
        numbers = candidates[0] if len(candidates) == 1 else np.unique(np.concatenate(candidates))
        self._crossing[e, a] = count, numbers
        return numbers

    def _sum(self, count: int, requested: np.ndarray) -> None:
        """Evaluate the requested integrals (E, A + 1) on a spiral of ``count`` directions."""
        batch: list[_ObserverBatch] = []
        for e in np.flatnonzero(requested.any(axis=1)).tolist():
            areas = np.flatnonzero(requested[e, :-1]).tolist()
            candidates = {a: self._candidate_directions(count, e, a) for a in areas}
            if requested[e, -1]:
                numbers = np.arange(count)
            else:
                numbers = np.unique(np.concatenate(list(candidates.values())))
            d = fibonacci_directions(count, numbers)
            if not len(d):
                continue
            if e not in self.queries:
                self.queries[e] = self.query_from(self.observers[e])
            gaze, depth = self.queries[e](d)
            gaze = np.maximum(gaze, 0)
            gaze = np.concatenate([gaze.mean(axis=0)[None], gaze]) if len(gaze) > 1 else gaze
            rows = {a: np.searchsorted(numbers, n) for a, n in candidates.items()}
            batch.append(_ObserverBatch(e, numbers, d, gaze, depth, rows))
            if sum(len(b.numbers) for b in batch) >= _RAY_BATCH:
                self._add(count, batch, requested)
                batch = []
        if batch:
            self._add(count, batch, requested)

    def _add(self, count: int, batch: Sequence[_ObserverBatch], requested: np.ndarray) -> None:
        E, A = len(self.observers), len(self.members)
        gaze = np.concatenate([b.gaze for b in batch], axis=1)
        if len(gaze) != len(self.parts):
            self.parts = np.repeat(self.parts, len(gaze), axis=0)
        starts = np.cumsum([0, *(len(b.numbers) for b in batch)])
        observer = np.repeat([b.observer for b in batch], np.diff(starts))
        bin_index = observer * ERROR_PARTS + np.concatenate([b.numbers for b in batch]) % ERROR_PARTS
        # Number of directions in each part of the spiral.
        bin_size = (count - np.arange(ERROR_PARTS) + ERROR_PARTS - 1) // ERROR_PARTS
        sum_bins = lambda rows, w: (
            np.bincount(bin_index[rows], w, E * ERROR_PARTS).reshape(E, ERROR_PARTS)
            * (_SPHERE_AREA / np.maximum(bin_size, 1))
        )
        d = np.concatenate([b.directions for b in batch])
        has_depth = batch[0].depth is not None
        depth = np.concatenate([b.depth for b in batch if b.depth is not None]) if has_depth else None
        rows_of_aoi: list[list[np.ndarray]] = [[] for _ in self.aois]
        for b, start in zip(batch, starts):
            for a, rows in b.rows.items():
                for k in self.members[a]:
                    rows_of_aoi[k].append(rows + start)
        candidates = [np.unique(np.concatenate(r)) if r else np.zeros(0, np.int64) for r in rows_of_aoi]
        hits = merge_members(
            assign_hits(self.aois, self.observers[observer], d, depth, self.margin, candidates), self.members
        )
        requested = requested & np.isin(np.arange(E), [b.observer for b in batch])[:, None]
        for a in np.flatnonzero(requested[:, :A].any(axis=0)).tolist():
            mask, rows = requested[:, a], hits.rows[a]
            for m, g in enumerate(gaze):
                self.parts[m, mask, a] = sum_bins(rows, g[rows])[mask]
            direction_area = _SPHERE_AREA / count
            self.square[mask, a] = np.bincount(observer[rows], gaze[0, rows] ** 2, E)[mask] * direction_area**2
            for b in batch:
                if mask[b.observer]:
                    self.peak[b.observer, a] = b.gaze[0, b.rows[a]].max(initial=0) * direction_area
            self.seen[observer[rows], a] = True
            self.distance[mask, a] = sum_bins(rows, gaze[0, rows] * hits.distance[a]).mean(axis=1)[mask]
        mask = requested[:, A]
        if mask.any():
            all_rows = np.arange(len(observer))
            for m, g in enumerate(gaze):
                self.parts[m, mask, A] = sum_bins(all_rows, g)[mask]
            escaped_rows = all_rows[:0] if depth is None else np.flatnonzero(~np.isfinite(depth))
            self.escaped[mask] = (
                np.nan if depth is None else sum_bins(escaped_rows, gaze[0, escaped_rows]).mean(axis=1)[mask]
            )


@dataclass(frozen=True, eq=False)
class _ObserverBatch:
    """Directions of one observer with their gaze density and depth; ``rows`` are the candidate directions of each
    area."""

    observer: int
    numbers: np.ndarray
    directions: np.ndarray
    gaze: np.ndarray
    depth: np.ndarray | None
    rows: dict[int, np.ndarray]


# ---- Visibility ----
#
# An AOI is visible to an observer at p who faces direction f if one of its sample points s faces p (n · (p - s) > 0, if
# the point has a normal), lies within the field of view, (s - p) · f >= |s - p| cos(v / 2) for an angle of v degrees,
# and is not occluded.

DepthQuery = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Maps origins and unit directions (N, 3) to the distance of the first surface (N,), infinite if there is none."""

_SIGHT_BATCH = 1 << 20


@dataclass(frozen=True)
class SamplePoints:
    """Sample points on K AOIs: ``points`` and ``normals`` (S, 3), and the index of the AOI of each point (S,)."""

    points: np.ndarray
    normals: np.ndarray
    aoi_index: np.ndarray
    num_aois: int

    @classmethod
    def sample(cls, aois: Sequence[Aoi], num_points: int) -> SamplePoints:
        samples_of_aois = [thing.sample_points(num_points) for thing in aois]
        index = np.repeat(np.arange(len(aois)), [len(points) for points, _ in samples_of_aois])
        empty = np.zeros((0, 3))
        points, normals = (np.concatenate([empty, *(f[k] for f in samples_of_aois)]) for k in range(2))
        return cls(points, normals, index, len(aois))


def compute_visibility(targets: SamplePoints, observers: np.ndarray, depth: DepthQuery, margin: float) -> np.ndarray:
    """Return which of the S sample points are visible from each of E observers in any direction, (E, S) bool.

    A surface up to ``margin`` in front of a point does not occlude it.
    """
    points, normals = targets.points[None], targets.normals[None]
    return find_visible_points(points, normals, observers, lambda rows, o, d: depth(o, d), margin)


def find_visible_points(
    points: np.ndarray,
    normals: np.ndarray,
    observers: np.ndarray,
    depth: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
    margin: float,
    facing: np.ndarray | None = None,
    fov: float = 360.0,
) -> np.ndarray:
    """Return which points are visible from E observers, (E, S) bool.

    ``points`` and ``normals`` are those of all observers (1, S, 3), or of each one (E, S, 3). ``depth`` gets the
    indices of the observers before origins and directions. With directions ``facing`` (E, 3), points outside of a field
    of view of ``fov`` degrees are not visible. ``margin`` is that of `compute_visibility`.
    """
    out = np.zeros((len(observers), points.shape[1]), bool)
    min_cosine = np.cos(np.radians(min(fov, 360.0) / 2))
    block_size = max(1, _SIGHT_BATCH // max(points.shape[1], 1))
    for a in range(0, len(observers), block_size):
        part = slice(a, a + block_size)
        of_part = part if len(points) > 1 else slice(None)
        block, n = observers[part], normals[of_part]
        to_point = points[of_part] - block[:, None]
        distance = np.linalg.norm(to_point, axis=2)
        facing_term = np.einsum("esk,esk->es", to_point, n)
        is_two_sided = ~np.any(n != 0, axis=2)
        is_candidate = ((facing_term < 0) | is_two_sided) & (distance > 0)
        if facing is not None:
            is_candidate &= np.einsum("esk,ek->es", to_point, facing[part]) >= min_cosine * distance
        e, s = np.nonzero(is_candidate)
        if len(e):
            depth_along = depth(a + e, block[e], to_point[e, s] / distance[e, s][:, None])
            out[a + e, s] = depth_along >= distance[e, s] - margin
    return out


def visible_in_fov(
    targets: SamplePoints, observers: np.ndarray, facing: np.ndarray, is_visible: np.ndarray, fov: float
) -> np.ndarray:
    """Return which AOIs have a visible point in the field of view of each observer, (E, K) bool.

    ``is_visible`` are the points (E, S) that are visible in any direction.
    """
    out = np.zeros((len(observers), targets.num_aois), bool)
    min_cosine = np.cos(np.radians(min(fov, 360.0) / 2))
    starts = (
        np.flatnonzero(np.r_[True, np.diff(targets.aoi_index) != 0]) if len(targets.aoi_index) else np.zeros(0, int)
    )
    block_size = max(1, _SIGHT_BATCH // max(len(targets.points), 1))
    for a in range(0, len(observers), block_size):
        part = slice(a, a + block_size)
        block, f = observers[part], facing[part]
        # |s - p|² and (s - p) · f by products of matrices.
        along = f @ targets.points.T - np.einsum("nk,nk->n", f, block)[:, None]
        square = (targets.points**2).sum(axis=1) - 2 * block @ targets.points.T + (block**2).sum(axis=1)[:, None]
        in_fov = is_visible[part] & (along >= min_cosine * np.sqrt(np.maximum(square, 0)))
        if len(starts):
            out[part, targets.aoi_index[starts]] = np.logical_or.reduceat(in_fov, starts, axis=1)
    return out


class VisibilityCache:
    """Visibility of sample points, evaluated once per cubic cell at the cell's centre.

    The cache drops cells that are not in the current request when it exceeds its memory limit; this does not change
    results.
    """

    MAX_BYTES = 1 << 28
    """Memory limit of the cache."""

    def __init__(self, targets: SamplePoints, depth: DepthQuery, cell_size: float, margin: float):
        check_number(cell_size, LENGTHS, parameter("cell_size"))
        self._targets, self._depth, self._cell, self._margin = targets, depth, cell_size, margin
        self._visibility: dict[tuple[int, int, int], np.ndarray] = {}

    def visible_in_fov(self, observers: np.ndarray, facing: np.ndarray, fov: float) -> np.ndarray:
        """Return which AOIs are visible to each of N observers who face ``facing`` (N, 3), (N, K) bool."""
        is_visible, cell = self.get_visibility(observers)
        return visible_in_fov(self._targets, observers, facing, is_visible[cell], fov)

    def get_visibility(self, observers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the visibility of the sample points in C cells (C, S), and the cell index of each of N observers
        (N,)."""
        index = np.floor(observers / self._cell).astype(np.int64)
        cells, cell_index = np.unique(index, axis=0, return_inverse=True)
        keys = [tuple(key) for key in cells.tolist()]
        missing = [k for k, key in enumerate(keys) if key not in self._visibility]
        if len(self._visibility) * len(self._targets.points) / 8 > self.MAX_BYTES:
            self._visibility = {key: self._visibility[key] for key in keys if key in self._visibility}
        if missing:
            visibility = compute_visibility(
                self._targets, (cells[missing] + 0.5) * self._cell, self._depth, self._margin
            )
            for k, row in zip(missing, visibility):
                self._visibility[keys[k]] = np.packbits(row)
        bits = np.stack([self._visibility[key] for key in keys])
        return np.unpackbits(bits, axis=1, count=len(self._targets.points)).astype(bool), cell_index.ravel()


def find_standing_positions(
    lower: np.ndarray, upper: np.ndarray, step: float, height: float, depth: DepthQuery, floor: float
) -> np.ndarray:
    """Return positions (G, 3) at eye ``height`` on a grid, where an observer can stand on the ``floor``.

    The floor must be the surface below, and the position must not be inside a solid. A solid is detected if the surface
    above the position is the lower side of the one that a ray from the top of the scene meets.
    """
    sides = [np.arange(a + step / 2, b, step) for a, b in zip(lower[:2], upper[:2])]
    if not 0 < len(sides[0]) * len(sides[1]) <= 4_000_000:
        raise NergError(
            f"a grid of {step:g} m has {len(sides[0])} x {len(sides[1])} positions; choose another "
            f"{parameter('grid_step')}"
        )
    xy = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
    positions = np.column_stack([xy, np.full(len(xy), floor + height)])
    down, up = (np.tile(np.array([0.0, 0.0, s]), (len(positions), 1)) for s in (-1.0, 1.0))
    depth_below = depth(positions, down)
    has_floor = np.abs(depth_below - height) < max(0.1, 0.05 * height)
    depth_above = depth(positions, up)
    top = np.column_stack([xy, np.full(len(xy), float(upper[2]) - 1e-3)])
    depth_from_top = depth(top, down)
    ends, begins = positions[:, 2] + depth_above, top[:, 2] - depth_from_top
    is_inside = np.isfinite(depth_above) & (ends < upper[2] - 0.05) & (np.abs(ends - begins) < 0.02)
    return positions[has_floor & ~is_inside]
