"""What rows tell of their frame."""

import numpy as np
import pytest

from nerg_mi.rays import guess as rows
from tests.rays.guess.tables import FORWARD, frame, walk

WALK = walk(3)


@pytest.mark.parametrize("to, up", [("z right", "z"), ("y left", "y"), ("y right", "y")])
@pytest.mark.parametrize("units", ["m", "cm", "mm"])
def test_heads_stand(to, up, units):
    eye, _, _ = frame(WALK, to, rows.UNITS[units])
    found = rows.find_standing(eye)
    assert found is not None and (found.up, found.units) == (up, units) and abs(found.height - 1.62) < 0.02
    upside_down = rows.find_standing(-eye)
    assert upside_down is not None and upside_down.up == "-" + up


def test_rows_that_tell_nothing():
    eye = frame(WALK, "z right")[0]
    assert rows.find_standing(eye + [0, 0, 40]) is None and rows.find_standing(np.full((5, 3), np.nan)) is None
    assert rows.find_standing(np.tile([0.0, 0.0, 1.6], (9, 1))) is None  # nothing moves
    # Somebody who sits at 1.3 m along two axes.
    still = np.array([1.3, 5.0, 1.3]) + np.random.default_rng(0).normal(0, 0.05, (500, 3))
    assert rows.find_standing(still) is None


@pytest.mark.parametrize("rate", [11.0, 50.0, 200.0, 1000.0])
@pytest.mark.parametrize("tick", [1e-3, 1e-6, 1e-9])
def test_clocks(rate, tick):
    found = rows.find_tick(np.arange(100) / rate / tick)
    # At 11 to 2,100 a second units a thousand apart cannot both fit.
    assert found == tick
    assert rows.find_tick(np.zeros(9)) is None and rows.find_tick(np.array([1.0])) is None
    assert rows.find_tick(np.arange(9) * 3.6e8) is None


@pytest.mark.parametrize("to", FORWARD)
def test_heads_look_where_they_walk(to):
    eye, gaze, head = frame(WALK, to)
    turns, up = head.as_matrix(), "z" if to.startswith("z") else "y"
    name = rows.find_forward(turns, eye, WALK.t, up, 1.0)
    assert name is not None and np.allclose(rows.poses.AXES[name], FORWARD[to])
    assert rows.find_forward(turns, eye * 0, WALK.t, up, 1.0) is None
    assert rows.find_forward(turns[:20], eye[:20], WALK.t[:20], up, 1.0) is None
    assert rows.find_local(head.inv().apply(gaze), turns, name) is True
    assert rows.find_local(gaze, turns, name) is False
    assert rows.find_local(gaze, np.tile(np.eye(3), (len(gaze), 1, 1)), name) is None


def test_unit_vectors():
    assert rows.is_unit(np.eye(3)) and not rows.is_unit(2 * np.eye(3)) and not rows.is_unit(np.zeros((3, 3)))
    assert rows.is_unit(np.array([[np.nan, 0, 0], [0, 0, 0], [0, 0, 1.0]]))
