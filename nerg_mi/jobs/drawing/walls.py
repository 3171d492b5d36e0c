"""A place cut at a height, seen from above: what a floor plan of it shows."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerg_mi.figures.maps import Walls
from nerg_mi.transport.geometry import Place, trace_depth

CELLS = 360
"""Cells along the longer side of a plan."""

_SURFACE = 0.5


def cut_place(nerg: Any, scene: Any, low: np.ndarray, high: np.ndarray, level: float, floor: float) -> Walls:
    """The place of the integrator ``nerg`` in ``scene`` between the corners ``low`` and ``high`` (2,), cut at the
    height ``level``; all in scene units, +z up.

    From each cell's centre rays go down, to the height of what they meet, and to the next cells: the cut goes through
    what lies between. A cell in the midst of thick matter meets it at once. ``floor``: the height from which others are
    counted.
    """
    place = Place(nerg.medium, scene)
    side = float(max(high - low)) / CELLS
    nx, ny = (max(int(np.ceil(v / side)), 1) for v in high - low)
    x, y = low[0] + (np.arange(nx) + 0.5) * side, low[1] + (np.arange(ny) + 0.5) * side
    centres = np.stack([*np.meshgrid(x, y), np.full((ny, nx), level)], axis=-1).reshape(-1, 3)

    def met(direction: tuple[float, float, float]) -> np.ndarray:
        depth, opacity = trace_depth(place, centres, np.broadcast_to(direction, centres.shape), nerg.settings)
        return np.where(opacity >= _SURFACE, depth, np.inf).reshape(ny, nx)

    down = met((0, 0, -1))
    height = np.where(np.isfinite(down), level - floor - down, np.nan)
    cut = (met((1, 0, 0)) < side) | (met((0, 1, 0)) < side) | (met((-1, 0, 0)) < side) | (met((0, -1, 0)) < side)
    return Walls(low, low + side * np.array([nx, ny]), height, cut, level - floor)
