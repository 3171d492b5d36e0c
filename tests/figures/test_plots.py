"""Figures show each pixel once, and are the same file for the same input."""

import numpy as np
import pytest

from nerg_mi.figures import overlay as figures
from nerg_mi.figures.overlay import Heat, overlay
from nerg_mi.figures.style import save

RNG = np.random.default_rng(0)
COLOR, GAZE = RNG.random((24, 36, 3)), RNG.random((24, 36))
MASK = np.ones((24, 36), bool)
MASK[:4] = False
HEAT = Heat(top=0.8)


def read(mi, path):
    return np.array(mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True))


def test01_pixel_for_pixel(rgb, tmp_path):
    save(figures.gaze_figure(COLOR, GAZE, MASK, HEAT), tmp_path / "gaze.png")
    page = read(rgb, tmp_path / "gaze.png").astype(float) / 255
    shown = overlay(COLOR, GAZE, HEAT, MASK)
    # It is so small that a pixel is shown as a square of 5 x 5.
    shown = np.repeat(np.repeat(shown, 5, axis=0), 5, axis=1)
    figure = figures.gaze_figure(COLOR, GAZE, MASK, HEAT)
    box = figure.axes[0].get_window_extent()
    x, y = round(box.x0), round(figure.bbox.height - box.y1)
    assert (round(box.width), round(box.height)) == (180, 120)
    assert np.abs(page[y : y + 120, x : x + 180] - shown).max() < 0.01


@pytest.mark.parametrize("name", ["depth", "gaze", "visibility", "occlusion"])
def test02_equal_input_equal_file(tmp_path, name):
    draw = {
        "depth": lambda: figures.depth_figure(3 + GAZE, MASK),
        "gaze": lambda: figures.gaze_figure(COLOR, GAZE, MASK, HEAT),
        "visibility": lambda: figures.visibility_figure(COLOR, GAZE, MASK),
        "occlusion": lambda: figures.occlusion_figure(*[(COLOR, GAZE, MASK)] * 3, HEAT, (3, 4)),
    }[name]
    for k in "ab":
        save(draw(), tmp_path / f"{k}.png", {"Comment": "seed 1"})
    a, b = ((tmp_path / f"{k}.png").read_bytes() for k in "ab")
    assert a == b and b"seed 1" in a


def test02b_a_note_stands_below_and_moves_nothing():
    """The picture and its scale are where they are without it."""
    plain, noted = (figures.gaze_figure(COLOR, GAZE, MASK, HEAT, note=n) for n in ("", "made of 300 rays of 3 people"))
    assert noted.bbox.height > plain.bbox.height and noted.bbox.width == plain.bbox.width
    for a, b in zip(plain.axes, noted.axes):
        (x, y, w, h), lower = a.get_window_extent().bounds, noted.bbox.height - plain.bbox.height
        np.testing.assert_allclose(b.get_window_extent().bounds, (x, y + lower, w, h), atol=0.01)
    (text,) = noted.texts
    noted.canvas.draw()
    box = text.get_window_extent()
    assert 0 <= box.y0 and box.x1 <= noted.bbox.width
    assert box.y1 <= min(a.get_window_extent().y0 for a in noted.axes) + 0.5


def test03_depth_without_any_surface(tmp_path):
    save(figures.depth_figure(np.zeros((8, 12)), np.zeros((8, 12), bool)), tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 0


def test04_one_scale_for_the_three_panels_says_what_it_clips():
    figure = figures.occlusion_figure((COLOR, GAZE, MASK), (COLOR, GAZE, MASK), (COLOR, 0 * GAZE, MASK), HEAT)
    assert len(figure.axes) == 4
    bar = figure.axes[-1]
    # A tip beyond the end of the scale, in the colour of the end.
    assert "1/sr" in bar.get_ylabel().replace("\n", " ") and len(bar.patches) == 1
    assert bar.patches[0].get_xy()[:, 1].max() > 1
    calm = figures.gaze_figure(COLOR, GAZE, MASK, Heat(top=2.0))
    assert not calm.axes[-1].patches
