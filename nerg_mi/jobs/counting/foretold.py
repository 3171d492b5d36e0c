"""What a gaze field foretells of people who stand where they stood: the same numbers as those that are counted, as far
as a field tells them.

A field knows how gaze is shared out at a moment, and nothing of its course: there are no looks, returns or first looks
in it. The probability that somebody looked at all follows if glances, one every so many seconds, are independent of
each other: 1 - Π (1 - s_i) over their time, s_i the share at glance i.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np

from nerg_mi.jobs.reporter import Reporter
from nerg_mi.statistics.shares import ROUGH, gaze_shares
from nerg_mi.statistics.tables import People
from nerg_mi.statistics.visibility import Targets, in_view, unhidden
from nerg_mi.statistics.visits import Cell, Thing

from .surroundings import Surroundings
from .tracked import Eyes


@dataclass(frozen=True, eq=False)
class Foretold:
    """Of E eyes and A areas: ``share`` (E, A) of the gaze, ``distance`` (E, A) its mean in metres, times the share,
    ``visible`` (E, A) bool, ``support`` (E,) rays that the field learnt from there, NaN where it does not say;
    ``members`` (M, E, A): the share by each member of an ensemble, by one field the same share again."""

    share: np.ndarray
    distance: np.ndarray
    visible: np.ndarray
    support: np.ndarray
    members: np.ndarray


def eyes_of_some(eyes: Eyes, most: int, reporter: Reporter) -> Eyes:
    """Those of at most ``most`` people, who are the same whatever the order in which they came: those whose names have
    the least checksums."""
    people = sorted(set(eyes.person), key=lambda name: (crc32(name.encode("utf-8", "surrogatepass")), name))
    if len(people) <= most:
        return eyes
    reporter.message(f"the field is asked of {most:,} of {len(people):,} people; --eyes {len(people)} asks of all")
    chosen = set(people[:most])
    rows = [k for k, person in enumerate(eyes.person) if person in chosen]
    person, cells = tuple(eyes.person[k] for k in rows), tuple(eyes.cells[k] for k in rows)
    return Eyes(eyes.positions[rows], eyes.ahead[rows], person, cells)


def foretell(
    around: Surroundings,
    eyes: Eyes,
    things: Sequence[Thing],
    members: Sequence[tuple[int, ...]],
    margin: float,
    view: float,
    samples: int,
    directions: int,
    reporter: Reporter,
) -> Foretold:
    """What the gaze field of ``around`` says of each of the ``eyes``, whose shares over the sphere add up to one, in
    so many ``directions`` around each or, where a thing is small, more."""
    E = len(eyes.positions)
    told = lambda done: reporter.progress(done / E, f"the field: place {done} of {E}")
    found = gaze_shares(
        around.look_from, eyes.positions, things, members, margin, replace(ROUGH, first=directions), told
    )
    targets = Targets.of(things, samples)
    seen = in_view(targets, eyes.positions, eyes.ahead, unhidden(targets, eyes.positions, around.depth, margin), view)
    visible = np.stack([seen[:, list(of)].any(axis=1) for of in members], axis=1)
    support = np.array([around.support(p) for p in eyes.positions])
    return Foretold(found.share, found.distance / around.scale, visible, support, found.members)


def foretold_people(
    foretold: Foretold, eyes: Eyes, cell: Cell, times: dict[str, float], glance: float
) -> People | None:
    """The people of a cell by the field; ``times``: for how long each was there, in seconds; ``glance``: seconds that
    one takes. None where no eye is of the cell."""
    rows = [k for k, cells in enumerate(eyes.cells) if cell in cells and eyes.person[k] in times]
    names = sorted({eyes.person[k] for k in rows})
    if not names:
        return None
    place = {name: k for k, name in enumerate(names)}
    who = np.array([place[eyes.person[k]] for k in rows])
    count = np.bincount(who, minlength=len(names)).astype(float)

    def mean(v: np.ndarray) -> np.ndarray:
        total = np.zeros((len(names), v.shape[1]))
        np.add.at(total, who, v[rows].astype(float))
        return total / count[:, None]

    time = np.array([times[name] for name in names])
    share = mean(foretold.share)
    missed = mean(-np.log1p(-np.minimum(foretold.share, 1 - 1e-12)))
    reached = -np.expm1(-missed * (time / glance)[:, None])
    seconds = time[:, None]
    distance, visible = mean(foretold.distance) * seconds, mean(foretold.visible) * seconds
    return People(tuple(names), time, share * seconds, distance, visible, reached)
