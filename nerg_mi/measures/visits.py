"""Hits of gaze samples on AOIs, visits (dwells), and their sums per participant, cell and area."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.formats.areas import Region
from nerg_mi.maths.geometry import intersect_box_numpy
from nerg_mi.maths.vmf import tangent_frame
from nerg_mi.ranges import SECONDS, check_number
from nerg_mi.rays.filters import group_by_person
from nerg_mi.rays.rays import Rays

# ---- Hits ----
#
# AOIs are boxes, intersected in closed form, or surfaces, intersected by ray casts.
#
# A sample hits a box if it crosses the box and the first surface on the ray lies in the box: near - margin <= depth <
# far + margin, for the entry distance ``near`` and the exit distance ``far``. A larger box therefore never has fewer
# hits, boxes that tile space partition all samples that meet a surface (for a margin of 0), and a sample that crosses a
# box and ends behind it does not hit it. A sample hits a mesh or a shape if it meets it before any other surface:
# ``near`` <= depth + margin. Without surface depths, AOIs are treated as solids: an AOI occludes another one that the
# ray enters after it has left the first; AOIs that overlap along the ray are both hit.

MARGIN = 0.03  # default margin in metres, about the accuracy of surfaces in a radiance field


class Aoi(Protocol):
    """An elementary area of interest in scene coordinates. A named area consists of one or more of these."""

    @property
    def name(self) -> str:
        """Name of the area."""
        ...

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


@dataclass(frozen=True)
class HitAssignment:
    """Hits of N samples on AOIs: for each AOI the ``rows`` of the samples that hit it, and the ``distance`` at which
    they enter it.

    For a sample that starts inside an AOI, the distance is that of the surface it meets there.
    """

    count: int
    rows: tuple[np.ndarray, ...]
    distance: tuple[np.ndarray, ...]

    def to_matrix(self) -> np.ndarray:
        """Return a boolean matrix (N, K): whether each sample hits each AOI."""
        matrix = np.zeros((self.count, len(self.rows)), bool)
        for k, rows in enumerate(self.rows):
            matrix[rows, k] = True
        return matrix


def assign_hits(
    aois: Sequence[Aoi],
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


def _assign_hits_to_solids(aois: Sequence[Aoi], o: np.ndarray, d: np.ndarray, margin: float) -> HitAssignment:
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


# ---- Visits ----
#
# A *session* is a run of a participant's samples without a pause longer than `VisitRules.session_pause`. A sample
# represents the time to the next sample of its session. If that time exceeds `VisitRules.max_gap`, and at the end of a
# session, a sample represents the median step of the session (over the steps that do not exceed the gap), or zero if
# there is no such step. A *visit* of an area is a run of samples that hit it, interrupted by nothing longer than
# `VisitRules.merge_gap`. Runs shorter than `VisitRules.min_visit`, from the start of the first sample to the end of the
# last one, are discarded.


@dataclass(frozen=True)
class VisitRules:
    """Durations that define sessions and visits, in seconds. Raises `NergError` for invalid values.

    Parameters
    ----------
    max_gap
        Longest time that a sample represents.
    session_pause
        Pause that separates sessions.
    merge_gap
        Longest interruption of a visit.
    min_visit
        Shortest visit.
    """

    max_gap: float = 1.0
    session_pause: float = 60.0
    merge_gap: float = 0.15
    min_visit: float = 0.1

    def __post_init__(self) -> None:
        options = {
            parameter("max_gap"): self.max_gap,
            parameter("session_gap"): self.session_pause,
            parameter("merge_gap"): self.merge_gap,
            parameter("min_visit"): self.min_visit,
        }
        for option, value in options.items():
            check_number(value, SECONDS, option)
        if not self.session_pause >= self.max_gap > 0:
            raise NergError(
                f"{parameter('session_gap')} ({self.session_pause:g} s) must be at least {parameter('max_gap')} "
                f"({self.max_gap:g} s), which must be positive"
            )


@dataclass(frozen=True)
class Timeline:
    """N samples sorted by participant and time: ``person`` (N,) indices, ``t`` (N,) seconds, ``weight`` (N,) the
    represented time, ``session`` (N,) numbers from 0."""

    person: np.ndarray
    t: np.ndarray
    weight: np.ndarray
    session: np.ndarray


def make_timeline(person: np.ndarray, t: np.ndarray, rules: VisitRules) -> Timeline:
    """Compute sessions and represented times of samples that are sorted by participant and time.

    Raises ``ValueError`` for unsorted samples and for times that are not finite.
    """
    if not np.isfinite(t).all():
        raise ValueError("times must be finite")
    step = np.diff(t)
    same_person = np.diff(person) == 0
    if np.any(np.diff(person) < 0) or np.any(step[same_person] < 0):
        raise ValueError("samples must be sorted by participant and time")
    # A relative tolerance for times that were stored in single precision.
    is_continued = same_person & (step <= rules.session_pause * (1 + 1e-9))
    session = np.cumsum(np.r_[np.zeros(min(len(t), 1), int), ~is_continued])
    is_within_gap = is_continued & (step <= rules.max_gap * (1 + 1e-9))
    median_step = _session_medians(
        session[:-1][is_within_gap & (step > 0)],
        step[is_within_gap & (step > 0)],
        int(session[-1]) + 1 if len(t) else 0,
    )
    weight = median_step[session] if len(t) else np.zeros(0)
    weight[:-1][is_within_gap] = step[is_within_gap]
    return Timeline(person, t, weight, session)


def _session_medians(session: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Return the median of the ``values`` in each of ``count`` sessions, 0 for sessions without values."""
    medians = np.zeros(count)
    order = np.lexsort((values, session))
    number = np.bincount(session, minlength=count)
    start = np.cumsum(number) - number
    is_present = number > 0
    low, high = start[is_present] + (number[is_present] - 1) // 2, start[is_present] + number[is_present] // 2
    medians[is_present] = (values[order[low]] + values[order[high]]) / 2
    return medians


