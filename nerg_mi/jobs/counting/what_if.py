"""The table of what a change would do, by the field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from nerg_mi.formats.areas.kinds import Areas
from nerg_mi.statistics.estimates import adjusted, ratio_differences
from nerg_mi.statistics.tables import FIELD, Floor, Row

from .changes import read_changes
from .foretold import Foretold
from .places import places_of
from .setting import Setting
from .tracked import Eyes
from .trust import support_of

Foretell = Callable[[Setting, Eyes], Foretold]


def what_if_rows(
    path: Path,
    setting: Setting,
    eyes: Eyes,
    before: Foretold,
    foretell: Foretell,
    floor: Floor,
    resamples: int,
    seed: int,
) -> list[Row]:
    """Of each area and measure (``share`` of gaze, ``visible`` share of people's time) what the field says ``before``
    and ``after`` the changes in the file ``path``, the ``difference`` with its interval over people and, of an
    ensemble's shares, its ``difference_spread`` over the members, and the ``support``: rays that the field learnt from
    around an eye, at the median after the changes. ``foretell`` is asked what the field says in the changed setting of
    the observers that there are then. Raises `NergError`."""
    changes = read_changes(path)
    there = setting.changed(changes)
    areas, after_areas = setting.areas, there.areas
    others = eyes
    if changes.observers is not None:
        others = places_of(changes.observers)
    if changes.shift is not None:
        others = replace(others, positions=others.positions + changes.shift)
    after = foretell(there, others)
    # People who are the same before and after are compared with themselves.
    names = sorted({*eyes.person, *others.person})
    support = support_of(after)
    rows: list[Row] = []
    for name in dict.fromkeys((*areas.names, *after_areas.names)):
        for measure in ("share", "visible"):
            old = _of(eyes, names, getattr(before, measure), areas, name)
            new = _of(others, names, getattr(after, measure), after_areas, name)
            row = _row(name, measure, old, new, floor, resamples, seed)
            row["difference_spread"] = None
            if measure == "share" and row["difference"] is not None and len(after.members) > 1:
                apart = [
                    _mean(_of(others, names, to, after_areas, name)) - _mean(_of(eyes, names, at, areas, name))
                    for at, to in zip(before.members, after.members)
                ]
                row["difference_spread"] = float(np.std(apart, ddof=1))
            rows.append(row | {"support": support, "source": FIELD})
    corrected = adjusted(np.array([np.nan if row["p"] is None else row["p"] for row in rows], float))
    for row, p in zip(rows, corrected):
        row["p_adjusted"] = float(p) if np.isfinite(p) else None
    return rows


def _of(eyes: Eyes, names: list[str], values: np.ndarray, areas: Areas, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean of an area's ``values`` (E, A) over the eyes of each person, and who has any, (P, 1) each."""
    total, count = np.zeros((len(names), 1)), np.zeros((len(names), 1))
    if name in areas.names:
        place = {n: k for k, n in enumerate(names)}
        who = np.array([place[p] for p in eyes.person])
        np.add.at(total[:, 0], who, values[:, areas.names.index(name)].astype(float))
        np.add.at(count[:, 0], who, 1.0)
    return total / np.maximum(count, 1), (count > 0).astype(float)


def _mean(pair: tuple[np.ndarray, np.ndarray]) -> float:
    return float(pair[0].sum() / pair[1].sum())


def _row(name: str, measure: str, old, new, floor: Floor, resamples: int, seed: int) -> Row:
    mean = lambda pair: _mean(pair) if pair[1].sum() else None
    people = int(min(old[1].sum() or new[1].sum(), new[1].sum() or old[1].sum()))
    told = floor.passes(people)
    row: Row = {"thing": name, "measure": measure, "people": people if told else None}
    row |= {"before": mean(old) if told else None, "after": mean(new) if told else None}
    both = bool(old[1].sum() and new[1].sum())
    found = ratio_differences(old, new, resamples=resamples, seed=seed) if both and told else None
    number = lambda v: float(v[0]) if np.isfinite(v[0]) else None
    keys = {"difference": "value", "low": "low", "high": "high", "p": "p"}
    return row | {k: None if found is None else number(getattr(found, v)) for k, v in keys.items()}
