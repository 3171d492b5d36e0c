"""Figures in given axes, with matplotlib's settings, as vector files; labels, and scanpaths."""

from __future__ import annotations

import zlib

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from nerg_mi.aoi import charts
from nerg_mi.errors import NergError
from nerg_mi.figures import maps, overlay
from nerg_mi.figures.overlay import Heat
from nerg_mi.figures.scanpath import scanpath_figure
from nerg_mi.figures.sphere import sphere_figure
from nerg_mi.figures.style import contact_sheet, encode, figure_of, rasterize
from nerg_mi.figures.training import psnr_figure
from nerg_mi.tracking.rays import Rays

H, W = 30, 48
COLOR, MASK = np.full((H, W, 3), 0.2), np.ones((H, W), bool)
GAZE = np.exp(-(np.hypot(*np.meshgrid(np.arange(W) - 30, np.arange(H) - 12)) ** 2) / 60)
VIEW = COLOR, GAZE, MASK
POSES = np.stack([np.eye(4)] * 3)
POINTS = np.random.default_rng(0).random((40, 3))
ROWS = [{"aoi": "a", "source": "measured", "share": 0.2, "hit_ratio": 0.5, "dwell": 2.0}]


def rays():
    n = 50
    return Rays(
        np.arange(n) / 9, np.zeros(n), ("Ada",), POINTS[np.arange(n) % 40], np.tile([1.0, 0, 0], (n, 1)), np.ones(n)
    )


FIGURES = {
    "depth": (1, lambda **how: overlay.depth_figure(3 + GAZE, MASK, **how)),
    "map": (1, lambda **how: overlay.map_figure(GAZE, MASK, "a", "b", **how)),
    "gaze": (1, lambda **how: overlay.gaze_figure(*VIEW, Heat(1.0), marker=(28, 12), note="note", **how)),
    "visibility": (1, lambda **how: overlay.visibility_figure(*VIEW, **how)),
    "difference": (1, lambda **how: overlay.difference_figure(GAZE, 0 * GAZE, **how)),
    "occlusion": (3, lambda **how: overlay.occlusion_figure(VIEW, VIEW, VIEW, Heat(1.0), (28, 12), **how)),
    "sphere": (1, lambda **how: sphere_figure(*VIEW, Heat(1.0), projection="mollweide", **how)),
    "sheet": (2, lambda **how: contact_sheet([COLOR, COLOR], "ab", **how)),
    "scanpath": (1, lambda **how: scanpath_figure(COLOR, [[5, 5], [30, 9]], [0.2, 0.6], names=("Ada",), **how)),
    "alignment": (4, lambda **how: maps.alignment_figure(None, POINTS, POINTS + 1, np.eye(4), **how)),
    "cameras": (2, lambda **how: maps.camera_figure(POSES, POINTS, np.full((40, 3), 9, np.uint8), "a", **how)),
    "floor": (1, lambda **how: maps.floor_figure(np.zeros(2), np.ones(2), **how)),
    "plan": (1, lambda **how: maps.floor_plan(rays(), **how)),
    "layout": (1, lambda **how: maps.layout_figure(rays(), rays(), POINTS[:3], 0.1, **how)),
    "aois": (3, lambda **how: charts.aois_figure(ROWS, **how)),
    "transitions": (1, lambda **how: charts.transitions_figure("ab", np.eye(2), **how)),
    "psnr": (1, lambda **how: psnr_figure([{"steps": 1, "seconds": 1.0, "psnr": 20.0}], **how)),
}


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_draws_in_given_axes_and_returns_them(name):
    count, draw = FIGURES[name]
    page = Figure(figsize=(8, 5), dpi=60)
    FigureCanvasAgg(page)
    axes = np.ravel(page.subplots(2, 2))
    panels = axes[:count]
    empty = rasterize(page)
    drawn = draw(axes=panels[0] if count == 1 else panels)
    assert list(np.ravel(drawn)) == list(panels) and figure_of(drawn) is page
    assert (rasterize(page) != empty).any()
    # The others are left alone.
    assert all(not a.has_data() and not a.get_title() for a in axes[count:])
    fresh = draw()
    assert figure_of(fresh) is not page and len(np.ravel(fresh)) == count


