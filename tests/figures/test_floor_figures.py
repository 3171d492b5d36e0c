"""The floor plan: places in metres, walls where they are, and a legend of what is drawn."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PatchCollection

from nerg_mi.figures.maps import PEOPLE, Sight, Walk, Walls, floor_figure
from nerg_mi.figures.style import encode

LOW, HIGH = np.array([0.0, 0.0]), np.array([4.0, 3.0])


def walls():
    height = np.zeros((30, 40))
    height[:, 30:] = np.nan
    height[10:20, 10:20] = 0.6
    cut = np.zeros((30, 40), bool)
    cut[0] = True
    return Walls(LOW, HIGH, height, cut, 1.2)


def test_walls_lie_where_they_are():
    page = floor_figure(LOW, HIGH, walls())
    (image,) = page.axes[0].images
    assert tuple(image.get_extent()) == (0, 4, 0, 3) and image.origin == "lower"
    grey = image.get_array()[..., 0]
    assert np.all(grey[0] == grey[0, 0]) and grey[0, 0] < 0.3  # the cut is darkest
    assert np.all(grey[1:, 30:] == 1) and grey[15, 15] < grey[5, 5] < 1  # nothing is white; the higher, the darker
    assert [t.get_text() for t in page.axes[0].get_legend().get_texts()] == [
        "cut at 1.2 m",
        "lower things",
        "nothing below",
    ]


def test_paths_have_gaps_where_nobody_was_recorded():
    places = np.array([[0.5, 0.5], [1, 0.5], [3, 2], [3.2, 2.2]])
    page = floor_figure(LOW, HIGH, walks=[Walk("Ada", places, np.array([True, False, True, False]))])
    line = next(l for l in page.axes[0].lines if len(l.get_xdata()) > 2)
    xy = np.stack([line.get_xdata(), line.get_ydata()], axis=1)
    np.testing.assert_array_equal(xy[~np.isnan(xy[:, 0])], places)
    assert list(np.isnan(xy[:, 0])) == [True, False, False, True, False, False] and line.get_color() == PEOPLE[0]


def test_rays_and_fields_of_view():
    origins, ends = np.array([[1.0, 1], [2, 2]]), np.array([[1.0, 2], [3, 2]])
    sight = Sight(origins, ends, np.array([0, 1]))
    page = floor_figure(LOW, HIGH, rays=sight, fields=sight, fov=40)
    (lines,) = [c for c in page.axes[0].collections if isinstance(c, LineCollection)]
    np.testing.assert_array_equal(np.stack(lines.get_segments()), np.stack([origins, ends], axis=1))
    (wedges,) = [c for c in page.axes[0].collections if isinstance(c, PatchCollection)]
    for path, o, e in zip(wedges.get_paths(), origins, ends):
        away = path.vertices - o
        reach = np.linalg.norm(away, axis=1).max()
        assert reach == pytest.approx(np.linalg.norm(e - o), rel=0.02)
        tip = away[np.linalg.norm(away, axis=1) > 0.5 * reach]
        angle = np.degrees(np.arccos(np.clip((tip / np.linalg.norm(tip, axis=1)[:, None]) @ ((e - o) / reach), -1, 1)))
        assert angle.max() == pytest.approx(20, abs=1.5)
    names = [t.get_text() for t in page.axes[0].get_legend().get_texts()]
    assert names == ["to what was looked at", "field of view, 40°"]


def test_many_people_share_a_legend_and_nothing_overlaps():
    walk = lambda k: Walk(
        f"somebody with a rather long name {k}", np.array([[0.1 * k, 0.1], [1, 1]]), np.array([True, False])
    )
    page = floor_figure(LOW, HIGH, walls(), [walk(k) for k in range(20)], title="20 people")
    page.canvas.draw()
    texts = page.axes[0].get_legend().get_texts()
    assert len(texts) == 12 and texts[-1].get_text() == "and 12 more people"
    boxes = [t.get_window_extent().extents for t in (*texts, *page.texts)]
    for k, a in enumerate(boxes):
        assert a[0] >= 0 and a[3] <= page.bbox.height and a[2] <= page.bbox.width
        for b in boxes[:k]:
            assert min(a[2], b[2]) - max(a[0], b[0]) <= 0.5 or min(a[3], b[3]) - max(a[1], b[1]) <= 0.5


def test_equal_input_equal_file():
    made = [encode(floor_figure(LOW, HIGH, walls()), suffix) for suffix in (".png", ".svg") for _ in range(2)]
    assert made[0] == made[1] and made[2] == made[3]
