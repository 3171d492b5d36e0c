"""Visits (dwells) of gaze samples, and their sums per participant, cell and area."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nerg_mi.tracking.rays import Rays

from .placed import HitAssignment
from .settings import VisitRules

# ---- Visits ----
#
# A *session* is a run of a participant's samples without a pause longer than `VisitRules.session_gap`. A sample
# represents the time to the next sample of its session. If that time exceeds `VisitRules.max_gap`, and at the end of a
# session, a sample represents the median step of the session (over the steps that do not exceed the gap), or zero if
# there is no such step. A *visit* of an area is a run of samples that hit it, interrupted by nothing longer than
# `VisitRules.merge_gap`. Runs shorter than `VisitRules.min_visit`, from the start of the first sample to the end of the
# last one, are discarded.


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
    is_continued = same_person & (step <= rules.session_gap * (1 + 1e-9))
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


def _measure_rounding(t: np.ndarray) -> np.ndarray:
    """Return a bound on the error of differences of times ``t`` in seconds, which may count from 1970."""
    return 1e-9 + 4 * np.spacing(np.abs(t))


def find_visits(rows: np.ndarray, timeline: Timeline, rules: VisitRules) -> Visits:
    """Return the visits formed by the sorted ``rows`` of a timeline."""
    if not len(rows):
        return Visits(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    start, end = timeline.t[rows], timeline.t[rows] + timeline.weight[rows]
    # Compare with the end of the previous sample.
    is_gap = start[1:] - end[:-1] > rules.merge_gap + _measure_rounding(start[1:])
    is_start = np.r_[True, is_gap | (np.diff(timeline.session[rows]) != 0)]
    first = np.flatnonzero(is_start)
    last = np.r_[first[1:], len(rows)] - 1
    duration = end[last] - start[first]
    is_visit = duration >= rules.min_visit - _measure_rounding(end[last])
    return Visits(rows[first][is_visit], start[first][is_visit], end[last][is_visit])


# ---- Sums ----
#
# Sums per participant, cell and area, which can be added up in any partition of the data.
#
# A *cell* is a subset of the data that is analysed separately: all samples, a cohort, a time window, or a zone of the
# floor. A sample may belong to several cells. `sum_visits` accepts any block of samples that contains whole sessions;
# `merge_sums` adds such sums. Added in the same order, they are bitwise equal for every partition of the
# data. Memory is proportional to participants x cells x areas, and does not depend on the number of samples.

BINS = np.array([0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0, np.inf])
"""Bin edges of the histogram of visit durations, in seconds."""


@dataclass(frozen=True)
class Cell:
    """A subset of the data: a ``dimension`` ("all", "cohort", "window" or "zone") and its ``value``.

    ``draw``: number of the random error that was added to its samples; 0: they are as recorded.
    """

    dimension: str
    value: str
    draw: int = 0


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
    time
        Represented time, (R,).
    rays
        Number of samples, (R,).
    dwell_time
        Represented time of the samples that hit the area, (R, A).
    distance
        Sum of represented time times hit distance, (R, A).
    visits
        Number of visits, (R, A).
    visible_time
        Represented time during which the area is visible, (R, A).
    first_visit_sum, first_visit_count
        Over sessions with a visit, the time from the first sample of the session in the cell to the first visit, and
        the number of these sessions, (R, A).
    duration_counts
        Histogram of visit durations over `BINS`, (C, A, bins).
    transitions
        Numbers of transitions from a visit of one area to the next visit of another one, (C, A, A).
    """

    areas: tuple[str, ...]
    cells: tuple[Cell, ...]
    rows: tuple[tuple[Cell, str], ...]
    time: np.ndarray
    rays: np.ndarray
    dwell_time: np.ndarray
    distance: np.ndarray
    visits: np.ndarray
    visible_time: np.ndarray
    first_visit_sum: np.ndarray
    first_visit_count: np.ndarray
    duration_counts: np.ndarray
    transitions: np.ndarray

    @classmethod
    def empty(cls, areas: Sequence[str], cells: Sequence[Cell], rows: Sequence[tuple[Cell, str]] = ()) -> VisitSums:
        """Return zero sums with the given ``rows``."""
        R, A, C = len(rows), len(areas), len(cells)
        arrays = {name: np.zeros(R) for name in _PER_ROW} | {name: np.zeros((R, A)) for name in _PER_AREA}
        counts, transitions = np.zeros((C, A, len(BINS) - 1)), np.zeros((C, A, A))
        return cls(tuple(areas), tuple(cells), tuple(rows), **arrays, duration_counts=counts, transitions=transitions)

    def find_participants(self, cell: Cell) -> tuple[np.ndarray, list[str]]:
        """Return the rows of a cell and the names of their participants, sorted by name."""
        rows = sorted((person, r) for r, (row_cell, person) in enumerate(self.rows) if row_cell == cell)
        return np.array([r for _, r in rows], np.int64), [person for person, _ in rows]

    def select_draw(self, draw: int) -> VisitSums:
        """Return the sums of the cells with ``draw``, as those of samples without an added error."""
        cells = [k for k, cell in enumerate(self.cells) if cell.draw == draw]
        rows = [k for k, (cell, _) in enumerate(self.rows) if cell.draw == draw]
        return replace(
            self,
            cells=tuple(replace(self.cells[k], draw=0) for k in cells),
            rows=tuple((replace(self.rows[k][0], draw=0), self.rows[k][1]) for k in rows),
            **{name: getattr(self, name)[rows] for name in (*_PER_ROW, *_PER_AREA)},
            **{name: getattr(self, name)[cells] for name in _PER_CELL},
        )


