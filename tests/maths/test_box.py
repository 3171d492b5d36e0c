"""The box of a field and its map to the unit cube."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.maths.geometry import Box

BOX = Box((-1, 0, 2), (3, 2, 3))


def test01_measures():
    assert BOX.side == 4 and BOX.center == (1, 1, 2.5) and np.isclose(BOX.diagonal, 21**0.5)
    assert BOX.to_dict() == {"lower": [-1, 0, 2], "upper": [3, 2, 3]} and Box(**BOX.to_dict()) == BOX


def test02_one_scale_about_the_centre():
    p = np.array([[-1, 0, 2], [3, 2, 3], [1, 1, 2.5]], float)
    expected = [[0, 0.25, 0.375], [1, 0.75, 0.625], [0.5, 0.5, 0.5]]
    assert np.allclose(BOX.to_unit(p), expected)
    assert np.allclose(np.array(BOX.to_unit(ns.Array3f(p.T))).T, expected, atol=1e-7)


@pytest.mark.parametrize("factor", [1e-3, 1, 1e6])
def test03_corners_map_into_the_cube(factor):
    # A corner that rounding pushes out of the cube would lose its features.
    rng = np.random.default_rng(0)
    for _ in range(30):
        lower = rng.normal(size=3) * factor
        box = Box(lower, lower + rng.random(3) * factor)
        longest = int(np.argmax(np.subtract(box.upper, box.lower)))
        u = np.array(box.to_unit(ns.Array3f(np.array([box.lower, box.upper]).T))).T
        assert np.allclose(u[:, longest], [0, 1], atol=1e-5)


def test04_contains():
    p = np.array([[-1, 0, 2], [3, 2, 3], [1, 1, 2.5], [1, 1, 3.001], [-1.001, 1, 2.5], [np.nan, 1, 2.5]])
    assert BOX.contains(ns.Array3f(p.T)).numpy().tolist() == [True, True, True, False, False, False]


@pytest.mark.parametrize(
    "lower, upper, words",
    [
        ((0, 0, 0), (1, 1, 0), "must exceed"),
        ((0, 0), (1, 1), "3 numbers"),
        ((0, 0, 0), (1, 1, np.inf), "finite"),
        ((0, 0, np.nan), (1, 1, 1), "finite"),
        ((2, 0, 0), (1, 1, 1), "must exceed"),
    ],
)
def test05_wrong_corners(lower, upper, words):
    with pytest.raises(ValueError, match=words):
        Box(lower, upper)
