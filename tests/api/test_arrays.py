"""What comes in from NumPy and what goes out to it."""

import copy
import pickle

import numpy as np
import pytest

from nerg_mi.api.arrays import Labelled, points, same_for_all, unit
from nerg_mi.errors import NergError


def test01_points_of_every_shape():
    assert points((1, 2, 3), "x").shape == (1, 3)
    assert points([[1, 2, 3], [4, 5, 6]], "x").dtype == np.float32
    assert points(np.ones((5, 3), int)[::2], "x").flags.c_contiguous


@pytest.mark.parametrize(
    "wrong, said",
    [
        ((1, 2), r"eyes must have the shape \(3,\) or \(N, 3\), got \(2,\)"),
        (np.zeros((0, 3)), r"shape .* got \(0, 3\)"),
        ("here", "eyes must be numbers"),
        ([(0, 0, 0), (0, np.nan, 0)], r"row 1 is \[0.0, nan, 0.0\]"),
        ([(0, 0, 0), (0, 0, 1.1e7)], "coordinates from -1e.07 to 1e.07, and row 1"),
        ((1e308, 0, 0), "row 0 is"),
        ((10**400, 0, 0), "eyes must have coordinates from"),
        ([(0, 0), (0, 0, 1)], "eyes must be numbers"),
    ],
)
def test02_wrong_points_are_told_by_name(wrong, said):
    with pytest.raises(NergError, match=said):
        points(wrong, "eyes")


def test03_directions_are_made_unit_and_one_serves_all():
    d = unit((0, 3, 4), 5, "d")
    assert d.shape == (5, 3) and np.allclose(d, (0, 0.6, 0.8))
    with pytest.raises(NergError, match="d must not be zero, and row 1 is"):
        unit([(1, 0, 0), (0, 0, 0)], 2, "d")
    with pytest.raises(NergError, match="as many as the origins, 3, got 2"):
        unit([(1, 0, 0), (0, 1, 0)], 3, "d")


def make():
    depth = same_for_all(np.arange(6, dtype=np.float32).reshape(2, 3), 4)
    color = np.zeros((4, 2, 3, 3), np.float32)
    return Labelled({"depth": depth, "color": color}, ("observer", "row", "column"), np.zeros((4, 3), np.float32))


def test04_arrays_have_names():
    result = make()
    assert result.names == ("depth", "color") and list(result) == ["depth", "color"] and len(result) == 2
    assert result.depth is result["depth"] and "color" in result and "gaze" not in result
    assert "depth" in dir(result)
    assert repr(result).splitlines() == [
        "Labelled(observer 4, row 2, column 3)",
        "  depth  (4, 2, 3), float32",
        "  color  (4, 2, 3, 3), float32",
    ]


def test05_what_is_not_there_is_said():
    with pytest.raises(KeyError, match='"gaze"'):
        make()["gaze"]
    with pytest.raises(AttributeError, match='there is no "gaze"'):
        make().gaze  # noqa: B018


def test06_what_is_the_same_for_all_cannot_be_written_to():
    with pytest.raises(ValueError):
        make().depth[0, 0, 0] = 1


def test07_copies():
    result = make()
    assert np.array_equal(copy.copy(result).depth, result.depth)
    assert np.array_equal(pickle.loads(pickle.dumps(result)).color, result.color)
