"""Tests of `nerg_mi.figures.overlay`."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures import overlay as figures
from nerg_mi.figures.overlay import (
    Heat,
    OverlayLayers,
    color_strip,
    dim_background,
    find_overlay,
    list_overlays,
    overlay,
    robust_max,
    shared_limits,
    srgb,
    to_bytes,
    write_png,
)
from nerg_mi.figures.style import figure_of, save
from nerg_mi.transport.aovs import AOVS

# ---- Heat over a picture ----

COLOR = np.random.default_rng(0).random((6, 8, 3))


def test_no_heat_without_gaze_or_surface():
    heat = Heat(vmax=2.0)
    values = np.full((6, 8), 2.0)
    values[0] = 0
    mask = np.ones((6, 8), bool)
    mask[1] = False
    shown = overlay(COLOR, values, heat, mask)
    assert np.allclose(shown[:2], dim_background(COLOR, heat)[:2])
    assert np.abs(shown[2:] - dim_background(COLOR, heat)[2:]).min(axis=(0, 1)).max() > 0.05


def test_opacity_increases_to_the_maximum():
    heat = Heat(vmax=4.0, opacity=0.8, ramp=0.5)
    alpha = heat.alpha(np.linspace(0, 8, 50))
    assert alpha[0] == 0 and np.all(np.diff(alpha) >= 0)
    assert np.allclose(alpha[np.linspace(0, 8, 50) >= 2], 0.8)


def test_scale_and_image_have_equal_colours():
    heat = Heat(vmax=3.0, opacity=1.0)
    shown = overlay(COLOR, np.full((6, 8), 3.0), heat)
    assert np.allclose(shown, color_strip(heat)[-1])


def test_scale_lightness_increases():
    for colors in ("inferno", "viridis"):
        strip = color_strip(Heat(vmax=1.0, colormap=colors, opacity=1.0, ramp=1e-6))
        assert np.all(np.diff((strip**2.2 @ [0.2126, 0.7152, 0.0722])[1:]) > -1e-3)


def test_robust_maximum_is_a_percentile():
    values = np.arange(100.0).reshape(10, 10)
    mask = values < 50
    assert robust_max(values, mask, 100) == 49
    assert robust_max(values, mask, 50) == pytest.approx(24.5)
    spot = np.zeros((50, 50))
    spot[3, 3] = 2.5
    assert robust_max(spot, np.ones_like(spot, bool)) == pytest.approx(2.5)


def test_invalid_scales_are_refused():
    with pytest.raises(NergError, match="contains no gaze"):
        robust_max(np.zeros((3, 3)), np.ones((3, 3), bool))
    with pytest.raises(NergError, match="must be positive"):
        Heat(vmax=0.0)
    with pytest.raises(NergError, match="choose one of inferno"):
        Heat(vmax=1.0, colormap="jet")


# ---- Overlays and shared scales ----

X, Y = np.meshgrid(np.linspace(0, 1, 24), np.linspace(0, 1, 16))
LAYERS = OverlayLayers(np.repeat(X[..., None], 3, -1), 2 * Y, X > 0.1, (5.0, 4.0))


@pytest.mark.parametrize("name", [index.name for aov in AOVS.values() for index in list_overlays(aov)])
def test_each_overlay_is_drawn(name, tmp_path):
    overlay = find_overlay(name)
    limits = overlay.limits(LAYERS)
    assert overlay.name == name and (limits is None) == (not overlay.needs_limits)
    save(overlay.draw(LAYERS, limits), tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 500


def test_shared_scale():
    assert shared_limits([(0, 2.0), None, (0, 3.0)], None) == (0, 3.0)
    assert shared_limits([(1.0, 2.0), (0.5, 3.0)], 7.0) == (0.5, 7.0)
    assert shared_limits([(1.0, 2.0)], 0.5) == (0.0, 0.5)
    assert shared_limits([None, None], None) is None and shared_limits([None], 2.0) == (0.0, 2.0)


def test_missing_values_for_a_scale_are_refused():
    dark = OverlayLayers(LAYERS.color, 0 * Y, LAYERS.mask)
    assert find_overlay("gaze").limits(dark) is None
    hidden = OverlayLayers(LAYERS.color, 2 * Y, X > 2)
    assert find_overlay("gaze").limits(hidden) is None


def test_unknown_overlay_is_refused():
    with pytest.raises(NergError, match='unknown overlay "gase"; choose one of depth, opacity, position.X'):
        find_overlay("gase")
    for name in ("position", "position.W", "depth.Y", "features"):
        with pytest.raises(NergError, match=f'"{name}" has several channels'):
            find_overlay(name)
    assert find_overlay("depth.T") == find_overlay("depth") and find_overlay("features.12").name == "features.12"


# ---- Figures ----

RNG = np.random.default_rng(0)
PLOTS_COLOR, GAZE = RNG.random((24, 36, 3)), RNG.random((24, 36))
MASK = np.ones((24, 36), bool)
MASK[:4] = False
HEAT = Heat(vmax=0.8)


def read(mi, path):
    return np.array(mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True))


def test_figures_show_images_pixel_for_pixel(rgb, tmp_path):
    save(figures.gaze_figure(PLOTS_COLOR, GAZE, MASK, HEAT), tmp_path / "gaze.png")
    page = read(rgb, tmp_path / "gaze.png").astype(float) / 255
    shown = overlay(PLOTS_COLOR, GAZE, HEAT, MASK)
    # The image is so small that a pixel is magnified to 5 x 5.
    shown = np.repeat(np.repeat(shown, 5, axis=0), 5, axis=1)
    figure = figure_of(figures.gaze_figure(PLOTS_COLOR, GAZE, MASK, HEAT))
    box = figure.axes[0].get_window_extent()
    x, y = round(box.x0), round(figure.bbox.height - box.y1)
    assert (round(box.width), round(box.height)) == (180, 120)
    assert np.abs(page[y : y + 120, x : x + 180] - shown).max() < 0.01


@pytest.mark.parametrize("name", ["depth", "gaze", "visibility", "occlusion"])
def test_figures_are_reproducible(tmp_path, name):
    draw = dict(
        depth=lambda: figure_of(figures.depth_figure(3 + GAZE, MASK)),
        gaze=lambda: figure_of(figures.gaze_figure(PLOTS_COLOR, GAZE, MASK, HEAT)),
        visibility=lambda: figures.visibility_figure(PLOTS_COLOR, GAZE, MASK),
        occlusion=lambda: figure_of(figures.occlusion_figure(*[(PLOTS_COLOR, GAZE, MASK)] * 3, HEAT, (3, 4))),
    )[name]
    for k in "ab":
        save(draw(), tmp_path / f"{k}.png", {"Comment": "seed 1"})
    a, b = ((tmp_path / f"{k}.png").read_bytes() for k in "ab")
    assert a == b and b"seed 1" in a


def test_note_does_not_move_panels():
    """The note does not move the image or the scale."""
    plain, noted = (
        figure_of(figures.gaze_figure(PLOTS_COLOR, GAZE, MASK, HEAT, note=n))
        for n in ("", "made of 300 rays of 3 participants")
    )
    assert noted.bbox.height > plain.bbox.height and noted.bbox.width == plain.bbox.width
    for a, b in zip(plain.axes, noted.axes):
        (x, y, w, h), lower = a.get_window_extent().bounds, noted.bbox.height - plain.bbox.height
        np.testing.assert_allclose(b.get_window_extent().bounds, (x, y + lower, w, h), atol=0.01)
    (text,) = noted.texts
    noted.canvas.draw()
    box = text.get_window_extent()
    assert 0 <= box.y0 and box.x1 <= noted.bbox.width
    assert box.y1 <= min(a.get_window_extent().y0 for a in noted.axes) + 0.5


def test_depth_without_surfaces(tmp_path):
    save(figures.depth_figure(np.zeros((8, 12)), np.zeros((8, 12), bool)), tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 0


def test_occlusion_figure_has_one_scale():
    figure = figure_of(
        figures.occlusion_figure(
            (PLOTS_COLOR, GAZE, MASK), (PLOTS_COLOR, GAZE, MASK), (PLOTS_COLOR, 0 * GAZE, MASK), HEAT
        )
    )
    assert len(figure.axes) == 4
    bar = figure.axes[-1]
    # A tip beyond the end of the scale, in the colour of the end.
    assert "1/sr" in bar.get_ylabel().replace("\n", " ") and len(bar.patches) == 1
    assert bar.patches[0].get_xy()[:, 1].max() > 1
    calm = figure_of(figures.gaze_figure(PLOTS_COLOR, GAZE, MASK, Heat(vmax=2.0)))
    assert not calm.axes[-1].patches


# ---- Colour conversion ----


def test_srgb_matches_reference_values():
    # IEC 61966-2-1: the knee, middle grey, white
    assert np.allclose(srgb([0, 0.0031308, 0.214041, 0.5, 1]), [0, 0.04045, 0.5, 0.735357, 1], atol=1e-5)


def test_values_out_of_range_are_clipped():
    assert np.array_equal(to_bytes(srgb([-1.0, 7.0, np.nan, np.inf])), [0, 255, 0, 255])


def test_png_contains_pixels_and_text(rgb, tmp_path):
    picture = np.random.default_rng(0).random((5, 7, 3))
    write_png(tmp_path / "a.png", picture, {"Comment": "seed 3"})
    assert np.array_equal(np.array(rgb.Bitmap(str(tmp_path / "a.png"))), to_bytes(picture))
    assert b"seed 3" in (tmp_path / "a.png").read_bytes()
