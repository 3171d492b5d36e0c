"""Colour maps by name: what is let in, and that what is let in is even."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.style import DIVERGING, SEQUENTIAL, color_values, find_colors


def lightness(colors):
    """CIE 1976 L* of display sRGB, from its definition."""
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    y = linear @ [0.2126, 0.7152, 0.0722]
    return np.where(y > (6 / 29) ** 3, 116 * np.cbrt(y) - 16, y * (29 / 3) ** 3)


@pytest.mark.parametrize("name", SEQUENTIAL)
def test_lightness_rises_evenly(name):
    step = np.diff(lightness(color_values(name, np.linspace(0, 1, 64))))
    assert np.all(step > 0)
    assert np.allclose(color_values(f"{name}_r", [0.2]), color_values(name, [0.8]), atol=0.02)


@pytest.mark.parametrize("name", DIVERGING)
def test_differences_darken_alike_to_both_sides(name):
    level = lightness(color_values(name, np.linspace(0, 1, 65), kind="diverging"))
    assert level.argmax() in range(30, 35)
    assert np.all(np.diff(level[:30]) > 0) and np.all(np.diff(level[35:]) < 0)
    assert abs(level[0] - level[-1]) < 25


def test_others_are_refused():
    for name in ("jet", "hsv", "rainbow", "RdBu_r", "nothing", ""):
        with pytest.raises(NergError, match="no perceptually uniform colour map: choose one of inferno"):
            find_colors(name)
    with pytest.raises(NergError, match="no diverging colour map: choose one of RdBu_r"):
        find_colors("viridis", kind="diverging")
