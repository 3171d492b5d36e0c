"""The numbers that are told of things, each a ratio of sums over people (`intervals`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from .estimates import Estimates
from .intervals import ratios
from .proportions import proportions
from .sums import Cell, Sums


@dataclass(frozen=True, eq=False)
class People:
    """The sums of P people in one cell.

    ``names``, sorted; ``time`` (P,) seconds; the others (P, A), as `Sums` has them. ``looks``, ``first_sum`` and
    ``first_count`` are None where nobody was tracked, as a field does not tell them; ``reached``: how probable it is
    that each looked at all, 0 or 1 where they were tracked; ``present`` (P,): who is of the cell, None for all.
    """

    names: tuple[str, ...]
    time: np.ndarray
    on_time: np.ndarray
    distance: np.ndarray
    visible: np.ndarray | None
    reached: np.ndarray
    looks: np.ndarray | None = None
    first_sum: np.ndarray | None = None
    first_count: np.ndarray | None = None
    present: np.ndarray | None = None

    @classmethod
    def of(cls, sums: Sums, cell: Cell, seen: bool) -> People:
        """Those of a cell; ``seen``: whether it is known what they could see."""
        rows, names = sums.persons_of(cell)
        return cls(
            tuple(names),
            sums.time[rows],
            sums.on_time[rows],
            sums.distance[rows],
            sums.visible[rows] if seen else None,
            (sums.looks[rows] > 0).astype(float),
            sums.looks[rows],
            sums.first_sum[rows],
            sums.first_count[rows],
        )

    def aligned(self, names: Sequence[str]) -> People:
        """The same with a row for each of ``names``, of whom those who are not there have nothing."""
        place = {name: k for k, name in enumerate(names)}
        to = np.array([place[name] for name in self.names], np.int64)

        def spread(v: np.ndarray) -> np.ndarray:
            out = np.zeros((len(names), *v.shape[1:]))
            out[to] = v
            return out

        given = {f.name: getattr(self, f.name) for f in fields(self)} | {"present": self.there.astype(float)}
        made = {name: spread(v) for name, v in given.items() if isinstance(v, np.ndarray)}
        return replace(self, **(made | {"names": tuple(names)}))

    @property
    def there(self) -> np.ndarray:
        """Who is of the cell at all (P,) bool."""
        return np.ones(len(self.names), bool) if self.present is None else self.present > 0

    @property
    def timed(self) -> np.ndarray:
        """Of whom there is any time (P, 1)."""
        return (self.time > 0)[:, None] & self.there[:, None]

    @property
    def everybody(self) -> np.ndarray:
        """(P, A) ones for those who are there."""
        return np.repeat(self.there[:, None], self.on_time.shape[1], axis=1).astype(float)


Pair = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Measure:
    """A number: its ``name`` in tables, a ``title`` with its unit, ``most``: the greatest that it can be, whether it is
    a share of people (``counts``), and ``pair``: its numerator and denominator (P, A) for each person, None where the
    people's sums do not tell it."""

    name: str
    title: str
    most: float
    counts: bool
    pair: Callable[[People], Pair | None]

    def estimate(self, people: People, resamples: int, seed: int) -> Estimates | None:
        """The number of each area, with its interval."""
        pair = self.pair(people)
        if pair is None:
            return None
        x, y = pair
        binary = self.counts and bool(np.isin(x, (0.0, 1.0)).all())
        return proportions(x, y) if binary else ratios(x, y, resamples=resamples, seed=seed, most=self.most)


def _share(p: People) -> Pair:
    time = np.where(p.time > 0, p.time, 1)[:, None]
    return np.where(p.timed, p.on_time / time, 0), np.repeat(p.timed, p.on_time.shape[1], axis=1).astype(float)


def _visible_share(p: People) -> Pair | None:
    if p.visible is None:
        return None
    time = np.where(p.time > 0, p.time, 1)[:, None]
    return np.where(p.timed, p.visible / time, 0), np.repeat(p.timed, p.on_time.shape[1], axis=1).astype(float)


def _first(p: People) -> Pair | None:
    if p.first_sum is None or p.first_count is None:
        return None
    some = p.first_count > 0
    return np.where(some, p.first_sum / np.where(some, p.first_count, 1), 0), some.astype(float)


def _returns(p: People) -> Pair | None:
    if p.looks is None:
        return None
    return np.maximum(p.looks - 1, 0), (p.looks > 0).astype(float)


def _unseen(p: People) -> Pair | None:
    if p.visible is None:
        return None
    could = (p.visible > 0).astype(float)
    return could * (1 - p.reached), could


MEASURES = (
    Measure("share", "share of time", 1.0, False, _share),
    Measure("dwell", "dwell [s]", np.inf, False, lambda p: (p.on_time, p.everybody)),
    Measure("reach", "reach", 1.0, True, lambda p: (p.reached * p.everybody, p.everybody)),
    Measure("first_look", "first look [s]", np.inf, False, _first),
    Measure("looks", "looks", np.inf, False, lambda p: None if p.looks is None else (p.looks, p.everybody)),
    Measure("returns", "returns", np.inf, False, _returns),
    Measure("distance", "distance [m]", np.inf, False, lambda p: (p.distance, p.on_time)),
    Measure("visible", "visible share", 1.0, False, _visible_share),
    Measure(
        "given_visible",
        "looked at, given visible",
        1.0,
        False,
        lambda p: None if p.visible is None else (p.on_time, p.visible),
    ),
    Measure("unseen", "visible but unseen", 1.0, True, _unseen),
)
"""All, in the order of tables."""

BY_NAME = {measure.name: measure for measure in MEASURES}
