"""Measures of attention and the tables of them: by area, cell and source, and of single people."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import combinations
from typing import Any, overload

import numpy as np

from .estimates import Estimates, adjust_p_values, estimate_proportion_differences, estimate_proportions, estimate_ratio_differences, estimate_ratios
from .visits import ALL, BINS, Cell, VisitSums

# ---- The numbers that are told of things, each a ratio of sums over people (`intervals`) ----


@dataclass(frozen=True, eq=False)
class Participants:
    """The sums of P people in one cell.

    ``names``, sorted; ``time`` (P,) seconds; the others (P, A), as `VisitSums` has them. ``looks``, ``first_sum`` and
    ``first_count`` are None where nobody was tracked, as a field does not tell them; ``reached``: how probable it is
    that each looked at all, 0 or 1 where they were tracked; ``present`` (P,): who is of the cell, None for all.
    """

    names: tuple[str, ...]
    time: np.ndarray
    dwell_time: np.ndarray
    distance: np.ndarray
    visible_time: np.ndarray | None
    hit_probability: np.ndarray
    looks: np.ndarray | None = None
    first_sum: np.ndarray | None = None
    first_count: np.ndarray | None = None
    present: np.ndarray | None = None

    @classmethod
    def from_sums(cls, sums: VisitSums, cell: Cell, has_visibility: bool) -> Participants:
        """Those of a cell; ``seen``: whether it is known what they could see."""
        rows, names = sums.find_participants(cell)
        return cls(
            tuple(names),
            sums.time[rows],
            sums.dwell_time[rows],
            sums.distance[rows],
            sums.visible_time[rows] if has_visibility else None,
            (sums.looks[rows] > 0).astype(float),
            sums.looks[rows],
            sums.first_sum[rows],
            sums.first_count[rows],
        )

    def aligned(self, names: Sequence[str]) -> Participants:
        """The same with a row for each of ``names``, of whom those who are not there have nothing."""
        place = {name: k for k, name in enumerate(names)}
        to = np.array([place[name] for name in self.names], np.int64)

        def spread(v: np.ndarray) -> np.ndarray:
            out = np.zeros((len(names), *v.shape[1:]))
            out[to] = v
            return out

        given = {f.name: getattr(self, f.name) for f in fields(self)} | {"present": self.is_in_cell.astype(float)}
        made = {name: spread(v) for name, v in given.items() if isinstance(v, np.ndarray)}
        return replace(self, **(made | {"names": tuple(names)}))

    @property
    def is_in_cell(self) -> np.ndarray:
        """Who is of the cell at all (P,) bool."""
        return np.ones(len(self.names), bool) if self.present is None else self.present > 0

    @property
    def timed(self) -> np.ndarray:
        """Of whom there is any time (P, 1)."""
        return (self.time > 0)[:, None] & self.is_in_cell[:, None]

    @property
    def everybody(self) -> np.ndarray:
        """(P, A) ones for those who are there."""
        return np.repeat(self.is_in_cell[:, None], self.dwell_time.shape[1], axis=1).astype(float)


Pair = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Measure:
    """A number: its ``name`` in tables, a ``title`` with its unit, its ``definition`` and the people ``over`` whom it
    is, for the manual; ``pair``: its numerator and denominator (P, A) for each person, None where the people's sums do
    not tell it; ``most``: the greatest that it can be; whether it is a share of people (``counts``), and whether its
    differences between cells are told (``compared``)."""

    name: str
    title: str
    definition: str
    population: str
    numerator_denominator: Callable[[Participants], Pair | None]
    upper_limit: float = np.inf
    is_proportion: bool = False
    is_compared: bool = False

    def estimate(self, people: Participants, resamples: int, seed: int) -> Estimates | None:
        """The number of each area, with its interval."""
        pair = self.numerator_denominator(people)
        if pair is None:
            return None
        x, y = pair
        binary = self.is_proportion and bool(np.isin(x, (0.0, 1.0)).all())
        return estimate_proportions(x, y) if binary else estimate_ratios(x, y, resamples=resamples, seed=seed, upper_limit=self.upper_limit)


def _share(p: Participants, seconds: np.ndarray | None) -> Pair | None:
    """The share that ``seconds`` (P, A) are of each participant's time."""
    if seconds is None:
        return None
    time = np.where(p.time > 0, p.time, 1)[:, None]
    return np.where(p.timed, seconds / time, 0), np.repeat(p.timed, seconds.shape[1], axis=1).astype(float)


