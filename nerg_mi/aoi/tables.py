"""Attention measures and their tables: by area, cell and source, and by participant."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import combinations
from typing import Any, overload

import numpy as np

from nerg_mi.files.tables import join_reasons

from .estimates import (
    MIN_FOR_INTERVAL,
    Differences,
    Estimates,
    Pair,
    adjust_p_values,
    estimate_proportion_differences,
    estimate_proportions,
    estimate_ratio_differences,
    estimate_ratios,
)
from .visits import ALL, BINS, Cell, VisitSums

# ---- Measures: ratios of sums over participants ----


@dataclass(frozen=True, eq=False)
class Participants:
    """Sums of P participants in one cell.

    Parameters
    ----------
    names
        Names of the participants, sorted.
    time
        Recorded time in seconds, (P,).
    dwell_time, distance, visible_time
        As in `VisitSums`, (P, A); ``visible_time`` is None if visibility is unknown.
    hit_probability
        Probability that the participant visits the area at least once, (P, A); 0 or 1 for measured data.
    visits, first_visit_sum, first_visit_count
        As in `VisitSums`, (P, A); None for predictions, since a gaze field has no time course.
    in_cell
        Whether each participant has data in the cell, (P,); None: all have.
    """

    names: tuple[str, ...]
    time: np.ndarray
    dwell_time: np.ndarray
    distance: np.ndarray
    visible_time: np.ndarray | None
    hit_probability: np.ndarray
    visits: np.ndarray | None = None
    first_visit_sum: np.ndarray | None = None
    first_visit_count: np.ndarray | None = None
    in_cell: np.ndarray | None = None

    @classmethod
    def from_sums(cls, sums: VisitSums, cell: Cell, has_visibility: bool) -> Participants:
        """Select the participants of a cell; ``has_visibility``: whether visibility was computed."""
        rows, names = sums.find_participants(cell)
        return cls(
            tuple(names),
            sums.time[rows],
            sums.dwell_time[rows],
            sums.distance[rows],
            sums.visible_time[rows] if has_visibility else None,
            (sums.visits[rows] > 0).astype(float),
            sums.visits[rows],
            sums.first_visit_sum[rows],
            sums.first_visit_count[rows],
        )

    def align_to(self, names: Sequence[str]) -> Participants:
        """Return the sums with one row per name in ``names``; participants without data get zeros."""
        row_of = {name: k for k, name in enumerate(names)}
        rows = np.array([row_of[name] for name in self.names], np.int64)

        def spread(v: np.ndarray) -> np.ndarray:
            out = np.zeros((len(names), *v.shape[1:]))
            out[rows] = v
            return out

        values = {f.name: getattr(self, f.name) for f in fields(self)} | {"in_cell": self.is_in_cell.astype(float)}
        arrays = {name: spread(v) for name, v in values.items() if isinstance(v, np.ndarray)}
        return replace(self, **(arrays | {"names": tuple(names)}))

    @property
    def is_in_cell(self) -> np.ndarray:
        """Whether each participant has data in the cell, (P,) bool."""
        return np.ones(len(self.names), bool) if self.in_cell is None else self.in_cell > 0

    @property
    def has_time(self) -> np.ndarray:
        """Whether each participant has recorded time in the cell, (P, 1)."""
        return (self.time > 0)[:, None] & self.is_in_cell[:, None]

    @property
    def ones(self) -> np.ndarray:
        """Ones (P, A) for participants in the cell, zeros for others."""
        return np.repeat(self.is_in_cell[:, None], self.dwell_time.shape[1], axis=1).astype(float)


@dataclass(frozen=True, kw_only=True)
class Measure:
    """An attention measure.

    Parameters
    ----------
    name
        Key in tables.
    title
        Column header with the unit.
    definition
        Formula, for the manual.
    population
        Participants or samples over which the measure is defined, for the manual.
    numerator_denominator
        Returns the numerator and the denominator of each participant, (P, A) each; None if the data do not provide
        them.
    upper_limit
        Largest possible value.
    is_proportion
        Whether it is a proportion of participants.
    is_compared
        Whether differences between cells are tested; p-values are adjusted over all tested ones.
    needs_visibility
        Whether it is defined only where visibility is computed.
    """

    name: str
    title: str
    definition: str
    population: str
    numerator_denominator: Callable[[Participants], Pair | None]
    upper_limit: float = np.inf
    is_proportion: bool = False
    is_compared: bool = False
    needs_visibility: bool = False

    def estimate(self, people: Participants, resamples: int, seed: int) -> Estimates | None:
        """Estimate the measure of each area, with its confidence interval."""
        pair = self.numerator_denominator(people)
        if pair is None:
            return None
        x, y = pair
        binary = self.is_proportion and bool(np.isin(x, (0.0, 1.0)).all())
        return (
            estimate_proportions(x, y)
            if binary
            else estimate_ratios(x, y, resamples=resamples, seed=seed, upper_limit=self.upper_limit)
        )

    def estimate_differences(self, first: Pair, second: Pair, resamples: int, seed: int) -> Differences:
        """Estimate the ``second`` minus the ``first`` numerator over denominator, each (P, K) of the same
        participants."""
        binary = self.is_proportion and all(bool(np.isin(x, (0.0, 1.0)).all()) for x in (first[0], second[0]))
        return (
            estimate_proportion_differences(first, second)
            if binary
            else estimate_ratio_differences(first, second, resamples=resamples, seed=seed)
        )


def _share_pair(p: Participants, seconds: np.ndarray | None) -> Pair | None:
    """Numerator and denominator of the share that ``seconds`` (P, A) have in each participant's recorded time."""
    if seconds is None:
        return None
    time = np.where(p.time > 0, p.time, 1)[:, None]
    return np.where(p.has_time, seconds / time, 0), np.repeat(p.has_time, seconds.shape[1], axis=1).astype(float)


