"""How well a similarity agrees with what tracking says about a place, each as residuals with their derivatives.

People's heads are in free space; they are above the floor, by about the height of a person; gaze goes through free
space and ends on surfaces, at its hit points where these are known. Residuals are lengths in units of the tracking
(metres of people), so that a smaller place is no better than a larger one; their derivatives are with respect to the
numbers of a chart (`Chart`). Another score is another class with these methods.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .chart import Chart
from .grid import DistanceGrid
from .surface import PlaceSurface

NEAR, FAR, STEPS = 0.3, 12.0, 32
"""Gaze without a hit point ends between so many metres; at so many places along it a surface is looked for."""

STANDS = 0.9, 2.05
"""Metres above the floor between which a head is plausible: of somebody who sits, and of somebody tall."""


class Score(Protocol):
    """A property that a right alignment has."""

    @property
    def name(self) -> str:
        """What it is about, in a few words."""
        ...

    @property
    def scale(self) -> float:
        """Residuals beyond this many metres count less and less: strays of the tracker, holes of the place."""
        ...

    @property
    def group(self) -> np.ndarray:
        """(N,) whose each residual is: those of a group are not independent of each other."""
        ...

    def residuals(self, chart: Chart, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (N,) in metres, 0 where all is well, of the similarity ``chart.matrix(q)``, and their derivatives
        (N, k) with respect to ``q``."""
        ...


@dataclass(frozen=True, eq=False)
class AtZero:
    """Points (N, 3) are where a distance of the place is 0: hit points on its surface (`PlaceSurface.distance`), heads
    and what gaze passes in its free space (`PlaceSurface.blocked`)."""

    grid: DistanceGrid
    points: np.ndarray
    group: np.ndarray
    name: str
    scale: float = 0.1

    def residuals(self, chart: Chart, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _of_grid(self.grid, self.points, chart, q)


@dataclass(frozen=True, eq=False)
class GazeEnds:
    """Gaze from ``origins`` along unit ``directions`` (N, 3), whose hit points are not known, comes upon a surface."""

    surface: PlaceSurface
    origins: np.ndarray
    directions: np.ndarray
    group: np.ndarray
    scale: float = 0.5
    name: str = "gaze ends on surfaces"

    def residuals(self, chart: Chart, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        along = np.geomspace(NEAR, FAR, STEPS)
        points = self.origins[:, None] + along[:, None] * self.directions[:, None]
        distance = self.surface.distance.at(chart.moved(q, points.reshape(-1, 3))).reshape(len(points), STEPS)
        # Between two places a ray may come nearer by half of the way from one to the other.
        reach = 0.5 * np.gradient(along) * chart.scale(q)
        nearest = np.argmin(distance - reach, axis=1)
        each = np.arange(len(points))
        # The derivative of a least value is that of the value that is least.
        r, by = _of_grid(self.surface.distance, points[each, nearest], chart, q)
        r = r - 0.5 * np.gradient(along)[nearest]
        return np.maximum(r, 0), by * (r > 0)[:, None]


@dataclass(frozen=True, eq=False)
class HeadHeight:
    """Heads (N, 3) are above the floor at the height ``floor`` of the place, z up, as people's are."""

    floor: float
    points: np.ndarray
    group: np.ndarray
    scale: float = 0.2
    name: str = "heads above the floor"

    def residuals(self, chart: Chart, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        moved, s = chart.moved(q, self.points), chart.scale(q)
        height = (moved[:, 2] - self.floor) / s
        up = np.broadcast_to([0.0, 0.0, 1.0], moved.shape)
        slope = chart.pulled(q, moved, up) / s - height[:, None] * chart.basis[6]
        low, high = STANDS
        sign = np.where(height < low, -1.0, np.where(height > high, 1.0, 0.0))
        return np.maximum(np.maximum(low - height, height - high), 0), sign[:, None] * slope


def _of_grid(grid: DistanceGrid, points: np.ndarray, chart: Chart, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances in units of the tracking of ``points`` (N, 3) of its frame, and their derivatives."""
    moved, s = chart.moved(q, points), chart.scale(q)
    value, slope = grid.with_slope(moved)
    return value / s, (chart.pulled(q, moved, slope) - value[:, None] * chart.basis[6]) / s