_PER_ROW = ("time", "rays")
_PER_AREA = ("dwell_time", "distance", "visits", "visible_time", "first_visit_sum", "first_visit_count")
_PER_CELL = ("duration_counts", "transitions")


def join_cells(parts: Sequence[VisitSums]) -> VisitSums:
    """Return the sums of different cells of the same samples as one."""
    first, arrays = parts[0], (*_PER_ROW, *_PER_AREA, *_PER_CELL)
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in arrays}
    return replace(
        first,
        cells=tuple(cell for part in parts for cell in part.cells),
        rows=tuple(row for part in parts for row in part.rows),
        **joined,
    )


def merge_sums(sums: Iterable[VisitSums]) -> VisitSums:
    """Add one or more sums in the given order. Raises ``ValueError`` if areas or cells differ."""
    total: VisitSums | None = None
    row_of: dict[tuple[Cell, str], int] = {}
    for part in sums:
        total = total or VisitSums.empty(part.areas, part.cells)
        if (part.areas, part.cells) != (total.areas, total.cells):
            raise ValueError("sums with different areas or cells cannot be added")
        for row in part.rows:
            row_of.setdefault(row, len(row_of))
        if len(row_of) > len(total.time):
            # Grows geometrically, so that adding takes amortised time proportional to what is added.
            larger = VisitSums.empty(total.areas, total.cells, [(ALL, "")] * 2 * len(row_of))
            for name in (*_PER_ROW, *_PER_AREA):
                getattr(larger, name)[: len(total.time)] = getattr(total, name)
            total = replace(larger, duration_counts=total.duration_counts, transitions=total.transitions)
        rows = np.array([row_of[row] for row in part.rows], np.int64)
        for name in (*_PER_ROW, *_PER_AREA):
            getattr(total, name)[rows] += getattr(part, name)
        total.duration_counts += part.duration_counts
        total.transitions += part.transitions
    if total is None:
        raise ValueError("at least one sum is needed")
    used = {name: getattr(total, name)[: len(row_of)] for name in (*_PER_ROW, *_PER_AREA)}
    return replace(total, rows=tuple(row_of), **used)


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
        Gaze samples, sorted by participant and time.
    hits
        Hits on ``areas``, by ascending row of ``rays``.
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
    timeline = make_timeline(rays.person, rays.t, rules)
    masks = [mask for _, mask in cells]
    keys: list[tuple[Cell, str]] = []
    tables = []  # for each cell, the row of each participant, or -1
    for cell, mask in cells:
        codes = np.unique(timeline.person if mask is None else timeline.person[mask])
        table = np.full(len(rays.persons), -1, np.int64)
        table[codes] = len(keys) + np.arange(len(codes))
        tables.append(table)
        keys += [(cell, rays.persons[code]) for code in codes]
    out = VisitSums.empty(areas, [cell for cell, _ in cells], keys)
    session_starts = [_add_rows(out, timeline, mask, table) for mask, table in zip(masks, tables)]
    visits_of_areas = []
    for a, (hit_rows, hit_distance) in enumerate(zip(hits.rows, hits.distance)):
        is_visible = None
        if visibility is not None:
            is_visible = visibility[:, a].copy()
            is_visible[hit_rows] = True
        visits = find_visits(hit_rows, timeline, rules)
        visits_of_areas.append(visits)
        for c, (mask, table) in enumerate(zip(masks, tables)):
            _add_area(out, a, timeline, mask, table, hit_rows, hit_distance, is_visible)
            subset = slice(None) if mask is None else mask[visits.first]
            first, start, end = visits.first[subset], visits.start[subset], visits.end[subset]
            # Visits of whole sampling intervals may last exactly as long as a bin's edge.
            out.duration_counts[c, a] += np.histogram(end - start + _measure_rounding(end), BINS)[0]
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
    _sum_into(out.rays, row)
    session_start = np.full(int(timeline.session[-1]) + 1 if len(timeline.t) else 0, np.inf)
    numbers, first = np.unique(session, return_index=True)
    session_start[numbers] = t[first]
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