def _first_visit_pair(p: Participants) -> Pair | None:
    if p.first_visit_sum is None or p.first_visit_count is None:
        return None
    has_visit = p.first_visit_count > 0
    return np.where(has_visit, p.first_visit_sum / np.where(has_visit, p.first_visit_count, 1), 0), has_visit.astype(
        float
    )


def _revisits_pair(p: Participants) -> Pair | None:
    if p.visits is None:
        return None
    return np.maximum(p.visits - 1, 0), (p.visits > 0).astype(float)


def _unseen_pair(p: Participants) -> Pair | None:
    if p.visible_time is None:
        return None
    could_see = (p.visible_time > 0).astype(float)
    return could_see * (1 - p.hit_probability), could_see


MEASURES = (
    Measure(
        name="share",
        title="share of time",
        definition="mean of D_pk / T_p",
        population="participants with recorded time",
        numerator_denominator=lambda p: _share_pair(p, p.dwell_time),
        upper_limit=1.0,
        is_compared=True,
    ),
    Measure(
        name="dwell",
        title="dwell time [s]",
        definition="mean of D_pk",
        population="all participants",
        numerator_denominator=lambda p: (p.dwell_time, p.ones),
        is_compared=True,
    ),
    Measure(
        name="hit_ratio",
        title="hit ratio",
        definition="mean of [L_pk > 0]",
        population="all participants",
        numerator_denominator=lambda p: (p.hit_probability * p.ones, p.ones),
        upper_limit=1.0,
        is_proportion=True,
        is_compared=True,
    ),
    Measure(
        name="time_to_first_visit",
        title="time to first visit [s]",
        definition="mean over participants, and over their sessions with a visit, of the time from the first sample of "
        "the session to the start of the first visit",
        population="participants with a visit",
        numerator_denominator=_first_visit_pair,
    ),
    Measure(
        name="visits",
        title="visits",
        definition="mean of L_pk",
        population="all participants",
        numerator_denominator=lambda p: None if p.visits is None else (p.visits, p.ones),
        is_compared=True,
    ),
    Measure(
        name="revisits",
        title="revisits",
        definition="mean of L_pk - 1",
        population="participants with a visit",
        numerator_denominator=_revisits_pair,
    ),
    Measure(
        name="distance",
        title="distance [m]",
        definition="Σ w_i d_i / Σ w_i, where d_i is the distance from the observer to the point where the ray of "
        "sample i enters the AOI",
        population="samples on the AOI",
        numerator_denominator=lambda p: (p.distance, p.dwell_time),
    ),
    Measure(
        name="visible",
        title="visible share",
        definition="mean of V_pk / T_p",
        population="participants with recorded time",
        numerator_denominator=lambda p: _share_pair(p, p.visible_time),
        upper_limit=1.0,
        needs_visibility=True,
    ),
    Measure(
        name="share_when_visible",
        title="share of visible time",
        definition="Σ_p D_pk / Σ_p V_pk",
        population="participants who could see it",
        numerator_denominator=lambda p: None if p.visible_time is None else (p.dwell_time, p.visible_time),
        upper_limit=1.0,
        is_compared=True,
        needs_visibility=True,
    ),
    Measure(
        name="unseen",
        title="visible but not visited",
        definition="mean of [L_pk = 0]",
        population="participants who could see it",
        numerator_denominator=_unseen_pair,
        upper_limit=1.0,
        is_proportion=True,
        needs_visibility=True,
    ),
)
"""All measures, in the order of the table columns."""

