"""Boxes of objects, as people write them, and what is none."""

from __future__ import annotations

import json

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.report.boxes import MOST, Box, read_boxes
from tests.conftest import ROOT


def written(tmp_path, value):
    path = tmp_path / "objects.json"
    path.write_text(json.dumps(value), encoding="utf-8")
    return path


def test_the_ways_to_write_them(tmp_path):
    corners = [[0, 0, 0], [1, 2, 3]]
    for value in (
        {"shelf": corners},
        {"shelf": [0, 0, 0, 1, 2, 3]},
        {"shelf": {"min": corners[0], "max": corners[1]}},
        {"units": "m", "regions": [{"name": "shelf", "min": corners[0], "max": corners[1], "category": "x"}]},
    ):
        (box,) = read_boxes(written(tmp_path, value))
        assert box.name == "shelf" and np.array_equal([box.lower, box.upper], corners)


def test_the_shelves_of_the_store():
    boxes = read_boxes(ROOT / "scenes" / "store" / "regions.json")
    assert len(boxes) > 5 and "gondola_2_east_stationery" in {b.name for b in boxes}


def test_what_lies_in_a_box():
    box = Box("b", np.zeros(3), np.ones(3))
    points = np.array([[0.5, 0.5, 0.5], [1.0, 0.0, 1.0], [1.01, 0.5, 0.5], [np.inf, 0, 0], [0.5, 0.5, -0.2]])
    assert box.holds(points).tolist() == [True, True, False, False, False]
    assert box.holds(points, 0.02).tolist() == [True, True, True, False, False]
    assert box.holds(points.reshape(1, 5, 3)).shape == (1, 5)


@pytest.mark.parametrize(
    "value, why",
    [
        ([], "no JSON object"),
        ({}, "0 boxes"),
        ({"a": [[0, 0, 0], [1, 0, 1]]}, "not below"),
        ({"a": [[0, 0, 0], [1, 1, float("nan")]]}, "not below"),
        ({"a": [0, 1]}, "no lower and upper corner"),
        ({"a": {"min": [0, 0, 0]}}, "no lower and upper corner"),
        ({"a": {"min": "b", "max": {}}}, "no lower and upper corner"),
        ({"a": None}, "no lower and upper corner"),
        ({"": [[0, 0, 0], [1, 1, 1]]}, "a box is called"),
        ({"x" * 101: [[0, 0, 0], [1, 1, 1]]}, "a box is called"),
        ({"regions": [3]}, "a box is called"),
        ({"regions": [{"name": "a", "min": [0, 0, 0], "max": [1, 1, 1]}] * 2}, "in it twice"),
        ({str(k): [[0, 0, 0], [1, 1, 1]] for k in range(MOST + 1)}, "501 boxes"),
    ],
)
def test_what_is_none(tmp_path, value, why):
    with pytest.raises(NergError, match=f"names no objects .*{why}.*coordinates of the place"):
        read_boxes(written(tmp_path, value))
