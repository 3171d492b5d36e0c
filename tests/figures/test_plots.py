"""Figures show each pixel once, and are the same file for the same input."""

import numpy as np
import pytest

from nerg_mi.figures import plots as figures
from nerg_mi.figures.overlay import Heat, overlay

RNG = np.random.default_rng(0)
COLOR, GAZE = RNG.random((24, 36, 3)), RNG.random((24, 36))
MASK = np.ones((24, 36), bool)
MASK[:4] = False
HEAT = Heat(top=0.8)


def read(mi, path):
    return np.array(mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True))


def test01_pixel_for_pixel(rgb, tmp_path):
    figures.save(figures.gaze_figure(COLOR, GAZE, MASK, HEAT), tmp_path / "gaze.png")
    page = read(rgb, tmp_path / "gaze.png").astype(float) / 255
    shown = overlay(COLOR, GAZE, HEAT, MASK)
    x, y = figures._FOOT, figures._HEAD
    assert np.abs(page[y : y + 24, x : x + 36] - shown).max() < 0.01


@pytest.mark.parametrize("name", ["depth", "gaze", "visibility", "sphere", "occlusion"])
def test02_equal_input_equal_file(tmp_path, name):
    draw = {
        "depth": lambda: figures.depth_figure(3 + GAZE, MASK),
        "gaze": lambda: figures.gaze_figure(COLOR, GAZE, MASK, HEAT),
        "visibility": lambda: figures.visibility_figure(COLOR, GAZE, MASK),
        "sphere": lambda: figures.sphere_figure(COLOR, GAZE, MASK, HEAT),
        "occlusion": lambda: figures.occlusion_figure(*[(COLOR, GAZE, MASK)] * 3, HEAT, (3, 4)),
    }[name]
    for k in "ab":
        figures.save(draw(), tmp_path / f"{k}.png", {"Comment": "seed 1"})
    a, b = ((tmp_path / f"{k}.png").read_bytes() for k in "ab")
    assert a == b and b"seed 1" in a


def test03_depth_without_any_surface(tmp_path):
    figures.save(figures.depth_figure(np.zeros((8, 12)), np.zeros((8, 12), bool)), tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 0


def test04_sphere_has_its_horizon_in_the_middle():
    axes = figures.sphere_figure(COLOR, GAZE, MASK, HEAT).axes[0]
    left, right, low, high = axes.images[0].get_extent()
    assert (left, right) == (-180, 180) and low == -high
    # 24 rows from pole to pole: row centres 180 / 23 degrees apart, the first of them at +90
    assert np.isclose(high - 0.5 * (high - low) / 24, 90)


def test05_one_scale_for_the_three_panels_says_what_it_clips():
    figure = figures.occlusion_figure((COLOR, GAZE, MASK), (COLOR, GAZE, MASK), (COLOR, 0 * GAZE, MASK), HEAT)
    assert len(figure.axes) == 4
    assert "1/sr" in figure.axes[-1].get_ylabel() and "clipped" in figure.axes[-1].get_ylabel()
    calm = figures.gaze_figure(COLOR, GAZE, MASK, Heat(top=2.0))
    assert "clipped" not in calm.axes[-1].get_ylabel()