MEASURES_BY_NAME = {measure.name: measure for measure in MEASURES}
COMPARED_MEASURES = tuple(measure.name for measure in MEASURES if measure.is_compared)


# ---- Tables ----
#
# Rows by area, cell and source, differences between cells, transitions and visit durations. Values that rest on too few
# participants are suppressed.

MEASURED, PREDICTED = "measured", "predicted"
"""Sources of a value: recorded gaze samples, and predictions of the gaze field."""

MIN_VIEWPOINTS = 16
"""Number of viewpoints per participant below which the predicted hit ratio is biased low."""

MAX_COMPARED_VALUES = 12  # maximum number of values of a dimension that are compared
Row = dict[str, Any]


@dataclass
class MinParticipantsFilter:
    """Suppresses values that rest on fewer than a minimum number of participants, and counts the suppressed values."""

    minimum: int = 1
    num_suppressed: int = field(default=0)

    @property
    def reason(self) -> str:
        """Why a value is suppressed, for notes."""
        return f"suppressed, fewer than {self.minimum} participants"

    def admit(self, num_participants: int) -> bool:
        """Return whether a value of this many participants may be shown, as may one without any; count it if not."""
        if 0 < num_participants < self.minimum:
            self.num_suppressed += 1
            return False
        return True


def aoi_rows(
    areas: Sequence[str],
    cells: Mapping[Cell, Mapping[str, Participants]],
    suppression: MinParticipantsFilter,
    *,
    resamples: int,
    seed: int,
) -> list[Row]:
    """Return a row for each cell, area and source.

    A row has the number of ``participants`` in the cell, and for each measure the value and the keys ``_low``,
    ``_high`` and ``_participants`` with the measure's name before them; unknown and suppressed values are None, and the
    ``note`` says why.
    """
    rows: list[Row] = []
    for cell, sources in cells.items():
        estimates = {s: [(m, m.estimate(people, resamples, seed)) for m in MEASURES] for s, people in sources.items()}
        for a, area in enumerate(areas):
            for source, people in sources.items():
                row: Row = {"cell": cell.dimension, "value": cell.value, "aoi": area, "source": source}
                count = int(people.is_in_cell.sum())
                row["participants"] = count if suppression.admit(count) else None
                reasons: dict[str, list[str]] = {}
                for measure, estimate in estimates[source]:
                    reason = _add_estimate(row, measure, estimate, a, suppression)
                    reasons.setdefault(reason, []).append(measure.name)
                row["note"] = join_reasons(reasons)
                rows.append(row)
    return rows


def _add_estimate(
    row: Row, measure: Measure, estimate: Estimates | None, a: int, suppression: MinParticipantsFilter
) -> str:
    """Add the estimate of a measure for the area ``a`` to ``row``. Return why it has no value or interval; "" if it
    has both."""
    keys = [measure.name + key for key in ("", "_low", "_high", "_participants")]
    row |= dict.fromkeys(keys)
    if estimate is None:
        return _NOT_COMPUTED if measure.needs_visibility else _NOT_PREDICTED
    count = int(estimate.participants[a])
    if not suppression.admit(count):
        return suppression.reason
    value, low, high = (_finite_or_none(v[a]) for v in (estimate.value, estimate.low, estimate.high))
    row |= zip(keys, (value, low, high, count))
    if value is None:
        return f"no {measure.population}"
    return NO_INTERVAL if low is None or high is None else ""


_NOT_COMPUTED, _NOT_PREDICTED = "visibility is not computed", "a gaze field has no time course"
NO_INTERVAL = f"no interval, fewer than {MIN_FOR_INTERVAL} participants with values other than 0, or equal values"


