"""How far what a field foretells is to be trusted: the spread of an ensemble's members, and how many rays it learnt
from around the eyes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from nerg_mi.jobs.reporter import Reporter
from nerg_mi.statistics.tables import BY_NAME, FIELD, PLACES, Row
from nerg_mi.statistics.visits import Cell

from .foretold import Foretold, foretold_people
from .tracked import Eyes

SPREAD = ("share", "dwell", "reach")
"""Numbers whose spread over members is told."""


def add_trust(
    rows: Sequence[Row], foretold: Foretold, eyes: Eyes, times: Mapping[Cell, dict[str, float]], glance: float
) -> None:
    """Give ``rows`` of the table of things ``support``, the median over the eyes of their cell, ``places``, the eyes of
    the cell for each of its people, and ``share_spread``, ``dwell_spread`` and ``reach_spread``, the standard
    deviations over the members of an ensemble; None for what was counted, is blank, or is not known."""
    found: dict[tuple[str, str], tuple[float | None, float | None, dict[str, np.ndarray]]] = {}
    areas: dict[str, int] = {}
    for cell in times:
        mine = np.array([cell in cells for cells in eyes.cells], bool)
        people = {person for person, own in zip(eyes.person, mine.tolist()) if own}
        places = float(mine.sum()) / len(people) if people else None
        spreads = _spreads(foretold, eyes, cell, times, glance)
        found[cell.dimension, cell.value] = support_of(foretold, mine), places, spreads
    for row in rows:
        place = areas.setdefault(row["thing"], len(areas))
        support, places, spreads = found[row["cell"], row["value"]]
        told = row["source"] == FIELD
        for name in SPREAD:
            known = told and name in spreads and row[name] is not None
            row[f"{name}_spread"] = float(spreads[name][place]) if known else None
        row["support"] = support if told and row["people"] is not None else None
        row["places"] = places if told and row["people"] is not None else None


def support_of(foretold: Foretold, mine: np.ndarray | None = None) -> float | None:
    """Rays that the field learnt from around an eye, at the median of all, or of ``mine`` (E,); None where the
    checkpoint keeps none."""
    some = foretold.support if mine is None else foretold.support[mine]
    some = some[np.isfinite(some)]
    return float(np.median(some)) if len(some) else None


def tell_support(foretold: Foretold, reporter: Reporter) -> None:
    """Say what is missing where nobody can tell how much data the numbers of a field rest on."""
    if support_of(foretold) is None:
        reporter.message(
            "the gaze field's checkpoint keeps no support, so that the tables cannot say where it learnt from nobody; "
            "nerg train gaze with the rays makes one that does"
        )


def tell_places(eyes: Eyes, reporter: Reporter) -> None:
    """Say so where a field is asked from too few places a person for their reach: who looks at a thing only where it is
    near is taken for somebody who does not, unless one of their places is there."""
    people = len(set(eyes.person))
    if people and len(eyes.person) < PLACES * people:
        reporter.message(
            f"the field is asked from {len(eyes.person) / people:.1f} places a person, by which reach comes out too "
            f"low; --eyes {PLACES * people} asks from {PLACES}"
        )


def _spreads(
    foretold: Foretold, eyes: Eyes, cell: Cell, times: Mapping[Cell, dict[str, float]], glance: float
) -> dict[str, np.ndarray]:
    if len(foretold.members) < 2:
        return {}
    values: dict[str, list[np.ndarray]] = {name: [] for name in SPREAD}
    for share in foretold.members:
        people = foretold_people(replace(foretold, share=share), eyes, cell, times[cell], glance)
        for name in SPREAD:
            pair = None if people is None else BY_NAME[name].pair(people)
            if pair is None:
                return {}
            with np.errstate(divide="ignore", invalid="ignore"):
                values[name].append(pair[0].sum(axis=0) / pair[1].sum(axis=0))
    return {name: np.std(found, axis=0, ddof=1) for name, found in values.items()}
