"""Tables of numbers: things by cell and source, differences, moves, durations; with a floor on people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from .estimates import adjusted
from .intervals import ratio_differences
from .measures import MEASURES, Measure, People
from .proportions import proportion_differences
from .sums import BINS, Cell, Sums

TRACKED, FIELD = "tracked", "field"
"""Sources of numbers: rays that were recorded, and what the gaze field foretells."""

PLACES = 16
"""From so many places a person a field should be asked for their reach: from fewer it comes out too low."""

COMPARED = ("share", "dwell", "reach", "looks", "given_visible")
"""Measures of which differences are told."""

MOST_VALUES = 12
"""So many values of a dimension are compared with each other."""

Row = dict[str, Any]


@dataclass
class Floor:
    """Blanks numbers that rest on fewer than ``least`` people, and counts those that were."""

    least: int = 1
    blanked: int = field(default=0)

    def passes(self, people: int) -> bool:
        """Whether a number of so many people may be told; one of nobody is nobody's secret."""
        if 0 < people < self.least:
            self.blanked += 1
            return False
        return True


def thing_rows(
    areas: Sequence[str], cells: Mapping[Cell, Mapping[str, People]], floor: Floor, *, resamples: int, seed: int
) -> list[Row]:
    """A row for each cell, area and source: ``people`` in the cell, and of each measure its value, ``_low``, ``_high``
    and ``_people``, None where it is not known or blanked."""
    rows: list[Row] = []
    for cell, sources in cells.items():
        found: dict[str, list[Row]] = {}
        for source, people in sources.items():
            estimates = {m.name: m.estimate(people, resamples, seed) for m in MEASURES}
            count = int(people.there.sum())
            found[source] = []
            for a, area in enumerate(areas):
                row: Row = {"cell": cell.dimension, "value": cell.value, "thing": area, "source": source}
                row["people"] = count if floor.passes(count) else None
                for name, e in estimates.items():
                    told = e is not None and floor.passes(int(e.people[a]))
                    for key in ("", "_low", "_high"):
                        row[name + key] = _number(getattr(e, key[1:] or "value")[a]) if told else None
                    row[name + "_people"] = int(e.people[a]) if e is not None and told else None
                found[source].append(row)
        rows += [found[source][a] for a in range(len(areas)) for source in sources]
    return rows


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def difference_rows(
    areas: Sequence[str],
    cells: Mapping[Cell, Mapping[str, People]],
    floor: Floor,
    *,
    source: str = TRACKED,
    resamples: int,
    seed: int,
    compared: Sequence[str] = COMPARED,
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
                    areas, dimension, (first.value, second.value), measure, pair, floor, resamples, seed
                )
    corrected = adjusted(np.array([np.nan if row["p"] is None else row["p"] for row in rows], float))
    for row, p in zip(rows, corrected):
        row["p_adjusted"] = _number(p)
        row["found"] = bool(p <= 0.05)
    return rows


def _differences(
    areas: Sequence[str],
    dimension: str,
    values: tuple[str, str],
    measure: Measure,
    people: tuple[People, People],
    floor: Floor,
    resamples: int,
    seed: int,
) -> list[Row]:
    first, second = (measure.pair(p) for p in people)
    if first is None or second is None:
        return []
    if measure.counts:
        found = proportion_differences(first, second)
    else:
        found = ratio_differences(first, second, resamples=resamples, seed=seed)
    least = np.minimum((first[1] > 0).sum(axis=0), (second[1] > 0).sum(axis=0))
    rows = []
    for a, area in enumerate(areas):
        told = floor.passes(int(least[a]))
        row: Row = {"cell": dimension, "first": values[0], "second": values[1], "thing": area, "measure": measure.name}
        for key in ("value", "low", "high", "p"):
            row["difference" if key == "value" else key] = _number(getattr(found, key)[a]) if told else None
        rows.append(row)
    return rows


def move_rows(sums: Sums, floor: Floor) -> list[Row]:
    """Moves between things of each cell: ``from``, ``to``, how many ``moves``, and their ``share`` of those from
    there."""
    rows = []
    for c, cell in enumerate(sums.cells):
        people = len(sums.persons_of(cell)[0])
        total = sums.moves[c].sum(axis=1)
        for i, j in np.argwhere(sums.moves[c] > 0):
            told = floor.passes(people)
            n = float(sums.moves[c, i, j])
            row: Row = {"cell": cell.dimension, "value": cell.value, "from": sums.areas[i], "to": sums.areas[j]}
            rows.append(row | {"moves": int(n) if told else None, "share": n / float(total[i]) if told else None})
    return rows


def duration_rows(sums: Sums, floor: Floor) -> list[Row]:
    """How many looks at each area last how long, of each cell; `BINS` in seconds."""
    rows = []
    names = [f"{a:g} to {b:g} s" if np.isfinite(b) else f"{a:g} s or more" for a, b in zip(BINS[:-1], BINS[1:])]
    for c, cell in enumerate(sums.cells):
        people = len(sums.persons_of(cell)[0])
        for a, area in enumerate(sums.areas):
            told = floor.passes(people)
            counts = {n: int(v) if told else None for n, v in zip(names, sums.lasted[c, a])}
            rows.append({"cell": cell.dimension, "value": cell.value, "thing": area, **counts})
    return rows


def is_too_low(row: Row, measure: str) -> bool:
    """Whether a number comes out too low: the reach by a field that was asked from few ``places`` a person."""
    places = row.get("places")
    return measure == "reach" and row.get(measure) is not None and places is not None and places < PLACES


def shown(row: Row, measure: Measure) -> str:
    """A value with its interval as Markdown has it, and, after ±, its spread over the members of an ensemble: shares in
    percent, small ones with two digits behind the point. What comes out too low says so."""
    value = row.get(measure.name)
    if value is None:
        return ""
    scale, digits = (100.0, 2 if 0 < value < 0.01 else 1) if measure.most == 1.0 else (1.0, 2)
    text = f"{scale * value:.{digits}f}" + (" %" if scale > 1 else "")
    low, high = row.get(measure.name + "_low"), row.get(measure.name + "_high")
    if low is not None and high is not None:
        text += f" [{scale * low:.{digits}f}, {scale * high:.{digits}f}]"
    spread = row.get(measure.name + "_spread")
    text = text if spread is None else text + f" ± {scale * spread:.{digits}f}"
    return f"{text} (too low: {row['places']:.1f} places a person)" if is_too_low(row, measure.name) else text