def explain_difference(row: Row, has_both: bool, suppression: MinParticipantsFilter, is_allowed: bool) -> str:
    """Return why a ``row`` has no difference, no interval or no p-value; "" if it has all."""
    if not is_allowed:
        return suppression.reason
    if row["difference"] is None:
        return "undefined, equal values" if has_both else "no participants on one side"
    reasons: dict[str, list[str]] = {"": []}
    if row["low"] is None:
        reasons[NO_INTERVAL] = ["low, high"]
    elif row["p"] is None:
        reasons["undefined, since no participant differs from the others"] = ["p"]
    return join_reasons(reasons)


def _finite_or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def difference_rows(
    areas: Sequence[str],
    cells: Mapping[Cell, Mapping[str, Participants]],
    suppression: MinParticipantsFilter,
    *,
    resamples: int,
    seed: int,
    measures: Sequence[str] = COMPARED_MEASURES,
) -> list[Row]:
    """Return measured differences between every two values of a dimension, for each area and measure.

    p-values are adjusted over all rows (``p_adjusted``); ``significant`` is true for an adjusted value of at most 0.05.
    """
    rows: list[Row] = []
    dimensions = dict.fromkeys(cell.dimension for cell in cells)
    for dimension in dimensions:
        values = [cell for cell in cells if cell.dimension == dimension and MEASURED in cells[cell]][
            :MAX_COMPARED_VALUES
        ]
        for first, second in combinations(values, 2):
            a, b = cells[first][MEASURED], cells[second][MEASURED]
            if not a.names or not b.names:
                continue
            names = sorted({*a.names, *b.names})
            pair = a.align_to(names), b.align_to(names)
            for measure in (m for m in MEASURES if m.name in measures):
                rows += _measure_differences(
                    areas, dimension, (first.value, second.value), measure, pair, suppression, resamples, seed
                )
    add_adjusted_p(rows)
    for row in rows:
        row["significant"] = row["p_adjusted"] is not None and row["p_adjusted"] <= 0.05
    return rows


def add_adjusted_p(rows: Sequence[Row]) -> None:
    """Add the p-values, adjusted over all ``rows``, as ``p_adjusted``; None for rows without one."""
    adjusted_p = adjust_p_values(np.array([np.nan if row["p"] is None else row["p"] for row in rows], float))
    for row, p in zip(rows, adjusted_p):
        row["p_adjusted"] = _finite_or_none(p)


def _measure_differences(
    areas: Sequence[str],
    dimension: str,
    values: tuple[str, str],
    measure: Measure,
    participants: tuple[Participants, Participants],
    suppression: MinParticipantsFilter,
    resamples: int,
    seed: int,
) -> list[Row]:
    first, second = (measure.numerator_denominator(p) for p in participants)
    if first is None or second is None:
        return []
    differences = measure.estimate_differences(first, second, resamples, seed)
    num_participants = np.minimum((first[1] > 0).sum(axis=0), (second[1] > 0).sum(axis=0))
    rows = []
    for a, area in enumerate(areas):
        is_allowed = suppression.admit(int(num_participants[a]))
        row: Row = {"cell": dimension, "first": values[0], "second": values[1], "aoi": area, "measure": measure.name}
        for key in ("value", "low", "high", "p"):
            row["difference" if key == "value" else key] = (
                _finite_or_none(getattr(differences, key)[a]) if is_allowed else None
            )
        row["note"] = explain_difference(row, num_participants[a] > 0, suppression, is_allowed)
        rows.append(row)
    return rows


def transition_rows(sums: VisitSums, suppression: MinParticipantsFilter) -> list[Row]:
    """Return the transitions between areas in each cell: ``from``, ``to``, the number of ``transitions``, and their
    ``share`` of all transitions from that area. The ``note`` says why they are None."""
    rows = []
    for c, cell in enumerate(sums.cells):
        num_participants = len(sums.find_participants(cell)[0])
        total = sums.transitions[c].sum(axis=1)
        for i, j in np.argwhere(sums.transitions[c] > 0):
            is_allowed = suppression.admit(num_participants)
            n = float(sums.transitions[c, i, j])
            row: Row = {"cell": cell.dimension, "value": cell.value, "from": sums.areas[i], "to": sums.areas[j]}
            row |= {"transitions": int(n) if is_allowed else None, "share": n / float(total[i]) if is_allowed else None}
            rows.append(row | {"note": "" if is_allowed else suppression.reason})
    return rows