def _first(p: Participants) -> Pair | None:
    if p.first_sum is None or p.first_count is None:
        return None
    some = p.first_count > 0
    return np.where(some, p.first_sum / np.where(some, p.first_count, 1), 0), some.astype(float)


def _returns(p: Participants) -> Pair | None:
    if p.looks is None:
        return None
    return np.maximum(p.looks - 1, 0), (p.looks > 0).astype(float)


def _unseen(p: Participants) -> Pair | None:
    if p.visible_time is None:
        return None
    could = (p.visible_time > 0).astype(float)
    return could * (1 - p.hit_probability), could


MEASURES = (
    Measure(
        name="share",
        title="share of time",
        definition="mean of D_pk / T_p",
        population="people with time",
        numerator_denominator=lambda p: _share(p, p.dwell_time),
        upper_limit=1.0,
        is_compared=True,
    ),
    Measure(
        name="dwell",
        title="dwell [s]",
        definition="mean of D_pk",
        population="all people",
        numerator_denominator=lambda p: (p.dwell_time, p.everybody),
        is_compared=True,
    ),
    Measure(
        name="reach",
        title="reach",
        definition="mean of [L_pk > 0]",
        population="all people",
        numerator_denominator=lambda p: (p.hit_probability * p.everybody, p.everybody),
        upper_limit=1.0,
        is_proportion=True,
        is_compared=True,
    ),
    Measure(
        name="first_look",
        title="first look [s]",
        definition="mean over people, and over each one's sittings with a look, of seconds from its first ray to the "
        "look",
        population="who looked",
        numerator_denominator=_first,
    ),
    Measure(
        name="looks",
        title="looks",
        definition="mean of L_pk",
        population="all people",
        numerator_denominator=lambda p: None if p.looks is None else (p.looks, p.everybody),
        is_compared=True,
    ),
    Measure(name="returns", title="returns", definition="mean of L_pk - 1", population="who looked", numerator_denominator=_returns),
    Measure(
        name="distance",
        title="distance [m]",
        definition="Σ w_i d_i / Σ w_i, from the eye to where the ray enters the thing",
        population="rays on it",
        numerator_denominator=lambda p: (p.distance, p.dwell_time),
    ),
    Measure(
        name="visible",
        title="visible share",
        definition="mean of V_pk / T_p",
        population="people with time",
        numerator_denominator=lambda p: _share(p, p.visible_time),
        upper_limit=1.0,
    ),
    Measure(
        name="given_visible",
        title="looked at, given visible",
        definition="Σ_p D_pk / Σ_p V_pk",
        population="who could see it",
        numerator_denominator=lambda p: None if p.visible_time is None else (p.dwell_time, p.visible_time),
        upper_limit=1.0,
        is_compared=True,
    ),
    Measure(
        name="unseen",
        title="visible but unseen",
        definition="mean of [L_pk = 0]",
        population="who could see it",
        numerator_denominator=_unseen,
        upper_limit=1.0,
        is_proportion=True,
    ),
)
"""All, in the order of tables."""

MEASURES_BY_NAME = {measure.name: measure for measure in MEASURES}
COMPARED_MEASURES = tuple(measure.name for measure in MEASURES if measure.is_compared)


# ---- Tables ----
#
# Tables of numbers: things by cell and source, differences, moves, durations; with a floor on people.

MEASURED, PREDICTED = "tracked", "field"
"""Sources of numbers: rays that were recorded, and what the gaze field foretells."""

MIN_VIEWPOINTS = 16
"""From so many places a person a field should be asked for their reach: from fewer it comes out too low."""

MOST_VALUES = 12  # so many values of a dimension are compared with each other
Row = dict[str, Any]


@dataclass
class MinParticipantsFilter:
    """Blanks numbers that rest on fewer than ``least`` people, and counts those that were."""

    minimum: int = 1
    num_suppressed: int = field(default=0)

    def passes(self, num_participants: int) -> bool:
        """Whether a number of so many people may be told; one of nobody is nobody's secret."""
        if 0 < num_participants < self.minimum:
            self.num_suppressed += 1
            return False
        return True