@dataclass(frozen=True)
class Visits:
    """L visits of one area, sorted by participant and time: the row of the first sample, the start and the end in
    seconds, (L,) each."""

    first: np.ndarray
    start: np.ndarray
    end: np.ndarray

    def __len__(self) -> int:
        return len(self.first)

    @property
    def duration(self) -> np.ndarray:
        return self.end - self.start


def find_visits(rows: np.ndarray, timeline: Timeline, rules: VisitRules) -> Visits:
    """Return the visits formed by the sorted ``rows`` of a timeline."""
    if not len(rows):
        return Visits(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    start, end = timeline.t[rows], timeline.t[rows] + timeline.weight[rows]
    # Compare with the end of the previous sample.
    is_gap = start[1:] - end[:-1] > rules.merge_gap + 1e-9
    is_start = np.r_[True, is_gap | (np.diff(timeline.session[rows]) != 0)]
    first = np.flatnonzero(is_start)
    last = np.r_[first[1:], len(rows)] - 1
    duration = end[last] - start[first]
    is_visit = duration >= rules.min_visit - 1e-9
    return Visits(rows[first][is_visit], start[first][is_visit], end[last][is_visit])


# ---- Sums ----
#
# Sums per participant, cell and area, which can be added up in any partition of the data.
#
# A *cell* is a subset of the data that is analysed separately: all samples, a cohort, a time window, or a zone of the
# floor. A sample may belong to several cells. `sum_visits` accepts any block of samples that contains whole sessions,
# in any order; `merge_sums` adds such sums. Added in the same order, they are bitwise equal for every partition of the
# data. Memory is proportional to participants x cells x areas, and does not depend on the number of samples.

BINS = np.array([0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0, np.inf])
"""Bin edges of the histogram of visit durations, in seconds."""


@dataclass(frozen=True)
class Cell:
    """A subset of the data: a ``dimension`` ("all", "cohort", "window" or "zone") and its ``value``."""

    dimension: str
    value: str


ALL = Cell("all", "")


@dataclass
class VisitSums:
    """Sums of R rows, each of one participant in one cell, and A areas; times are in seconds, distances in metres.

    Parameters
    ----------
    areas
        Names of the areas.
    cells
        The C cells.
    rows
        Cell and participant of each row.
    time, squared_time
        Sums of the represented times and of their squares, (R,).
    rays, sessions
        Numbers of samples and of sessions, (R,).
    dwell_time, hit_rays
        Represented time and number of the samples that hit the area, (R, A).
    distance
        Sum of represented time times hit distance, (R, A).
    visits
        Number of visits, (R, A).
    visible_time
        Represented time during which the area is visible, (R, A).
    first_visit_sum, first_visit_count
        Over sessions with a visit, the time from the first sample of the session in the cell to the first visit, and
        the number of these sessions, (R, A).
    first_start, last_end
        Start of the first visit and end of the last one, (R, A).
    duration_counts
        Histogram of visit durations over `BINS`, (C, A, bins).
    transitions
        Numbers of transitions from a visit of one area to the next visit of another one, (C, A, A).
    """

    areas: tuple[str, ...]
    cells: tuple[Cell, ...]
    rows: tuple[tuple[Cell, str], ...]
    time: np.ndarray
    squared_time: np.ndarray
    rays: np.ndarray
    sessions: np.ndarray
    dwell_time: np.ndarray
    hit_rays: np.ndarray
    distance: np.ndarray
    visits: np.ndarray
    visible_time: np.ndarray
    first_visit_sum: np.ndarray
    first_visit_count: np.ndarray
    first_start: np.ndarray
    last_end: np.ndarray
    duration_counts: np.ndarray
    transitions: np.ndarray

    @classmethod
    def empty(cls, areas: Sequence[str], cells: Sequence[Cell], rows: Sequence[tuple[Cell, str]] = ()) -> VisitSums:
        """Return zero sums with the given ``rows``."""
        R, A, C = len(rows), len(areas), len(cells)
        arrays = {name: np.zeros(R) for name in _PER_ROW} | {name: np.zeros((R, A)) for name in _PER_AREA}
        arrays["first_start"] += np.inf
        arrays["last_end"] -= np.inf
        counts, transitions = np.zeros((C, A, len(BINS) - 1)), np.zeros((C, A, A))
        return cls(tuple(areas), tuple(cells), tuple(rows), **arrays, duration_counts=counts, transitions=transitions)

    def find_participants(self, cell: Cell) -> tuple[np.ndarray, list[str]]:
        """Return the rows of a cell and the names of their participants, sorted by name."""
        rows = sorted((person, r) for r, (row_cell, person) in enumerate(self.rows) if row_cell == cell)
        return np.array([r for _, r in rows], np.int64), [person for person, _ in rows]


_PER_ROW = ("time", "squared_time", "rays", "sessions")
_PER_AREA = (
    "dwell_time",
    "hit_rays",
    "distance",
    "visits",
    "visible_time",
    "first_visit_sum",
    "first_visit_count",
    "first_start",
    "last_end",
)
_MINIMUM, _MAXIMUM = ("first_start",), ("last_end",)


class Total:
    """Running total of `VisitSums`."""

    def __init__(self, areas: Sequence[str], cells: Sequence[Cell]):
        self._areas, self._cells = tuple(areas), tuple(cells)
        self._row_of: dict[tuple[Cell, str], int] = {}
        # Grows geometrically, so that adding takes amortised time proportional to what is added.
        self._buffer = VisitSums.empty(areas, cells)
        self._capacity = 0

    def add(self, part: VisitSums) -> None:
        """Add ``part``. Raises ``ValueError`` if its areas or cells differ."""
        if (part.areas, part.cells) != (self._areas, self._cells):
            raise ValueError("sums with different areas or cells cannot be added")
        for row in part.rows:
            self._row_of.setdefault(row, len(self._row_of))
        if len(self._row_of) > self._capacity:
            self._grow(max(2 * self._capacity, len(self._row_of)))
        rows = np.array([self._row_of[row] for row in part.rows], np.int64)
        for name in (*_PER_ROW, *_PER_AREA):
            out = getattr(self._buffer, name)
            add = np.minimum if name in _MINIMUM else np.maximum if name in _MAXIMUM else np.add
            out[rows] = add(out[rows], getattr(part, name))
        self._buffer.duration_counts += part.duration_counts
        self._buffer.transitions += part.transitions

    def _grow(self, capacity: int) -> None:
        new, old = VisitSums.empty(self._areas, self._cells, [(ALL, "")] * capacity), self._buffer
        for name in (*_PER_ROW, *_PER_AREA):
            getattr(new, name)[: self._capacity] = getattr(old, name)
        new.duration_counts, new.transitions = old.duration_counts, old.transitions
        self._buffer, self._capacity = new, capacity

    def sums(self) -> VisitSums:
        """Return a view of the total so far."""
        n = len(self._row_of)
        arrays = {name: getattr(self._buffer, name)[:n] for name in (*_PER_ROW, *_PER_AREA)}
        other_arrays = dict(duration_counts=self._buffer.duration_counts, transitions=self._buffer.transitions)
        return VisitSums(self._areas, self._cells, tuple(self._row_of), **arrays, **other_arrays)


def merge_sums(sums: Iterable[VisitSums]) -> VisitSums:
    """Add one or more sums in the given order. Raises ``ValueError`` if areas or cells differ."""
    total: Total | None = None
    for part in sums:
        total = total or Total(part.areas, part.cells)
        total.add(part)
    if total is None:
        raise ValueError("at least one sum is needed")
    return total.sums()


def sum_visits(
    rays: Rays,
    hits: HitAssignment,
    areas: Sequence[str],
    cells: Sequence[tuple[Cell, np.ndarray | None]],
    rules: VisitRules,
    visibility: np.ndarray | None = None,
    transition_areas: Sequence[int] | None = None,
) -> VisitSums:
    """Sum the visits of a block of N samples that contains whole sessions.

    Parameters
    ----------
    rays
        Gaze samples in any order.
    hits
        Hits on ``areas``, by row of ``rays``.
    areas
        Names of the areas.
    cells
        Cells with a mask (N,) of their samples, or None for all samples.
    rules
        Definition of sessions and visits.
    visibility
        Whether each area is visible for each sample, (N, A); None if unknown. An area that is hit counts as visible.
    transition_areas
        Indices of the areas between which transitions are counted. Default: all.
    """
    order, _ = group_by_person(rays)
    timeline = make_timeline(rays.person[order], rays.t[order], rules)
    position = np.empty(len(order), np.int64)
    position[order] = np.arange(len(order))
    masks = [None if mask is None else mask[order] for _, mask in cells]
    keys, starts = [], []
    present = []
    for (cell, _), mask in zip(cells, masks):
        codes = np.unique(timeline.person if mask is None else timeline.person[mask])
        starts.append(len(keys))
        present.append(codes)
        keys += [(cell, rays.persons[code]) for code in codes]
    out = VisitSums.empty(areas, [cell for cell, _ in cells], keys)
    # For each cell, the row of each participant, or -1.
    tables = []
    for codes, start in zip(present, starts):
        table = np.full(len(rays.persons), -1, np.int64)
        table[codes] = start + np.arange(len(codes))
        tables.append(table)
    session_starts = [_add_rows(out, timeline, mask, table) for mask, table in zip(masks, tables)]
    visits_of_areas = []
    for a, (rows, distance) in enumerate(zip(hits.rows, hits.distance)):
        hit_rows = position[rows]
        by_row = np.argsort(hit_rows, kind="stable")
        hit_rows, hit_distance = hit_rows[by_row], distance[by_row]
        is_visible = None
        if visibility is not None:
            is_visible = visibility[order, a].copy()
            is_visible[hit_rows] = True
        visits = find_visits(hit_rows, timeline, rules)
        visits_of_areas.append(visits)
        for c, (mask, table) in enumerate(zip(masks, tables)):
            _add_area(out, a, timeline, mask, table, hit_rows, hit_distance, is_visible)
            subset = slice(None) if mask is None else mask[visits.first]
            first, start, end = visits.first[subset], visits.start[subset], visits.end[subset]
            out.duration_counts[c, a] += np.histogram(end - start, BINS)[0]
            _add_visits(out, a, timeline, table, session_starts[c], first, start, end)
    _add_transitions(
        out, timeline, masks, visits_of_areas, range(len(areas)) if transition_areas is None else transition_areas
    )
    return out


def _sum_into(out: np.ndarray, rows: np.ndarray, values: np.ndarray | float = 1.0) -> None:
    if len(rows):
        weights = np.broadcast_to(np.asarray(values, float), rows.shape)
        out += np.bincount(rows, weights=weights, minlength=len(out))


def _add_rows(out: VisitSums, timeline: Timeline, mask: np.ndarray | None, table: np.ndarray) -> np.ndarray:
    """Add the sums that do not depend on areas, and return the start of each session in the cell, infinite if it has
    no sample there."""
    row = table[timeline.person] if mask is None else table[timeline.person[mask]]
    weight, t, session = (v if mask is None else v[mask] for v in (timeline.weight, timeline.t, timeline.session))
    _sum_into(out.time, row, weight)
    _sum_into(out.squared_time, row, weight**2)
    _sum_into(out.rays, row)
    session_start = np.full(int(timeline.session[-1]) + 1 if len(timeline.t) else 0, np.inf)
    numbers, first = np.unique(session, return_index=True)
    session_start[numbers] = t[first]
    _sum_into(out.sessions, row[first])
    return session_start


def _add_area(
    out: VisitSums,
    a: int,
    timeline: Timeline,
    mask: np.ndarray | None,
    table: np.ndarray,
    hit_rows: np.ndarray,
    distance: np.ndarray,
    is_visible: np.ndarray | None,
) -> None:
    subset = slice(None) if mask is None else mask[hit_rows]
    hit_rows, distance = hit_rows[subset], distance[subset]
    row, weight = table[timeline.person[hit_rows]], timeline.weight[hit_rows]
    _sum_into(out.dwell_time[:, a], row, weight)
    _sum_into(out.hit_rays[:, a], row)
    _sum_into(out.distance[:, a], row, weight * distance)
    if is_visible is not None:
        visible_rows = np.flatnonzero(is_visible if mask is None else is_visible & mask)
        _sum_into(out.visible_time[:, a], table[timeline.person[visible_rows]], timeline.weight[visible_rows])


def _add_visits(
    out: VisitSums,
    a: int,
    timeline: Timeline,
    table: np.ndarray,
    session_start: np.ndarray,
    first: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
) -> None:
    row = table[timeline.person[first]]
    _sum_into(out.visits[:, a], row)
    np.minimum.at(out.first_start[:, a], row, start)
    np.maximum.at(out.last_end[:, a], row, end)
    session, index = np.unique(timeline.session[first], return_index=True)
    _sum_into(out.first_visit_sum[:, a], row[index], start[index] - session_start[session])
    _sum_into(out.first_visit_count[:, a], row[index])


def _add_transitions(
    out: VisitSums, timeline: Timeline, masks: list, visits_of_areas: list, transition_areas: Sequence[int]
) -> None:
    if not len(transition_areas):
        return
    first = np.concatenate([visits_of_areas[a].first for a in transition_areas])
    start = np.concatenate([visits_of_areas[a].start for a in transition_areas])
    area = np.concatenate([np.full(len(visits_of_areas[a]), a) for a in transition_areas])
    if len(first) < 2:
        return
    session = timeline.session[first]
    order = np.lexsort((area, start, session))
    first, area, session = first[order], area[order], session[order]
    is_transition = (np.diff(session) == 0) & (np.diff(area) != 0)
    for c, mask in enumerate(masks):
        # A transition belongs to the cell in which it ends.
        subset = is_transition if mask is None else is_transition & mask[first[1:]]
        np.add.at(out.transitions[c], (area[:-1][subset], area[1:][subset]), 1)
