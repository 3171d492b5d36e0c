"""The integral over an observer's sphere, in as many directions as its error asks for.

What an observer looks at jumps where a surface hides another one. For sums over points that are spread as evenly as can
be, the error of such integrands falls with the number of points to the power of -3/4 (Beck 1984, for caps of the
sphere; Aistleitner, Brauchart & Dick 2012 for these points), which tells the error of a sum from the scatter of sums
over parts of its points.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

FIRST = 1 << 13
"""Directions that are tried first for a tolerance of `USUAL`, which they mostly keep; fewer for a wider one, `FEWEST`
at least."""

USUAL, FEWEST = 5e-3, 1 << 11

PARTS = 8
"""Parts of a sum whose scatter tells its error. Every eighth point of a golden spiral lies on one too, of eight times
the angle, and no rounder; parts err in opposite ways more often than not, so that the error is told too large, by two
or three times in the mean."""

POWER = 0.75
"""Of the number of points, with which the error of a sum over them falls."""


@dataclass(frozen=True)
class Integral:
    """``value``: of the sum over ``directions``; ``error``: the one that it is likely to have at most, as a share."""

    value: float
    directions: int
    error: float


def integrate(values: Callable[[int], np.ndarray], most: int, tolerance: float) -> Integral:
    """The integral of what ``values(count)`` (count,) are in that many directions of equal area, as
    `maths.sphere.fibonacci_directions` numbers them: over as few as err by ``tolerance``, a share of it, or over
    ``most``."""
    first = FIRST >> max(0, math.floor(math.log2(tolerance / USUAL) / POWER)) if tolerance > 0 else most
    count = min(max(first, FEWEST), most)
    while True:
        found = _sum(values(count))
        if count == most or found.error <= tolerance:
            return found
        # What is told falls nearly as their number grows.
        times = min(found.error / tolerance, most / count)
        count = min(most, count << max(math.ceil(math.log2(times)), 1))


def _sum(values: np.ndarray) -> Integral:
    values = np.asarray(values, np.float64)
    mean = float(values.mean())
    parts = [values[k::PARTS].mean() for k in range(min(PARTS, len(values)))]
    scatter = float(np.std(parts, ddof=1)) if len(parts) > 1 else math.inf
    error = scatter * PARTS**-POWER / abs(mean) if mean else math.inf if scatter else 0.0
    return Integral(4 * math.pi * mean, len(values), error)
