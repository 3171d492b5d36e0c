"""Attention over colour: a heat map that stays readable on a picture, with a scale that can be read off.

Values are densities in 1/sr. Colours come from one of matplotlib's perceptually uniform maps; the heat grows more
opaque with the value, over a picture that is dimmed and greyed, so that goods stay recognisable and their colours are
not mistaken for heat. Where there is no surface nothing is coloured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError

from .tonemap import LUMINANCE, srgb

MAPS = ("inferno", "magma", "plasma", "viridis", "cividis")
"""Colour maps whose lightness rises evenly with the value."""


@dataclass(frozen=True)
class Heat:
    """How values become colour.

    ``top``: the value, in 1/sr, at the upper end of the scale, which starts at 0; ``colors``: one of `MAPS`;
    ``opacity``: of the hottest pixel; ``ramp``: share of the scale over which opacity rises from 0; ``dim``: brightness
    of the picture below; ``grey``: how much of its colour is taken away. Raises NergError for what cannot be shown.
    """

    top: float
    colors: str = "inferno"
    opacity: float = 0.9
    ramp: float = 0.35
    dim: float = 0.8
    grey: float = 0.6

    def __post_init__(self):
        if not (np.isfinite(self.top) and self.top > 0):
            raise NergError(f"the top of a heat map's scale must be positive, got {self.top}: give it a range.")
        if self.colors not in MAPS:
            raise NergError(f'"{self.colors}" is no perceptually uniform colour map: choose one of {", ".join(MAPS)}.')

    def shares(self, values) -> np.ndarray:
        """Place on the scale, 0..1."""
        return np.clip(np.nan_to_num(np.asarray(values, np.float64)) / self.top, 0.0, 1.0)

    def alpha(self, values) -> np.ndarray:
        """Opacity of the heat, 0..``opacity``: a smooth rise over ``ramp``."""
        x = np.clip(self.shares(values) / self.ramp, 0.0, 1.0)
        return self.opacity * x * x * (3.0 - 2.0 * x)


def top_of(values, mask, percentile: float = 99.5) -> float:
    """The value that ``percentile`` percent of the pixels in ``mask`` (bool, like ``values``) stay below.

    A robust end for a scale: a few grazing pixels do not darken all others. Raises NergError where nothing is positive.
    """
    inside = np.asarray(values)[np.asarray(mask, bool)]
    top = float(np.percentile(inside, percentile)) if inside.size else 0.0
    if top <= 0 and inside.size:
        top = float(inside.max())  # all attention may lie on fewer pixels than the percentile leaves out
    if not top > 0:
        raise NergError("there is no gaze in this picture to take a scale from: move the camera, or give a range.")
    return top


def underlay(color, heat: Heat) -> np.ndarray:
    """Display values (h, w, 3) of the linear picture ``color`` (h, w, 3), dimmed and greyed as ``heat`` says."""
    shown = srgb(color)
    luminance = srgb(np.clip(color, 0, 1) @ LUMINANCE)[..., None]
    return heat.dim * (shown + heat.grey * (luminance - shown))


def overlay(color, values, heat: Heat, mask=None) -> np.ndarray:
    """Display values (h, w, 3) in 0..1: ``values`` (h, w) in 1/sr as heat over the linear picture ``color`` (h, w, 3).

    ``mask`` (h, w) bool: where there is a surface; the heat stays away from the rest.
    """
    import matplotlib

    alpha = heat.alpha(values)
    if mask is not None:
        alpha = np.where(mask, alpha, 0.0)
    hot = matplotlib.colormaps[heat.colors](heat.shares(values))[..., :3]
    base = underlay(color, heat)
    return base + alpha[..., None] * (hot - base)


def scale_strip(heat: Heat, steps: int = 256) -> np.ndarray:
    """The colours of the scale (``steps``, 3) from 0 to ``heat.top``, as they look over a surface of middle grey."""
    values = np.linspace(0.0, heat.top, steps)
    return overlay(np.full((1, steps, 3), 0.2), values[None], heat)[0]
