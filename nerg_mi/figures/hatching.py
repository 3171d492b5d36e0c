"""Where a picture knows nothing: diagonal lines over paled colours, which no value of any scale looks like."""

from __future__ import annotations

from typing import Any

import numpy as np

PERIOD, WIDTH = 8, 2
"""Pixels from line to line along a row, and of a line."""

PALE, LINE = 0.82, 0.42
"""Grey that the picture is mixed with, and grey of the lines, display values."""

_MIXED = 0.65


def lines(height: int, width: int, unit: int = 1) -> np.ndarray:
    """Whether a pixel (``height``, ``width``) lies on a line of the hatching; ``unit``: by what lines are coarser."""
    y, x = np.ogrid[:height, :width]
    return (x + y) % (PERIOD * unit) < WIDTH * unit


def hatch(display: Any, unknown: Any, unit: int = 1) -> np.ndarray:
    """``display`` values (h, w, 3), hatched where ``unknown`` (h, w) is true, and unchanged elsewhere."""
    shown = np.asarray(display, np.float64)
    where = np.asarray(unknown, bool)[..., None]
    pale = shown + _MIXED * (PALE - shown)
    height, width = shown.shape[:2]
    drawn = np.where(lines(height, width, unit)[..., None], LINE, pale)
    return np.where(where, drawn, shown)


def swatch(height: int, width: int, unit: int = 1) -> np.ndarray:
    """What stands in a legend (``height``, ``width``, 3): the hatching over a middle grey."""
    return hatch(np.full((height, width, 3), 0.5), np.full((height, width), True), unit)