def test_a_wrong_number_of_axes_is_refused():
    page = Figure()
    with pytest.raises(NergError, match="3 panels"):
        overlay.occlusion_figure(VIEW, VIEW, VIEW, Heat(1.0), axes=[page.add_subplot()])


@pytest.mark.parametrize("name", FIGURES)
def test_text_follows_the_settings_of_matplotlib(name):
    sizes = []
    for points in (10, 15):
        with matplotlib.rc_context({"font.size": points, "font.family": "serif"}):
            figure = figure_of(FIGURES[name][1]())
            rasterize(figure)
            texts = [t for t in figure.findobj(matplotlib.text.Text) if t.get_text().strip()]
            sizes.append(sorted(t.get_fontsize() for t in texts))
            assert {t.get_fontfamily()[0] for t in texts} == {"serif"}
    # Larger text may need fewer ticks.
    assert np.isclose(sizes[1][-1], 1.5 * sizes[0][-1]) and np.isclose(sizes[1][0], 1.5 * sizes[0][0])


def test_vector_files_hold_text():
    figure = overlay.gaze_figure(*VIEW, Heat(1.0), "Where they looked")
    assert b"Where they looked" in encode(figure, ".svg", {"Comment": "seed 1"})
    pdf = encode(figure, ".pdf", {"Comment": "seed 1"})
    assert pdf == encode(figure, ".pdf", {"Comment": "seed 1"}) and b"seed 1" in pdf and b"CreationDate" not in pdf
    # Fonts are embedded as TrueType, which programs can edit, and not as drawings of the letters.
    assert b"/FontFile2" in pdf and b"/Type3" not in pdf
    streams = [part.partition(b"endstream")[0].strip(b"\r\n") for part in pdf.split(b"stream\n")[1:]]
    assert any(b"Tj" in zlib.decompress(s) or b"TJ" in zlib.decompress(s) for s in streams if s[:1] == b"x")


@pytest.mark.parametrize("peak", [(40, 8), (40, 22), (20, 8), (20, 22)])
def test_the_label_of_the_observer_avoids_the_maximum(peak):
    height, width, at = 120, 200, (100, 60)
    center = np.array(at) + 2.0 * (np.array(peak) - (30, 15))
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    gaze = np.exp(-((x - center[0]) ** 2 + (y - center[1]) ** 2) / 200)
    axes = overlay.gaze_figure(np.full((height, width, 3), 0.2), gaze, np.ones_like(gaze, bool), Heat(1.0), marker=at)
    rasterize(axes)
    label = next(t for t in axes.texts if t.get_text() == "observer")
    (x0, y0), (x1, y1) = axes.transData.inverted().transform(label.get_window_extent())
    assert not (min(x0, x1) < center[0] < max(x0, x1) and min(y0, y1) < center[1] < max(y0, y1))
    assert 0 <= min(x0, x1) and max(x0, x1) <= width and 0 <= min(y0, y1) and max(y0, y1) <= height


def test_held_out_positions_are_on_top():
    axes = maps.layout_figure(rays(), rays(), POINTS[:3], 0.1)
    order = sorted(axes.lines, key=lambda line: line.get_zorder())
    drawn = [line for line in order if line.get_marker() == "." and len(line.get_xdata())]
    assert matplotlib.colors.same_color(drawn[-1].get_color(), "#d9730d") and len(drawn) == 2
    assert max(c.get_zorder() for c in axes.collections) > drawn[-1].get_zorder() > drawn[0].get_zorder()


def test_scanpath_numbers_and_joins_fixations():
    points = [[5, 5], [np.nan, np.nan], [30, 9], [40, 20], [8, 20], [9, 9]]
    axes = scanpath_figure(COLOR, points, [0.2, 1, 0.4, 0.8, 0.3, 0.3], [0, 0, 0, 0, 1, 1], ("Ada", "Bob"))
    assert [t.get_text() for t in axes.texts] == ["1", "3", "4", "1", "2"]
    assert [tuple(t.xy) for t in axes.texts[1:3]] == [(30, 9), (40, 20)]
    first = next(c for c in axes.collections if c.get_label() == "Ada")
    assert np.allclose(first.get_sizes()[2] / first.get_sizes()[1], 2)
    assert np.isnan(axes.lines[0].get_xdata()[1])
    assert axes.get_xlim() == (-0.5, W - 0.5) and axes.get_ylim() == (H - 0.5, -0.5)
