"""A browser is given as many points as it draws quickly."""

from __future__ import annotations

import pytest

from nerg_mi.viewer.page import BrowserWindow
from nerg_mi.viewer.points import LEVELS


@pytest.mark.parametrize(
    ("seconds", "at_rest", "change"),
    [(0.2, False, 1), (0.2, True, 1), (0.03, True, 0), (0.017, True, -1), (0.017, False, 0)],
)
def test01_points_follow_the_pace(seconds, at_rest, change):
    window = BrowserWindow(None, None)
    before = window.level
    for _ in range(20):
        window.learn_pace(seconds)
    # The mouse rests now and then, and the page was left for a while.
    for pause in (0.4, 0.9, 60.0):
        window.learn_pace(pause)
    assert window.level_for_pace(at_rest) == before + change


def test02_a_few_frames_say_nothing_and_levels_have_an_end():
    window = BrowserWindow(None, None)
    window.learn_pace(0.9)
    assert window.level_for_pace(True) == window.level
    for pace, end in ((0.5, LEVELS - 1), (0.01, 0)):
        window.frames[:] = [pace] * 20
        for _ in range(2 * LEVELS):
            window.level = window.level_for_pace(True)
        assert window.level == end


def test03_slow_frames_are_no_rest():
    window = BrowserWindow(None, None)
    assert window.rest == pytest.approx(0.12)
    for _ in range(10):
        window.learn_pace(0.02)
    assert window.rest == pytest.approx(0.12)
    window.learn_pace(0.9)
    assert window.rest == pytest.approx(0.12)
    for _ in range(8):
        window.learn_pace(0.2)
    assert window.rest == pytest.approx(0.6)
    for _ in range(10):
        window.learn_pace(0.9)
    assert window.rest == pytest.approx(0.8)
