"""Floor plans of rays: paths by person and recording, sights, fields of view."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays
from nerg_mi.workflows.draw import draw
from tests.workflows.drawing.test_draw_scenes import WALLS_SCENE as SCENE


def walk(hits=True):
    """Ada walks along x, stops being recorded, and comes back; Bob stands."""
    t = np.r_[np.arange(20) * 0.1, 30 + np.arange(20) * 0.1, np.arange(5) * 0.1]
    x = np.r_[np.arange(20) * 0.05, 1 - np.arange(20) * 0.05, np.full(5, -0.5)]
    y = np.r_[np.zeros(20), np.full(20, 0.4), np.full(5, -0.5)]
    person = np.r_[np.zeros(40, np.int32), np.ones(5, np.int32)]
    direction = np.tile([0.0, 1.0, 0.0], (45, 1))
    origin = np.stack([x, y, np.full(45, 1.6)], axis=1)
    return Rays(t, person, ("Ada", "Bob"), origin, direction, np.ones(45), origin + direction * 0.7 if hits else None)


@pytest.fixture
def rays(tmp_path):
    walk().save(tmp_path / "rays.npz")
    return tmp_path / "rays.npz"


def paths(figure):
    return [line for line in figure.axes[0].lines if line.get_linestyle() == "-" and len(line.get_xdata()) > 1]


def test_paths_break_where_nobody_was_recorded(rays):
    figure = draw("floor", rays)
    assert figure.texts[0].get_text() == "45 rays of 2 people"
    assert [t.get_text() for t in figure.axes[0].get_legend().get_texts()] == ["Ada", "Bob"]
    ada = paths(figure)[0]
    xy = np.stack([ada.get_xdata(), ada.get_ydata()], axis=1)
    gaps = np.flatnonzero(np.isnan(xy[:, 0]))
    assert len(gaps) == 2 and gaps[0] == 0
    first, second = xy[1 : gaps[1]], xy[gaps[1] + 1 :]
    assert np.all(first[:, 1] == 0) and np.all(second[:, 1] == 0.4) and len(first) == len(second) == 20


def test_one_person_and_what_they_looked_at(rays):
    figure = draw("floor", rays, people="Bob", rays=3, views=2)
    lines, wedges = (c for c in figure.axes[0].collections if type(c).__name__ in ("LineCollection", "PatchCollection"))
    if type(lines).__name__ == "PatchCollection":
        lines, wedges = wedges, lines
    segments = np.stack(lines.get_segments())
    np.testing.assert_allclose(segments, np.tile([[-0.5, -0.5], [-0.5, 0.2]], (len(segments), 1, 1)))
    assert len(wedges.get_paths()) == 2


def test_over_a_place(rgb, rays, tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    figure = draw("floor", rays, tmp_path / "a.svg", scene=str(tmp_path / "scene.xml"), mode="llvm_ad_rgb")
    assert len(figure.axes[0].images) == 1
    text = (tmp_path / "a.svg").read_text()
    assert "scene.xml" in text and "rays.npz" in text and str(tmp_path) not in text


@pytest.mark.parametrize(
    "given, said", [({"people": "Eve"}, 'no person "Eve"; they have Ada, Bob'), ({"cut": 0.0}, "--cut is a height")]
)
def test_what_is_refused(rays, given, said):
    with pytest.raises(NergError, match=said):
        draw("floor", rays, **given)
