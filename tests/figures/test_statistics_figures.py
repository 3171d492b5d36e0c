"""Pictures of statistics: what is drawn is what the rows say."""

from __future__ import annotations

import numpy as np

from nerg_mi.figures.statistics import map_figure, moves_figure, things_figure
from nerg_mi.figures.style import rasterize


def row(thing, source, share):
    return {
        "thing": thing,
        "source": source,
        "share": share,
        "share_low": share / 2,
        "share_high": 2 * share,
        "reach": None,
        "dwell": 1.0,
    }


def test01_bars_are_as_long_as_shares_and_sorted():
    page = things_figure([row("a", "tracked", 0.1), row("b", "tracked", 0.3), row("a", "field", 0.2)])
    axis = page.axes[0]
    assert [t.get_text() for t in axis.get_yticklabels()] == ["a", "b"]
    assert sorted(p.get_width() for p in axis.patches) == [10.0, 30.0]
    lines = [line.get_xdata().tolist() for line in axis.lines]
    assert [5.0, 20.0] in lines and [20.0] in lines
    assert rasterize(page).std() > 5


def test02_moves_are_percent_of_their_row():
    page = moves_figure(["a", "b"], np.array([[0, 3.0], [0, 0]]))
    assert page.axes[0].images[0].get_array().filled(0).tolist() == [[0, 100], [0, 0]]
    assert rasterize(page).std() > 5


def test03_a_map():
    page = map_figure(np.array([[0.0, 0], [1, 0], [1, 1]]), np.array([1.0, 2, 3]), 1.0, "m²", "map")
    assert page.axes[0].collections[0].get_array().tolist() == [1, 2, 3]
    assert rasterize(page).std() > 5


def test04_no_things():
    assert rasterize(things_figure([])).shape[2] == 3
