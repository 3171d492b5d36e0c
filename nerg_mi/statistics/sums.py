"""What is kept of rays: sums for each person, cell and area, which can be added up in any number of parts.

A *cell* is a part of the data that is looked at by itself: all of it, a cohort, a window of time, a zone of the floor.
A ray may be of several. `partial_sums` takes any block of rays, in any order, that holds sittings as a whole; `merge`
adds such sums. Added up in the same order they are the same to the bit, however the blocks were shared out; memory is
that of people x cells x areas, and not of rays.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import numpy as np

from nerg_mi.rays.filters import person_order
from nerg_mi.rays.rays import Rays

from .landing import Landed
from .looks import LookRules, Timeline, looks_at, timeline

BINS = np.array([0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0, np.inf])
"""Edges of the histogram of how long looks last, in seconds."""


@dataclass(frozen=True)
class Cell:
    """A part of the data: a ``dimension`` ("all", "cohort", "window", "zone") and its ``value``."""

    dimension: str
    value: str


ALL = Cell("all", "")


@dataclass
class Sums:
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
    on_time: np.ndarray
    on_rays: np.ndarray
    distance: np.ndarray
    looks: np.ndarray
    visible: np.ndarray
    first_sum: np.ndarray
    first_count: np.ndarray
    first: np.ndarray
    last: np.ndarray
    lasted: np.ndarray
    moves: np.ndarray

    @classmethod
    def empty(cls, areas: Sequence[str], cells: Sequence[Cell], rows: Sequence[tuple[Cell, str]] = ()) -> Sums:
        """Sums of nothing, with room for ``rows``."""
        R, A, C = len(rows), len(areas), len(cells)
        found = {name: np.zeros(R) for name in _OF_ROWS} | {name: np.zeros((R, A)) for name in _OF_AREAS}
        found["first"] += np.inf
        found["last"] -= np.inf
        lasted, moves = np.zeros((C, A, len(BINS) - 1)), np.zeros((C, A, A))
        return cls(tuple(areas), tuple(cells), tuple(rows), **found, lasted=lasted, moves=moves)

    @property
    def nbytes(self) -> int:
        """Memory of the arrays."""
        return sum(v.nbytes for f in fields(self) if isinstance(v := getattr(self, f.name), np.ndarray))

    def persons_of(self, cell: Cell) -> tuple[np.ndarray, list[str]]:
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
        self._room = Sums.empty(areas, cells)
        self._held = 0

    def add(self, part: Sums) -> None:
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
        self._room.moves += part.moves

    def _grow(self, held: int) -> None:
        room, known = Sums.empty(self._areas, self._cells, [(ALL, "")] * held), self._room
        for name in (*_OF_ROWS, *_OF_AREAS):
            getattr(room, name)[: self._held] = getattr(known, name)
        room.lasted, room.moves = known.lasted, known.moves
        self._room, self._held = room, held

    def sums(self) -> Sums:
        """What has been added so far; not a copy."""
        n = len(self._place)
        arrays = {name: getattr(self._room, name)[:n] for name in (*_OF_ROWS, *_OF_AREAS)}
        made = dict(lasted=self._room.lasted, moves=self._room.moves)
        return Sums(self._areas, self._cells, tuple(self._place), **arrays, **made)


def merge(sums: Iterable[Sums]) -> Sums:
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
    landed: Landed,
    areas: Sequence[str],
    cells: Sequence[tuple[Cell, np.ndarray | None]],
    rules: LookRules,
    visible: np.ndarray | None = None,
    movable: Sequence[int] | None = None,
) -> Sums:
    """The sums of a block of N ``rays`` that holds sittings as a whole.

    ``landed``: which of the ``areas`` they are on, row by row of ``rays``; ``cells``: with a mask (N,) of the rays that
    are of each, or None for all; ``visible`` (N, A): whether an area could be seen, None where nobody knows; what is
    looked at is. ``movable``: areas between which looks move, by number; default: all.
    """
    order, _ = person_order(rays)
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
    out = Sums.empty(areas, [cell for cell, _ in cells], keys)
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


def _add_rows(out: Sums, line: Timeline, mask: np.ndarray | None, table: np.ndarray) -> np.ndarray:
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
    out: Sums,
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
    _sum_into(out.on_time[:, a], row, weight)
    _sum_into(out.on_rays[:, a], row)
    _sum_into(out.distance[:, a], row, weight * far)
    if seen is not None:
        some = np.flatnonzero(seen if mask is None else seen & mask)
        _sum_into(out.visible[:, a], table[line.person[some]], line.weight[some])


def _add_looks(
    out: Sums,
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
    np.minimum.at(out.first[:, a], row, start)
    np.maximum.at(out.last[:, a], row, end)
    sitting, which = np.unique(line.sitting[first], return_index=True)
    _sum_into(out.first_sum[:, a], row[which], start[which] - begin[sitting])
    _sum_into(out.first_count[:, a], row[which])


def _add_moves(out: Sums, line: Timeline, masks: list, found: list, movable: Sequence[int]) -> None:
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
        np.add.at(out.moves[c], (thing[:-1][mine], thing[1:][mine]), 1)
