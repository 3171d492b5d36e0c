"""Heat over a picture."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Heat, overlay, scale_strip, top_of, underlay

COLOR = np.random.default_rng(0).random((6, 8, 3))


def test01_nothing_where_nobody_looks_and_where_there_is_no_surface():
    heat = Heat(top=2.0)
    values = np.full((6, 8), 2.0)
    values[0] = 0
    mask = np.ones((6, 8), bool)
    mask[1] = False
    shown = overlay(COLOR, values, heat, mask)
    assert np.allclose(shown[:2], underlay(COLOR, heat)[:2])
    assert np.abs(shown[2:] - underlay(COLOR, heat)[2:]).min(axis=(0, 1)).max() > 0.05


def test02_opacity_rises_and_ends_at_the_top():
    heat = Heat(top=4.0, opacity=0.8, ramp=0.5)
    alpha = heat.alpha(np.linspace(0, 8, 50))
    assert alpha[0] == 0 and np.all(np.diff(alpha) >= 0)
    assert np.allclose(alpha[np.linspace(0, 8, 50) >= 2], 0.8)


def test03_equal_values_have_equal_heat_in_the_scale_and_in_the_picture():
    heat = Heat(top=3.0, opacity=1.0)
    shown = overlay(COLOR, np.full((6, 8), 3.0), heat)
    assert np.allclose(shown, scale_strip(heat)[-1])


def test04_lightness_of_the_scale_rises():
    for colors in ("inferno", "viridis"):
        strip = scale_strip(Heat(top=1.0, colors=colors, opacity=1.0, ramp=1e-6))
        assert np.all(np.diff((strip**2.2 @ [0.2126, 0.7152, 0.0722])[1:]) > -1e-3)


def test05_top_from_a_percentile_of_the_surface():
    values = np.arange(100.0).reshape(10, 10)
    mask = values < 50
    assert top_of(values, mask, 100) == 49
    assert top_of(values, mask, 50) == 24.5
    spot = np.zeros((50, 50))
    spot[3, 3] = 2.5
    assert top_of(spot, np.ones_like(spot, bool)) == 2.5


def test06_errors_are_sentences():
    with pytest.raises(NergError, match="no gaze in this picture"):
        top_of(np.zeros((3, 3)), np.ones((3, 3), bool))
    with pytest.raises(NergError, match="must be positive"):
        Heat(top=0.0)
    with pytest.raises(NergError, match="choose one of inferno"):
        Heat(top=1.0, colors="jet")
