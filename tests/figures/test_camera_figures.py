"""Cameras and points from above and from the side."""

from __future__ import annotations

import numpy as np

from nerg_mi.figures.maps import camera_figure
from nerg_mi.figures.style import save


def poses() -> np.ndarray:
    out = np.tile(np.eye(4), (5, 1, 1))
    out[:, 0, 3] = np.arange(5)
    return out


def test_both_plans_show_every_camera_and_the_points(tmp_path):
    points = np.random.default_rng(0).uniform(-1, 6, (500, 3))
    points[0] = 1e6
    figure = camera_figure(poses(), points, np.full((500, 3), 90, np.uint8), "5 of 6 pictures")
    above, side = figure.axes
    assert (above.get_xlabel(), above.get_ylabel(), side.get_ylabel()) == ("x", "y", "z")
    for axes in figure.axes:
        # The path, and a wedge each.
        assert len(axes.lines) == 6 and 400 < len(axes.collections[0].get_offsets()) < 500
        assert axes.get_xlim()[0] < 0 and 4 < axes.get_xlim()[1] < 20
    save(figure, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_wedges_open_to_where_cameras_look():
    """OpenGL cameras look along -z, which is down from the side."""
    wedge = camera_figure(poses()[:1], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "").axes[1].lines[1]
    assert min(wedge.get_ydata()) <= 0 and max(wedge.get_ydata()) == 0
