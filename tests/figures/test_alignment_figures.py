import numpy as np
import pytest

from nerg_mi.figures.maps import alignment_figure


@pytest.mark.parametrize("place", [None, np.random.default_rng(0).uniform(0, 4, (500, 3))])
def test_four_plans_hold_what_they_show_before_and_after(place):
    points, heads = np.random.default_rng(1).uniform(0, 2, (2, 300, 3))
    shift = np.eye(4)
    shift[:3, 3] = 1, 2, 0
    figure = alignment_figure(place, points, heads, shift, cut=3.0)
    assert [a.get_title(loc="left") for a in figure.axes] == [
        f"{when}, {view}" for when in ("before", "after") for view in ("from above", "from the side")
    ]
    kinds = 2 if place is None else 3
    for axes, moved in zip(figure.axes, (points, points, points + (1, 2, 0), points + (1, 2, 0))):
        assert len(axes.collections) == kinds
        drawn = axes.collections[-2].get_offsets()
        b = 1 if axes in (figure.axes[0], figure.axes[2]) else 2
        np.testing.assert_allclose(np.sort(drawn[:, 1]), np.sort(moved[:, b]))


def test_the_ceiling_is_cut_from_above_only():
    place = np.array([[0.0, 0, 0], [1, 1, 1], [0, 0, 3], [1, 0, 3]])
    figure = alignment_figure(place, place, None, np.eye(4), cut=2.0)
    assert [len(a.collections[0].get_offsets()) for a in figure.axes] == [2, 4, 2, 4]
