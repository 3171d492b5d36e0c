"""Recordings of people among rays: what one person did in one go, as it was stored."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .filters import time_order
from .rays import Rays

PAUSE = 60.0
"""Seconds: a longer pause ends a recording."""

_BACK = 1.0  # seconds by which time goes back where another recording begins; less is a row in the wrong place
_MIXED = 10, 0.01  # rows, and share of them, at which time goes back in an order in which nobody recorded


@dataclass(frozen=True, eq=False)
class Sessions:
    """Rays in the order of recordings, those of a person together; S recordings."""

    order: np.ndarray | None  # (N,) of the rays; None: they are in it already
    starts: np.ndarray  # (S + 1,) where each begins in that order, with N at the end
    person: np.ndarray  # (S,) of each
    back: np.ndarray  # (S,) bool: it begins since time went back

    def rows(self, part: slice) -> slice | np.ndarray:
        """Which rays a part of the order is."""
        return part if self.order is None else self.order[part]

    def label(self) -> np.ndarray:
        """Number of the recording of each place of the order, (N,)."""
        return np.repeat(np.arange(len(self.person)), np.diff(self.starts))


def find_sessions(rays: Rays) -> Sessions:
    """Recordings: of a person, from one time at which their clock goes back by more than a second, or makes a pause of
    more than `PAUSE`, to the next.

    Rays are stored as they were imported. Where they were mixed since, so that time goes back again and again, they are
    taken in the order of time.
    """
    person = rays.person
    order = np.argsort(person, kind="stable") if (person[1:] < person[:-1]).any() else None
    sorted_ = lambda values: values if order is None else values[order]
    other, step = np.diff(sorted_(person)) != 0, np.diff(sorted_(rays.t))
    if np.count_nonzero(~other & (step < -_BACK)) > max(_MIXED[0], _MIXED[1] * len(rays)):
        order = time_order(rays)
        other, step = np.diff(sorted_(person)) != 0, np.diff(sorted_(rays.t))
    back = ~other & (step < -_BACK)
    new = np.flatnonzero(other | back | (step > PAUSE)) + 1
    starts = np.r_[0, new, len(rays)]
    return Sessions(order, starts, sorted_(person)[starts[:-1]], np.r_[False, back[new - 1]])
