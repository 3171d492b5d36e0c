"""Looks: how long each ray stands for, and which rays on a thing are one look at it.

A *sitting* is a run of a person's rays without a pause of more than `LookRules.pause`. A ray stands for the time to the
next of its sitting, unless that is more than `LookRules.gap` away: then, and at the end of a sitting, for the sitting's
usual step (the median of those that are no longer than the gap), or for none where there is no such step. A *look* at a
thing is a run of rays on it, in which nothing else lasts longer than `LookRules.merge`; one that lasts less than
`LookRules.least` from its first ray's start to its last one's end is none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.ranges import SECONDS, check_number


@dataclass(frozen=True)
class LookRules:
    """Times in seconds. Raises `NergError` for those that are no numbers, or negative."""

    gap: float = 1.0
    pause: float = 60.0
    merge: float = 0.15
    least: float = 0.1

    def __post_init__(self) -> None:
        for name in ("gap", "pause", "merge", "least"):
            value = getattr(self, name)
            check_number(value, SECONDS, f"--{name}")
        if not self.pause >= self.gap > 0:
            raise NergError(f"--pause ({self.pause:g} s) is at least --gap ({self.gap:g} s), which is more than 0")


@dataclass(frozen=True)
class Timeline:
    """N rays in the order of persons and times: ``person`` (N,) codes, ``t`` (N,) seconds, ``weight`` (N,) the time
    that each stands for, ``sitting`` (N,) numbers from 0."""

    person: np.ndarray
    t: np.ndarray
    weight: np.ndarray
    sitting: np.ndarray


def timeline(person: np.ndarray, t: np.ndarray, rules: LookRules) -> Timeline:
    """That of rays in this order already. Raises ``ValueError`` where they are not, or a time is not finite."""
    if not np.isfinite(t).all():
        raise ValueError("times must be finite")
    step = np.diff(t)
    same = np.diff(person) == 0
    if np.any(np.diff(person) < 0) or np.any(step[same] < 0):
        raise ValueError("rays must be in the order of persons and times")
    # In single precision two times may be a hair apart or beyond.
    joined = same & (step <= rules.pause * (1 + 1e-9))
    sitting = np.cumsum(np.r_[np.zeros(min(len(t), 1), int), ~joined])
    near = joined & (step <= rules.gap * (1 + 1e-9))
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
class Looks:
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


def looks_at(rows: np.ndarray, line: Timeline, rules: LookRules) -> Looks:
    """The looks whose rays are ``rows`` of a ``line``, sorted."""
    if not len(rows):
        return Looks(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    start, end = line.t[rows], line.t[rows] + line.weight[rows]
    # The latest end so far: a ray that stands for long may outlast the next.
    apart = start[1:] - end[:-1] > rules.merge + 1e-9
    new = np.r_[True, apart | (np.diff(line.sitting[rows]) != 0)]
    first = np.flatnonzero(new)
    last = np.r_[first[1:], len(rows)] - 1
    lasted = end[last] - start[first]
    kept = lasted >= rules.least - 1e-9
    return Looks(rows[first][kept], start[first][kept], end[last][kept])
