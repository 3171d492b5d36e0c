"""Hatching: exactly where nothing is known, and plainly not a value."""

from __future__ import annotations

import numpy as np

from nerg_mi.figures.style import SEQUENTIAL, color_values, hatch, lines, swatch

SHOWN = np.random.default_rng(0).random((40, 60, 3))
UNKNOWN = np.zeros((40, 60), bool)
UNKNOWN[5:30, 10:50] = True


def test_only_what_is_unknown_changes_and_all_of_it():
    drawn = hatch(SHOWN, UNKNOWN)
    np.testing.assert_array_equal(np.any(drawn != SHOWN, axis=-1), UNKNOWN)
    np.testing.assert_array_equal(hatch(SHOWN, ~UNKNOWN & UNKNOWN), SHOWN)
    assert drawn.min() >= 0 and drawn.max() <= 1


def test_lines_are_a_quarter_and_run_along_diagonals():
    on = lines(64, 64)
    assert on.mean() == 0.25 and np.array_equal(on[1:, :-1], on[:-1, 1:])
    assert lines(64, 64, 2)[::2, ::2].mean() == 0.25


def test_it_looks_like_no_value():
    """Grey lines beside pale ones: no place of any scale, over any picture, is grey and dark."""
    pale = hatch(np.zeros((16, 16, 3)), np.full((16, 16), True))
    assert np.ptp(np.unique(pale)) > 0.1 and np.allclose(pale[..., 0], pale[..., 2])
    for name in SEQUENTIAL[:4]:
        colors = color_values(name, np.linspace(0.2, 1, 50))
        assert np.ptp(colors, axis=1).min() > 0.15


def test_the_swatch_is_hatched():
    np.testing.assert_array_equal(swatch(16, 16), hatch(np.full((16, 16, 3), 0.5), np.full((16, 16), True)))
