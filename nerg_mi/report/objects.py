"""How much attention named objects have: by the field, and by the rays; of people, each of whom counts alike.

Intervals are of 95 %, of the mean over people: Student's t with n - 1 degrees of freedom, which for means is what the
bootstrap over people comes to with many resamples, widened for few (`nerg_mi.evaluation.gaze.verdict.widening`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerg_mi.evaluation.gaze.verdict import widening
from nerg_mi.statistics.shares import Shares
from nerg_mi.statistics.visits import Landed

LEAST_PEOPLE = 3
"""Fewer people than these give no interval."""


@dataclass(frozen=True)
class Share:
    """A mean share of attention over people, and the 95 % interval of that mean; NaN where people are too few for
    it."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class ObjectAttention:
    """Of what is called ``name``: ``field``: the share of gaze that the field says people give it where they stood;
    ``recorded``: the share of their rays that end at it (None without rays); ``saw``: people who stood somewhere from
    where it can be seen, and ``looked``: who have a ray on it, of ``people``; None where nobody was recorded."""

    name: str
    field: Share
    recorded: Share | None
    saw: int | None
    looked: int | None
    people: int | None


def attention_on(
    names: Sequence[str], shares: Shares, who: np.ndarray, recorded: tuple[Landed, np.ndarray] | None = None
) -> tuple[ObjectAttention, ...]:
    """Attention on each of the objects called ``names``, by the ``shares`` of eyes, which are those of ``who`` (P,).

    ``recorded``: what people's rays land on, object by object, and whose each is (N,); without it the eyes are
    nobody's.
    """
    out = []
    for k, name in enumerate(names):
        share = shares.share[:, k]
        if recorded is None:
            out.append(ObjectAttention(name, Share(float(share.mean()), math.nan, math.nan), None, None, None, None))
            continue
        landed, person = recorded
        on = np.zeros(len(person))
        on[landed.rows[k]] = 1.0
        rays = _each(on, person)
        saw = _each(shares.seen[:, k].astype(float), who)
        field, people = mean_over_people(_each(share, who)), len(np.unique(person))
        seen, looked = int(np.sum(saw > 0)), int(np.sum(rays > 0))
        out.append(ObjectAttention(name, field, mean_over_people(rays), max(seen, looked), looked, people))
    return tuple(out)


def mean_over_people(values: np.ndarray) -> Share:
    """The mean of ``values`` (N,), one a person, between 0 and 1, and its interval."""
    mean, n = float(values.mean()), len(values)
    if n < LEAST_PEOPLE:
        return Share(mean, math.nan, math.nan)
    # The bootstrap's standard error of a mean is that of the population: divided by n, not by n - 1.
    reach = 1.96 * float(values.std()) / math.sqrt(n) * widening(n)
    return Share(mean, max(mean - reach, 0.0), min(mean + reach, 1.0))


def _each(values: np.ndarray, person: np.ndarray) -> np.ndarray:
    """Mean of ``values`` for each person there is."""
    _, who, count = np.unique(person, return_inverse=True, return_counts=True)
    return np.bincount(who, weights=values) / count
