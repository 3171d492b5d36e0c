"""From rays to visits: what each ray lands on, which rays are one look, and sums by person, cell and area."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.formats.areas import Region
from nerg_mi.maths.geometry import intersect_box_numpy
from nerg_mi.maths.vmf import tangent_frame
from nerg_mi.ranges import SECONDS, check_number
from nerg_mi.rays.filters import group_by_person
from nerg_mi.rays.rays import Rays

# ---- Landing ----
#
# Which things rays land on: boxes in closed form, whatever else by what somebody has cast, and what hides them.
#
# A ray is on a box if it crosses it and the first surface that it meets lies in the box: near - margin <= depth < far +
# margin, where it enters at ``near`` and leaves at ``far``. So a larger box never has less, boxes that fill space
# without overlap share out all rays that meet a surface (with a margin of 0), and a ray that crosses a box and ends
# behind it is not on it. A ray is on a mesh or a shape if it meets it before it meets another surface: at ``near`` <=
# depth + margin. Where no surfaces are known, things are solid: one hides another that the ray enters after it has left
# the first; things that overlap along the ray both have the look.

MARGIN = 0.03  # in metres: of surfaces that are known as exactly as a radiance field has them


class Aoi(Protocol):
    """What can be looked at, in the coordinates of the place."""

    @property
    def name(self) -> str:
        """Of its area."""
        ...

    @property
    def is_surface(self) -> bool:
        """Whether it is a surface, of which nobody is inside."""
        ...

    def interval(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``(near, far)`` (N,): where rays (N, 3) enter and leave it; ``near`` >= ``far`` where they miss it, and
        ``near`` < 0 from within. Of a surface both are its distance, and infinite where it is missed."""
        ...

    @property
    def ball(self) -> tuple[np.ndarray, float]:
        """Middle (3,) and radius of a ball around it."""
        ...

    def may_meet(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Whether rays (N, 3) may be on it (N,): they cross a box around it."""
        ...

    def sample_points(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """About ``count`` points (S, 3) spread over its surface evenly by area, and their outward normals (S, 3), zero
        where both sides are seen; always the same ones."""
        ...


@dataclass(frozen=True)
class BoxAoi:
    """A box, upright or turned."""

    region: Region
    is_surface = False

    @property
    def name(self) -> str:
        return self.region.name

    def interval(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        region = self.region
        turned = d if region.rotation is None else d @ region.rotation_matrix
        return intersect_box_numpy(region.to_local(np.asarray(o, float)), turned, *region.corners)

    @property
    def ball(self) -> tuple[np.ndarray, float]:
        lower, upper = self.region.corners
        return self.region.center, float(np.linalg.norm(upper - lower)) / 2

    def may_meet(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        near, far = self.interval(o, d)
        return (near < far) & (far > 0)

    def sample_points(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = self.region.corners
        size = upper - lower
        # An edge of the squares whose number is about the count.
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
                out = np.zeros((len(grid), 3))
                out[:, axis] = sign
                points.append(face)
                normals.append(out)
        found = np.concatenate(points), np.concatenate(normals)
        return self.region.to_world(found[0]), found[1] @ self.region.rotation_matrix.T


@dataclass(frozen=True)
class HitAssignment:
    """What N rays land on, thing by thing: the ``rows`` of those that are on it, and at which ``distance`` each enters
    it, or from within meets the surface there."""

    count: int
    rows: tuple[np.ndarray, ...]
    distance: tuple[np.ndarray, ...]

    def to_matrix(self) -> np.ndarray:
        """Whether each ray is on each thing (N, K)."""
        found = np.zeros((self.count, len(self.rows)), bool)
        for k, rows in enumerate(self.rows):
            found[rows, k] = True
        return found


def assign_hits(
    aois: Sequence[Aoi],
    o: np.ndarray,
    d: np.ndarray,
    depth: np.ndarray | None,
    margin: float = 0.0,
    among: Sequence[np.ndarray] | None = None,
) -> HitAssignment:
    """What rays (N, 3) with unit directions land on.

    ``depth`` (N,): of the surface that each meets, infinite where it meets none; None: no surfaces are known.
    ``margin``: a surface may lie so far in front of a thing, or behind the end of a box, and yet be its own.
    ``among``: of each thing the rows, rising, of the rays that may be on it; None: all.
    """
    if depth is None:
        return _land_on_solids(aois, o, d, margin)
    rows, distance = [], []
    for k, thing in enumerate(aois):
        some = slice(None) if among is None else among[k]
        near, far = thing.interval(o[some], d[some])
        reach = depth[some]
        if thing.is_surface:
            on, at = np.isfinite(near) & (near >= 0) & (near <= reach + margin), near
        else:
            ends = (near - margin <= reach) & (reach < far + margin)
            on, at = (near < far) & (far > 0) & ends & np.isfinite(reach), np.where(near < 0, reach, near)
        found = np.flatnonzero(on)
        rows.append(found if among is None else among[k][found])
        distance.append(at[found].astype(np.float64))
    return HitAssignment(len(o), tuple(rows), tuple(distance))


def _land_on_solids(things: Sequence[Aoi], o: np.ndarray, d: np.ndarray, margin: float) -> HitAssignment:
    """What rays land on where nothing is known but the things."""
    spans = [thing.interval(o, d) for thing in things]
    entered = [
        (near >= 0) & (np.isfinite(near) if thing.is_surface else near < far) for thing, (near, far) in zip(things, spans)
    ]
    reach = np.full(len(o), np.inf)
    for (_, far), met in zip(spans, entered):
        reach = np.where(met, np.minimum(reach, far), reach)
    rows = [np.flatnonzero(met & (near <= reach + margin)) for (near, _), met in zip(spans, entered)]
    return HitAssignment(len(o), tuple(rows), tuple(near[r].astype(np.float64) for (near, _), r in zip(spans, rows)))


def regroup(landed: HitAssignment, members: Sequence[tuple[int, ...]]) -> HitAssignment:
    """The same for areas that consist of some of the things each, ``members``: a ray is on an area if it is on any of
    them, at the least of their distances."""
    rows, distance = [], []
    for of in members:
        if len(of) == 1:
            rows.append(landed.rows[of[0]])
            distance.append(landed.distance[of[0]])
            continue
        every = np.concatenate([landed.rows[k] for k in of])
        far = np.concatenate([landed.distance[k] for k in of])
        order = np.lexsort((far, every))
        found, first = np.unique(every[order], return_index=True)
        rows.append(found)
        distance.append(far[order][first])
    return HitAssignment(landed.count, tuple(rows), tuple(distance))


def unite(parts: Sequence[HitAssignment]) -> HitAssignment:
    """What the same rays land on in any of several ways, such as the directions of a cone: of each thing the union of
    the rays, with the distance of the first way that has it."""
    count, things = parts[0].count, len(parts[0].rows)
    rows, distance = [], []
    for k in range(things):
        every = np.concatenate([part.rows[k] for part in parts])
        far = np.concatenate([part.distance[k] for part in parts])
        found, first = np.unique(every, return_index=True)
        rows.append(found)
        distance.append(far[first])
    return HitAssignment(count, tuple(rows), tuple(distance))


def concatenate_hits(parts: Sequence[HitAssignment]) -> HitAssignment:
    """What rays land on that follow each other."""
    starts = np.cumsum([0, *(part.count for part in parts)])
    things = len(parts[0].rows)
    rows = [np.concatenate([part.rows[k] + a for part, a in zip(parts, starts)]) for k in range(things)]
    distance = [np.concatenate([part.distance[k] for part in parts]) for k in range(things)]
    return HitAssignment(int(starts[-1]), tuple(rows), tuple(distance))


def sample_cone(d: np.ndarray, degrees: float, rings: Sequence[tuple[float, int]] = ((0.5, 6), (1.0, 12))) -> list[np.ndarray]:
    """Unit directions (N, 3) about each of ``d`` (N, 3), itself first, then so many evenly on each of the ``rings``
    (share of the angle ``degrees``, number): 19 directions that leave no hole wider than half of the angle."""
    d = np.asarray(d, float)
    u, v = tangent_frame(d)
    found = [d]
    for share, number in rings:
        angle = np.radians(degrees * share)
        for turn in 2 * np.pi * np.arange(number) / number:
            found.append(np.cos(angle) * d + np.sin(angle) * (np.cos(turn) * u + np.sin(turn) * v))
    return found


# ---- Looks ----
#
# Looks: how long each ray stands for, and which rays on a thing are one look at it.
#
# A *sitting* is a run of a person's rays without a pause of more than `VisitRules.pause`. A ray stands for the time to
# the next of its sitting, unless that is more than `VisitRules.max_gap` away: then, and at the end of a sitting, for the
# sitting's usual step (the median of those that are no longer than the gap), or for none where there is no such step. A
# *look* at a thing is a run of rays on it, in which nothing else lasts longer than `VisitRules.merge`; one that lasts
# less than `VisitRules.least` from its first ray's start to its last one's end is none.


@dataclass(frozen=True)
class VisitRules:
    """Times in seconds. Raises `NergError` for those that are no numbers, or negative."""

    max_gap: float = 1.0
    session_pause: float = 60.0
    merge_gap: float = 0.15
    min_visit: float = 0.1

    def __post_init__(self) -> None:
        for name in ("gap", "pause", "merge", "least"):
            value = getattr(self, name)
            check_number(value, SECONDS, f"--{name}")
        if not self.session_pause >= self.max_gap > 0:
            raise NergError(f"--pause ({self.session_pause:g} s) is at least --gap ({self.max_gap:g} s), which is more than 0")


@dataclass(frozen=True)
class Timeline:
    """N rays in the order of persons and times: ``person`` (N,) codes, ``t`` (N,) seconds, ``weight`` (N,) the time
    that each stands for, ``sitting`` (N,) numbers from 0."""

    person: np.ndarray
    t: np.ndarray
    weight: np.ndarray
    sitting: np.ndarray


def timeline(person: np.ndarray, t: np.ndarray, rules: VisitRules) -> Timeline:
    """That of rays in this order already. Raises ``ValueError`` where they are not, or a time is not finite."""
    if not np.isfinite(t).all():
        raise ValueError("times must be finite")
    step = np.diff(t)
    same = np.diff(person) == 0
    if np.any(np.diff(person) < 0) or np.any(step[same] < 0):
        raise ValueError("rays must be in the order of persons and times")
    # In single precision two times may be a hair apart or beyond.
    joined = same & (step <= rules.session_pause * (1 + 1e-9))
    sitting = np.cumsum(np.r_[np.zeros(min(len(t), 1), int), ~joined])
    near = joined & (step <= rules.max_gap * (1 + 1e-9))
    usual = _medians(sitting[:-1][near & (step > 0)], step[near & (step > 0)], int(sitting[-1]) + 1 if len(t) else 0)
    weight = usual[sitting] if len(t) else np.zeros(0)
    weight[:-1][near] = step[near]
    return Timeline(person, t, weight, sitting)


def _medians(of: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Median of the ``values`` of each of ``count`` sittings, 0 where there are none."""
    found = np.zeros(count)
    order = np.lexsort((values, of))
    number = np.bincount(of, minlength=count)
    start = np.cumsum(number) - number
    some = number > 0
    low, high = start[some] + (number[some] - 1) // 2, start[some] + number[some] // 2
    found[some] = (values[order[low]] + values[order[high]]) / 2
    return found


@dataclass(frozen=True)
class Visits:
    """L looks at one thing in the order of persons and times: the row of the ``first`` ray of each, when it ``start``s
    and ``end``s."""

    first: np.ndarray
    start: np.ndarray
    end: np.ndarray

    def __len__(self) -> int:
        return len(self.first)

    @property
    def duration(self) -> np.ndarray:
        return self.end - self.start


def looks_at(rows: np.ndarray, line: Timeline, rules: VisitRules) -> Visits:
    """The looks whose rays are ``rows`` of a ``line``, sorted."""
    if not len(rows):
        return Visits(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    start, end = line.t[rows], line.t[rows] + line.weight[rows]
    # The latest end so far: a ray that stands for long may outlast the next.
    apart = start[1:] - end[:-1] > rules.merge_gap + 1e-9
    new = np.r_[True, apart | (np.diff(line.sitting[rows]) != 0)]
    first = np.flatnonzero(new)
    last = np.r_[first[1:], len(rows)] - 1
    lasted = end[last] - start[first]
    kept = lasted >= rules.min_visit - 1e-9
    return Visits(rows[first][kept], start[first][kept], end[last][kept])


# ---- Sums ----
#
# What is kept of rays: sums for each person, cell and area, which can be added up in any number of parts.
#
# A *cell* is a part of the data that is looked at by itself: all of it, a cohort, a window of time, a zone of the
# floor. A ray may be of several. `partial_sums` takes any block of rays, in any order, that holds sittings as a whole;
# `merge` adds such sums. Added up in the same order they are the same to the bit, however the blocks were shared out;
# memory is that of people x cells x areas, and not of rays.

BINS = np.array([0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0, np.inf])
"""Edges of the histogram of how long looks last, in seconds."""


@dataclass(frozen=True)
class Cell:
    """A part of the data: a ``dimension`` ("all", "cohort", "window", "zone") and its ``value``."""

    dimension: str
    value: str


ALL = Cell("all", "")


@dataclass
class VisitSums:
    """R rows, each of one person in one cell, and A areas; times in seconds, distances in metres.

    ``time``, ``time2`` (R,): sums of the times that rays stand for, and of their squares; ``rays``, ``sittings``.
    ``on_time``, ``on_rays``, ``distance`` (time times distance), ``looks``, ``visible`` (time), ``first_sum`` and
    ``first_count`` (R, A): over sittings with a look, seconds from the sitting's first ray in the cell to the first
    look, and their number; ``first``, ``last``: when the first look began and the last one ended. ``lasted`` (C, A,
    bins): histogram of looks over `BINS`, of each of C ``cells``; ``moves`` (C, A, A): from looks at one thing to the
    next look, at another.
    """

    areas: tuple[str, ...]
    cells: tuple[Cell, ...]
    rows: tuple[tuple[Cell, str], ...]
    time: np.ndarray
    time2: np.ndarray
    rays: np.ndarray
    sittings: np.ndarray
    dwell_time: np.ndarray
    on_rays: np.ndarray
    distance: np.ndarray
    looks: np.ndarray
    visible_time: np.ndarray
    first_sum: np.ndarray
    first_count: np.ndarray
    first_start: np.ndarray
    last_end: np.ndarray
    lasted: np.ndarray
    transitions: np.ndarray

    @classmethod
    def empty(cls, areas: Sequence[str], cells: Sequence[Cell], rows: Sequence[tuple[Cell, str]] = ()) -> VisitSums:
        """Sums of nothing, with room for ``rows``."""
        R, A, C = len(rows), len(areas), len(cells)
        found = {name: np.zeros(R) for name in _OF_ROWS} | {name: np.zeros((R, A)) for name in _OF_AREAS}
        found["first"] += np.inf
        found["last"] -= np.inf
        lasted, moves = np.zeros((C, A, len(BINS) - 1)), np.zeros((C, A, A))
        return cls(tuple(areas), tuple(cells), tuple(rows), **found, lasted=lasted, transitions=moves)

    def find_participants(self, cell: Cell) -> tuple[np.ndarray, list[str]]:
        """The rows of a cell, and whose they are, sorted by name."""
        found = sorted((person, r) for r, (of, person) in enumerate(self.rows) if of == cell)
        return np.array([r for _, r in found], np.int64), [person for person, _ in found]


_OF_ROWS = ("time", "time2", "rays", "sittings")
_OF_AREAS = ("on_time", "on_rays", "distance", "looks", "visible", "first_sum", "first_count", "first", "last")
_LEAST, _GREATEST = ("first",), ("last",)


class Total:
    """Sums to which others are added, one after the other."""

    def __init__(self, areas: Sequence[str], cells: Sequence[Cell]):
        self._areas, self._cells = tuple(areas), tuple(cells)
        self._place: dict[tuple[Cell, str], int] = {}
        # With room for rows that come, so that adding takes as long as what is added.
        self._room = VisitSums.empty(areas, cells)
        self._held = 0

    def add(self, part: VisitSums) -> None:
        """Add ``part``. Raises ``ValueError`` where its areas or cells are others."""
        if (part.areas, part.cells) != (self._areas, self._cells):
            raise ValueError("sums of other areas or cells cannot be added")
        for row in part.rows:
            self._place.setdefault(row, len(self._place))
        if len(self._place) > self._held:
            self._grow(max(2 * self._held, len(self._place)))
        to = np.array([self._place[row] for row in part.rows], np.int64)
        for name in (*_OF_ROWS, *_OF_AREAS):
            out = getattr(self._room, name)
            add = np.minimum if name in _LEAST else np.maximum if name in _GREATEST else np.add
            out[to] = add(out[to], getattr(part, name))
        self._room.lasted += part.lasted
        self._room.transitions += part.transitions

    def _grow(self, held: int) -> None:
        room, known = VisitSums.empty(self._areas, self._cells, [(ALL, "")] * held), self._room
        for name in (*_OF_ROWS, *_OF_AREAS):
            getattr(room, name)[: self._held] = getattr(known, name)
        room.lasted, room.transitions = known.lasted, known.transitions
        self._room, self._held = room, held

    def sums(self) -> VisitSums:
        """What has been added so far; not a copy."""
        n = len(self._place)
        arrays = {name: getattr(self._room, name)[:n] for name in (*_OF_ROWS, *_OF_AREAS)}
        made = dict(lasted=self._room.lasted, moves=self._room.transitions)
        return VisitSums(self._areas, self._cells, tuple(self._place), **arrays, **made)


def merge_sums(sums: Iterable[VisitSums]) -> VisitSums:
    """The sum of one or more, in the order in which they are given. Raises ``ValueError`` where areas or cells
    differ."""
    total: Total | None = None
    for part in sums:
        total = total or Total(part.areas, part.cells)
        total.add(part)
    if total is None:
        raise ValueError("there is nothing to add up")
    return total.sums()


def partial_sums(
    rays: Rays,
    landed: HitAssignment,
    areas: Sequence[str],
    cells: Sequence[tuple[Cell, np.ndarray | None]],
    rules: VisitRules,
    visible: np.ndarray | None = None,
    movable: Sequence[int] | None = None,
) -> VisitSums:
    """The sums of a block of N ``rays`` that holds sittings as a whole.

    ``landed``: which of the ``areas`` they are on, row by row of ``rays``; ``cells``: with a mask (N,) of the rays that
    are of each, or None for all; ``visible`` (N, A): whether an area could be seen, None where nobody knows; what is
    looked at is. ``movable``: areas between which looks move, by number; default: all.
    """
    order, _ = group_by_person(rays)
    line = timeline(rays.person[order], rays.t[order], rules)
    back = np.empty(len(order), np.int64)
    back[order] = np.arange(len(order))
    masks = [None if mask is None else mask[order] for _, mask in cells]
    keys, starts = [], []
    present = []
    for (cell, _), mask in zip(cells, masks):
        codes = np.unique(line.person if mask is None else line.person[mask])
        starts.append(len(keys))
        present.append(codes)
        keys += [(cell, rays.persons[code]) for code in codes]
    out = VisitSums.empty(areas, [cell for cell, _ in cells], keys)
    # Of each cell the row of each person in it.
    tables = []
    for codes, start in zip(present, starts):
        table = np.full(len(rays.persons), -1, np.int64)
        table[codes] = start + np.arange(len(codes))
        tables.append(table)
    begins = [_add_rows(out, line, mask, table) for mask, table in zip(masks, tables)]
    found = []
    for a, (rows, distance) in enumerate(zip(landed.rows, landed.distance)):
        at = back[rows]
        sort = np.argsort(at, kind="stable")
        at, far = at[sort], distance[sort]
        seen = None
        if visible is not None:
            seen = visible[order, a].copy()
            seen[at] = True
        looks = looks_at(at, line, rules)
        found.append(looks)
        for c, (mask, table) in enumerate(zip(masks, tables)):
            _add_area(out, a, line, mask, table, at, far, seen)
            mine = slice(None) if mask is None else mask[looks.first]
            first, start, end = looks.first[mine], looks.start[mine], looks.end[mine]
            out.lasted[c, a] += np.histogram(end - start, BINS)[0]
            _add_looks(out, a, line, table, begins[c], first, start, end)
    _add_moves(out, line, masks, found, range(len(areas)) if movable is None else movable)
    return out


def _sum_into(out: np.ndarray, rows: np.ndarray, values: np.ndarray | float = 1.0) -> None:
    if len(rows):
        weights = np.broadcast_to(np.asarray(values, float), rows.shape)
        out += np.bincount(rows, weights=weights, minlength=len(out))


def _add_rows(out: VisitSums, line: Timeline, mask: np.ndarray | None, table: np.ndarray) -> np.ndarray:
    """What does not depend on areas; when each sitting begins in the cell, infinite where it does not come there."""
    row = table[line.person] if mask is None else table[line.person[mask]]
    weight, t, sitting = (v if mask is None else v[mask] for v in (line.weight, line.t, line.sitting))
    _sum_into(out.time, row, weight)
    _sum_into(out.time2, row, weight**2)
    _sum_into(out.rays, row)
    begin = np.full(int(line.sitting[-1]) + 1 if len(line.t) else 0, np.inf)
    numbers, first = np.unique(sitting, return_index=True)
    begin[numbers] = t[first]
    _sum_into(out.sittings, row[first])
    return begin


def _add_area(
    out: VisitSums,
    a: int,
    line: Timeline,
    mask: np.ndarray | None,
    table: np.ndarray,
    at: np.ndarray,
    far: np.ndarray,
    seen: np.ndarray | None,
) -> None:
    mine = slice(None) if mask is None else mask[at]
    at, far = at[mine], far[mine]
    row, weight = table[line.person[at]], line.weight[at]
    _sum_into(out.dwell_time[:, a], row, weight)
    _sum_into(out.on_rays[:, a], row)
    _sum_into(out.distance[:, a], row, weight * far)
    if seen is not None:
        some = np.flatnonzero(seen if mask is None else seen & mask)
        _sum_into(out.visible_time[:, a], table[line.person[some]], line.weight[some])


def _add_looks(
    out: VisitSums,
    a: int,
    line: Timeline,
    table: np.ndarray,
    begin: np.ndarray,
    first: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
) -> None:
    row = table[line.person[first]]
    _sum_into(out.looks[:, a], row)
    np.minimum.at(out.first_start[:, a], row, start)
    np.maximum.at(out.last_end[:, a], row, end)
    sitting, which = np.unique(line.sitting[first], return_index=True)
    _sum_into(out.first_sum[:, a], row[which], start[which] - begin[sitting])
    _sum_into(out.first_count[:, a], row[which])


def _add_moves(out: VisitSums, line: Timeline, masks: list, found: list, movable: Sequence[int]) -> None:
    if not len(movable):
        return
    first = np.concatenate([found[a].first for a in movable])
    start = np.concatenate([found[a].start for a in movable])
    thing = np.concatenate([np.full(len(found[a]), a) for a in movable])
    if len(first) < 2:
        return
    sitting = line.sitting[first]
    order = np.lexsort((thing, start, sitting))
    first, thing, sitting = first[order], thing[order], sitting[order]
    moved = (np.diff(sitting) == 0) & (np.diff(thing) != 0)
    for c, mask in enumerate(masks):
        # A move is of the cell in which it ends.
        mine = moved if mask is None else moved & mask[first[1:]]
        np.add.at(out.transitions[c], (thing[:-1][mine], thing[1:][mine]), 1)
