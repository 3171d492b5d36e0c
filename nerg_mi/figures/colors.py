"""Colour maps by name: the one place where they are checked.

All have a lightness that rises evenly, or rises evenly to both sides of a middle, so that equal steps of a value look
equal, also to people who do not tell red from green, and on grey paper. Rainbows (``jet``) are left out: they show
edges where the values have none.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nerg_mi.errors import NergError

SEQUENTIAL = ("inferno", "magma", "plasma", "viridis", "cividis")
"""For values from a least to a greatest one."""

DIVERGING = ("RdBu_r", "PuOr_r", "BrBG_r", "PRGn_r")
"""For differences, whose middle is 0."""


def find_colors(name: str, diverging: bool = False) -> Any:
    """The colour map ``name`` of matplotlib: a function from 0..1 to RGBA. A name may end in ``_r``, for the other
    direction. Raises `NergError` for one that is not among `SEQUENTIAL`, or `DIVERGING` where that is asked for."""
    import matplotlib

    known = DIVERGING if diverging else SEQUENTIAL
    if name.removesuffix("_r") not in {of.removesuffix("_r") for of in known}:
        kind = "diverging" if diverging else "perceptually uniform"
        raise NergError(f'"{name}" is no {kind} colour map: choose one of {", ".join(known)}')
    return matplotlib.colormaps[name]


def color_values(name: str, shares: Any, diverging: bool = False) -> np.ndarray:
    """Display colours (..., 3) of places ``shares`` (...) on a scale, 0..1."""
    return np.asarray(find_colors(name, diverging)(np.asarray(shares, np.float64)))[..., :3]