def duration_rows(sums: VisitSums, suppression: MinParticipantsFilter) -> list[Row]:
    """Return the histogram of visit durations of each area and cell; `BINS` are in seconds. The ``note`` says why
    counts are None."""
    rows = []
    names = [f"{a:g} to {b:g} s" if np.isfinite(b) else f"{a:g} s or more" for a, b in zip(BINS[:-1], BINS[1:])]
    for c, cell in enumerate(sums.cells):
        num_participants = len(sums.find_participants(cell)[0])
        for a, area in enumerate(sums.areas):
            is_allowed = suppression.admit(num_participants)
            counts = {n: int(v) if is_allowed else None for n, v in zip(names, sums.duration_counts[c, a])}
            note = "" if is_allowed else suppression.reason
            rows.append({"cell": cell.dimension, "value": cell.value, "aoi": area, **counts, "note": note})
    return rows


def is_underestimate(row: Row, measure: str) -> bool:
    """Return whether a value is biased low: a predicted hit ratio from too few viewpoints per participant."""
    viewpoints = row.get("viewpoints")
    return (
        measure == "hit_ratio"
        and row.get(measure) is not None
        and viewpoints is not None
        and viewpoints < MIN_VIEWPOINTS
    )


def format_measure(row: Row, measure: Measure) -> str:
    """Format a value with its interval and, after ±, its standard deviation over the members of an ensemble.

    Shares are in percent, small ones with two decimals. Values that are biased low are marked.
    """
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
    return (
        f"{text} (biased low: {row['viewpoints']:.1f} viewpoints per participant)"
        if is_underestimate(row, measure.name)
        else text
    )


# ---- Participants ----
#
# The table of single participants, whose rows are created when they are read.


class ParticipantRows(Sequence[Row]):
    """A row for each participant and area, over all data, sorted by the participants' displayed names.

    Rows are created on access, so that the table of many participants needs no memory in addition to ``sums``. A row
    has the keys ``participant``, ``aoi``, ``time`` in seconds, ``samples``, and for the area ``dwell`` in seconds,
    ``visits``, ``time_to_first_visit`` and ``visible`` in seconds; values that are undefined or unknown are None, and
    the ``note`` says why.

    Parameters
    ----------
    sums
        Sums of all participants.
    names
        Displayed name of each participant.
    has_visibility
        Whether visibility was computed.
    """

    columns = ("participant", "aoi", "time", "samples", "dwell", "visits", "time_to_first_visit", "visible", "note")

    def __init__(self, sums: VisitSums, names: Mapping[str, str], has_visibility: bool):
        rows, persons = sums.find_participants(ALL)
        self._sorted_rows = sorted((names[person], r) for person, r in zip(persons, rows.tolist()))
        self._sums, self._has_visibility = sums, has_visibility

    def __len__(self) -> int:
        return len(self._sorted_rows) * len(self._sums.areas)

    @overload
    def __getitem__(self, index: int) -> Row: ...
    @overload
    def __getitem__(self, index: slice) -> list[Row]: ...
    def __getitem__(self, index: int | slice) -> Row | list[Row]:
        if isinstance(index, slice):
            return [self._row(k) for k in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(f"row {index} is out of range for {len(self):,} rows")
        return self._row(index % len(self))

    def __iter__(self) -> Iterator[Row]:
        return map(self._row, range(len(self)))

    def _row(self, k: int) -> Row:
        s = self._sums
        (name, r), a = self._sorted_rows[k // len(s.areas)], k % len(s.areas)
        first_visit: Any = None
        reasons = {"" if s.visits[r, a] > 0 else "no visit": ["time_to_first_visit"]}
        reasons.setdefault("" if self._has_visibility else _NOT_COMPUTED, []).append("visible")
        if s.visits[r, a] > 0:
            first_visit = float(s.first_visit_sum[r, a] / s.first_visit_count[r, a])
        return {
            "participant": name,
            "aoi": s.areas[a],
            "time": float(s.time[r]),
            "samples": int(s.rays[r]),
            "dwell": float(s.dwell_time[r, a]),
            "visits": int(s.visits[r, a]),
            "time_to_first_visit": first_visit,
            "visible": float(s.visible_time[r, a]) if self._has_visibility else None,
            "note": join_reasons(reasons),
        }
