"""Attention over colour: a heat map that stays readable on a picture, with a scale that can be read off.

Values are densities in 1/sr. Colours come from one of matplotlib's perceptually uniform maps; the heat grows more
opaque with the value, over a picture that is dimmed and greyed, so that goods stay recognisable and their colours are
not mistaken for heat. Where there is no surface nothing is coloured, and what is not known can be hatched.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.ranges import DECADES

from .colors import color_values, find_colors
from .hatching import hatch
from .tonemap import LUMINANCE, srgb

MOST_DECADES = float(DECADES.high)


@dataclass(frozen=True)
class Heat:
    """How values become colour.

    ``top``: the value, in 1/sr, at the upper end of the scale, which starts at 0; ``colors``: one of
    `colors.SEQUENTIAL`; ``opacity``: of the hottest pixel; ``ramp``: share of the scale over which opacity rises from
    0; ``dim``: brightness of the picture below; ``grey``: how much of its colour is taken away. ``decades``: 0 for a
    linear scale, else a logarithmic one that starts so many powers of ten below ``top``. Raises NergError for what
    cannot be shown.
    """

    top: float
    colors: str = "inferno"
    opacity: float = 0.9
    ramp: float = 0.35
    dim: float = 0.8
    grey: float = 0.6
    decades: float = 0.0

    def __post_init__(self):
        if not (np.isfinite(self.top) and self.top > 0):
            raise NergError(f"the top of a heat map's scale must be positive, got {self.top}: give it a range")
        if not 0 <= self.decades <= MOST_DECADES:
            raise NergError(f"a scale has 0 (linear) to {MOST_DECADES:.0f} decades, and {self.decades} were asked for")
        find_colors(self.colors)

    @property
    def low(self) -> float:
        """The value at the lower end of the scale."""
        return self.top * 10.0**-self.decades if self.decades else 0.0

    def shares(self, values) -> np.ndarray:
        """Place on the scale, 0..1."""
        x = np.nan_to_num(np.asarray(values, np.float64)) / self.top
        if self.decades:
            x = 1.0 + np.log10(np.maximum(x, 10.0 ** -(MOST_DECADES + 1))) / self.decades
        return np.clip(x, 0.0, 1.0)

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
        raise NergError("there is no gaze in this picture to take a scale from: move the camera, or give a range")
    return top


def underlay(color, heat: Heat) -> np.ndarray:
    """Display values (h, w, 3) of the linear picture ``color`` (h, w, 3), dimmed and greyed as ``heat`` says."""
    shown = srgb(color)
    luminance = srgb(np.clip(color, 0, 1) @ LUMINANCE)[..., None]
    return heat.dim * (shown + heat.grey * (luminance - shown))


def overlay(color, values, heat: Heat, mask=None, unknown=None) -> np.ndarray:
    """Display values (h, w, 3) in 0..1: ``values`` (h, w) in 1/sr as heat over the linear picture ``color`` (h, w, 3).

    ``mask`` (h, w) bool: where there is a surface; the heat stays away from the rest. ``unknown`` (h, w) bool: where
    nothing is known, which is hatched in place of heat.
    """
    alpha = heat.alpha(values)
    if mask is not None:
        alpha = np.where(mask, alpha, 0.0)
    if unknown is not None:
        alpha = np.where(unknown, 0.0, alpha)
    hot = color_values(heat.colors, heat.shares(values))
    base = underlay(color, heat)
    shown = base + alpha[..., None] * (hot - base)
    return shown if unknown is None else hatch(shown, unknown)


def scale_strip(heat: Heat, steps: int = 256) -> np.ndarray:
    """The colours of the scale (``steps``, 3) from its lower end to ``heat.top``, as they look over a surface of middle
    grey; steps are even on the scale, be it linear or logarithmic."""
    share = np.linspace(0.0, 1.0, steps)
    values = heat.top * (10.0 ** (heat.decades * (share - 1.0)) if heat.decades else share)
    return overlay(np.full((1, steps, 3), 0.2), values[None], heat)[0]
