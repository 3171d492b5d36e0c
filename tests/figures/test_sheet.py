"""The page: nothing lies upon anything else, whatever the pictures' sizes, and bars say what is shown."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from nerg_mi.figures.overlay import Heat, gaze_figure, scale_strip
from nerg_mi.figures.style import Sheet, even, rasterize, wrap

SIZES = [(320, 480), (60, 1200), (500, 60), (16, 24), (1, 1), (900, 1600), (3, 400)]


def boxes(page):
    """Boxes (x0, y0, x1, y1) of all texts that are shown, and of the axes with pictures."""
    page.canvas.draw()
    renderer = page.canvas.get_renderer()
    texts = [
        t.get_window_extent(renderer)
        for axes in page.axes
        for t in (*axes.texts, axes.title, axes.xaxis.label, axes.yaxis.label, *axes.get_yticklabels())
        if t.get_text() and t.get_visible()
    ]
    return [b.extents for b in texts], [a.get_window_extent(renderer).extents for a in page.axes]


def overlap(a, b, slack=0.5):
    return min(a[2], b[2]) - max(a[0], b[0]) > slack and min(a[3], b[3]) - max(a[1], b[1]) > slack


@pytest.mark.parametrize(
    "size, label", list(zip(SIZES, itertools.cycle(("gaze density [1/sr]", "training rays around the observer"))))
)
def test_no_label_lies_upon_another_or_leaves_the_page(size, label):
    values = np.linspace(0, 2e-5, size[0] * size[1]).reshape(size)
    color, mask = np.zeros((*size, 3)), np.ones(size, bool)
    page = gaze_figure(color, values, mask, Heat(1.6e-5), "Where people looked", label, None, values < 1e-6)
    texts, axes = boxes(page)
    width, height = page.bbox.size
    for a, b in itertools.combinations(texts, 2):
        assert not overlap(a, b)
    for a in texts:
        assert a[0] >= 0 and a[1] >= 0 and a[2] <= width + 0.01 and a[3] <= height + 0.01
        assert not any(overlap(a, b) for b in axes)
    for a, b in itertools.combinations(axes, 2):
        assert not overlap(a, b)
    assert [n % 2 for n in rasterize(page).shape[:2]] == [0, 0]


def test_large_pictures_have_large_text():
    small, large = (Sheet([np.zeros((h, 2 * h, 3))], ["a"], scale=True) for h in (200, 2000))
    assert small.unit == 1 and 3 < large.unit < 6
    assert large.panels[0].title.get_fontsize() == pytest.approx(large.unit * small.panels[0].title.get_fontsize())


def test_rows_and_columns():
    sheet = Sheet([np.full((100, 160, 3), k / 5) for k in range(5)], list("abcde"), columns=2)
    at = [tuple(np.round(p.get_window_extent().extents)) for p in sheet.panels]
    assert len({a[0] for a in at}) == 2 and len({a[1] for a in at}) == 3
    assert [p.get_title() for p in sheet.panels] == list("abcde")
    assert all(
        (round(p.get_window_extent().width), round(p.get_window_extent().height)) == (160, 100) for p in sheet.panels
    )


@pytest.mark.parametrize("decades", [0.0, 6.0])
def test_ticks_stand_at_the_colours_of_their_values(decades):
    """A tick's place on the bar has the colour that a pixel of its value has."""
    heat = Heat(2.0, decades=decades)
    page = gaze_figure(np.full((200, 200, 3), 0.2), np.zeros((200, 200)), np.ones((200, 200), bool), heat)
    bar = page.axes[-1]
    strip = bar.images[0].get_array()[:, 0]
    np.testing.assert_allclose(strip, scale_strip(heat))
    names = [t.get_text() for t in bar.get_yticklabels()]
    power = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    for place, name in zip(bar.get_yticks(), names):
        text = name.translate(power)
        value = 10.0 ** int(text[2:]) if decades and text not in ("1", "10") else float(text)
        expected = np.log10(value / heat.low) / decades if decades else value / heat.top
        assert place == pytest.approx(expected, abs=1e-6)
        assert heat.shares(value) == pytest.approx(place, abs=1e-6)


def test_helpers():
    assert [even(v) for v in (3, 4, 4.2, 4.6)] == [4, 4, 4, 6]
    assert wrap("one two three", 60, 10).count("\n") >= 1 and wrap("", 60, 10) == ""