def aoi_rows(
    areas: Sequence[str],
    cells: Mapping[Cell, Mapping[str, Participants]],
    min_participants: MinParticipantsFilter,
    *,
    resamples: int,
    seed: int,
) -> list[Row]:
    """A row for each cell, area and source: ``people`` in the cell, and of each measure its value, ``_low``, ``_high``
    and ``_people``, None where it is not known or blanked."""
    rows: list[Row] = []
    for cell, sources in cells.items():
        found: dict[str, list[Row]] = {}
        for source, people in sources.items():
            estimates = {m.name: m.estimate(people, resamples, seed) for m in MEASURES}
            count = int(people.is_in_cell.sum())
            found[source] = []
            for a, area in enumerate(areas):
                row: Row = {"cell": cell.dimension, "value": cell.value, "thing": area, "source": source}
                row["people"] = count if min_participants.passes(count) else None
                for name, e in estimates.items():
                    told = e is not None and min_participants.passes(int(e.participants[a]))
                    for key in ("", "_low", "_high"):
                        row[name + key] = _number(getattr(e, key[1:] or "value")[a]) if told else None
                    row[name + "_people"] = int(e.participants[a]) if e is not None and told else None
                found[source].append(row)
        rows += [found[source][a] for a in range(len(areas)) for source in sources]
    return rows


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def difference_rows(
    areas: Sequence[str],
    cells: Mapping[Cell, Mapping[str, Participants]],
    min_participants: MinParticipantsFilter,
    *,
    source: str = MEASURED,
    resamples: int,
    seed: int,
    compared: Sequence[str] = COMPARED_MEASURES,
) -> list[Row]:
    """Differences between every two values of a dimension, of each area and measure, with p-values that are adjusted
    over all rows (``p_adjusted``), and ``found``: whether that is at most 0.05."""
    rows: list[Row] = []
    dimensions = dict.fromkeys(cell.dimension for cell in cells)
    for dimension in dimensions:
        values = [cell for cell in cells if cell.dimension == dimension and source in cells[cell]][:MOST_VALUES]
        for first, second in combinations(values, 2):
            a, b = cells[first][source], cells[second][source]
            if not a.names or not b.names:
                continue
            names = sorted({*a.names, *b.names})
            pair = a.aligned(names), b.aligned(names)
            for measure in (m for m in MEASURES if m.name in compared):
                rows += _differences(
                    areas, dimension, (first.value, second.value), measure, pair, min_participants, resamples, seed
                )
    corrected = adjust_p_values(np.array([np.nan if row["p"] is None else row["p"] for row in rows], float))
    for row, p in zip(rows, corrected):
        row["p_adjusted"] = _number(p)
        row["found"] = bool(p <= 0.05)
    return rows


def _differences(
    areas: Sequence[str],
    dimension: str,
    values: tuple[str, str],
    measure: Measure,
    people: tuple[Participants, Participants],
    floor: MinParticipantsFilter,
    resamples: int,
    seed: int,
) -> list[Row]:
    first, second = (measure.numerator_denominator(p) for p in people)
    if first is None or second is None:
        return []
    if measure.is_proportion:
        found = estimate_proportion_differences(first, second)
    else:
        found = estimate_ratio_differences(first, second, resamples=resamples, seed=seed)
    least = np.minimum((first[1] > 0).sum(axis=0), (second[1] > 0).sum(axis=0))
    rows = []
    for a, area in enumerate(areas):
        told = floor.passes(int(least[a]))
        row: Row = {"cell": dimension, "first": values[0], "second": values[1], "thing": area, "measure": measure.name}
        for key in ("value", "low", "high", "p"):
            row["difference" if key == "value" else key] = _number(getattr(found, key)[a]) if told else None
        rows.append(row)
    return rows


def transition_rows(sums: VisitSums, min_participants: MinParticipantsFilter) -> list[Row]:
    """Moves between things of each cell: ``from``, ``to``, how many ``moves``, and their ``share`` of those from
    there."""
    rows = []
    for c, cell in enumerate(sums.cells):
        people = len(sums.find_participants(cell)[0])
        total = sums.transitions[c].sum(axis=1)
        for i, j in np.argwhere(sums.transitions[c] > 0):
            told = min_participants.passes(people)
            n = float(sums.transitions[c, i, j])
            row: Row = {"cell": cell.dimension, "value": cell.value, "from": sums.areas[i], "to": sums.areas[j]}
            rows.append(row | {"moves": int(n) if told else None, "share": n / float(total[i]) if told else None})
    return rows


