"""Boxes that are laid around what is seen within a rectangle."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.areas import Region
from nerg_mi.viewer.controls import box_around, edges
from nerg_mi.viewer.points import View


def test01_around_the_foremost():
    rng = np.random.default_rng(4)
    thing = np.array([2.0, 0, 1]) + 0.2 * (rng.random((500, 3)) - 0.5)
    wall = np.stack([np.full(500, 9.0), *(4 * rng.random((2, 500)) - 2)], axis=1)
    view = View.of((0, 0, 1), (2, 0, 1), (0, 0, 1), 1.0, 1.5)
    lower, upper = box_around(np.concatenate([thing, wall]), 0.01, view, (0.4, 0.35), (0.6, 0.65))
    assert np.allclose(lower, [1.9, -0.1, 0.9], atol=0.03) and np.allclose(upper, [2.1, 0.1, 1.1], atol=0.03)
    with pytest.raises(NergError, match="nothing within"):
        box_around(thing, 0.01, view, (0.8, 0.8), (0.9, 0.9))


def test02_a_rectangle_to_the_right_and_above():
    view = View.of((0, 0, 0), (1, 0, 0), (0, 0, 1), 1.0, 1.0)
    right, left = np.array([2, -0.5, 0.5]), np.array([2, 0.5, -0.5])
    points = np.concatenate([np.tile(p, (20, 1)) for p in (right, left)])
    lower, upper = box_around(points, 0.1, view, (0.55, 0.05), (0.95, 0.45))
    assert np.allclose((lower + upper) / 2, right)


def test03_a_box_has_twelve_edges():
    found = edges(Region.of("a", [0, 0, 0], [1, 2, 3]))
    lengths = np.sort(np.abs(found[:, 1] - found[:, 0]).sum(axis=1))
    assert found.shape == (12, 2, 3) and np.allclose(lengths, [1] * 4 + [2] * 4 + [3] * 4)
    assert len(np.unique(found.reshape(12, -1), axis=0)) == 12 and len(np.unique(found.reshape(-1, 3), axis=0)) == 8