def duration_rows(sums: VisitSums, min_participants: MinParticipantsFilter) -> list[Row]:
    """How many looks at each area last how long, of each cell; `BINS` in seconds."""
    rows = []
    names = [f"{a:g} to {b:g} s" if np.isfinite(b) else f"{a:g} s or more" for a, b in zip(BINS[:-1], BINS[1:])]
    for c, cell in enumerate(sums.cells):
        people = len(sums.find_participants(cell)[0])
        for a, area in enumerate(sums.areas):
            told = min_participants.passes(people)
            counts = {n: int(v) if told else None for n, v in zip(names, sums.lasted[c, a])}
            rows.append({"cell": cell.dimension, "value": cell.value, "thing": area, **counts})
    return rows


def is_too_low(row: Row, measure: str) -> bool:
    """Whether a number comes out too low: the reach by a field that was asked from few ``places`` a person."""
    places = row.get("places")
    return measure == "reach" and row.get(measure) is not None and places is not None and places < MIN_VIEWPOINTS


def format_measure(row: Row, measure: Measure) -> str:
    """A value with its interval as Markdown has it, and, after ±, its spread over the members of an ensemble: shares in
    percent, small ones with two digits behind the point. What comes out too low says so."""
    value = row.get(measure.name)
    if value is None:
        return ""
    scale, digits = (100.0, 2 if 0 < value < 0.01 else 1) if measure.upper_limit == 1.0 else (1.0, 2)
    text = f"{scale * value:.{digits}f}" + (" %" if scale > 1 else "")
    low, high = row.get(measure.name + "_low"), row.get(measure.name + "_high")
    if low is not None and high is not None:
        text += f" [{scale * low:.{digits}f}, {scale * high:.{digits}f}]"
    spread = row.get(measure.name + "_spread")
    text = text if spread is None else text + f" ± {scale * spread:.{digits}f}"
    return f"{text} (too low: {row['places']:.1f} places a person)" if is_too_low(row, measure.name) else text


# ---- Persons ----
#
# The table of single people: each one's own sums of each area, made row by row as it is read.


class ParticipantRows(Sequence[Row]):
    """A row for each person and area, over all that was recorded, in the order of the people's names.

    Rows are made when they are asked for, so that the table of a quarter of a million people takes no memory beside
    the ``sums``. ``names``: what each person is called; ``seen``: whether it is known what they could see. A row:
    ``person``, ``thing``, ``time`` in seconds, ``rays``, and of the area ``dwell`` in seconds, ``looks``,
    ``first_look`` and ``visible`` in seconds, None where there is no look and where nobody knows.
    """

    columns = ("person", "thing", "time", "rays", "dwell", "looks", "first_look", "visible")

    def __init__(self, sums: VisitSums, names: Mapping[str, str], has_visibility: bool):
        rows, persons = sums.find_participants(ALL)
        self._of = sorted((names[person], r) for person, r in zip(persons, rows.tolist()))
        self._sums, self._seen = sums, has_visibility

    def __len__(self) -> int:
        return len(self._of) * len(self._sums.areas)

    @overload
    def __getitem__(self, index: int) -> Row: ...
    @overload
    def __getitem__(self, index: slice) -> list[Row]: ...
    def __getitem__(self, index: int | slice) -> Row | list[Row]:
        if isinstance(index, slice):
            return [self._row(k) for k in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(f"row {index} of {len(self):,}")
        return self._row(index % len(self))

    def __iter__(self) -> Iterator[Row]:
        return map(self._row, range(len(self)))

    def _row(self, k: int) -> Row:
        s = self._sums
        (name, r), a = self._of[k // len(s.areas)], k % len(s.areas)
        first: Any = None
        if s.looks[r, a] > 0:
            first = float(s.first_sum[r, a] / s.first_count[r, a])
        return {
            "person": name,
            "thing": s.areas[a],
            "time": float(s.time[r]),
            "rays": int(s.rays[r]),
            "dwell": float(s.dwell_time[r, a]),
            "looks": int(s.looks[r, a]),
            "first_look": first,
            "visible": float(s.visible_time[r, a]) if self._seen else None,
        }
