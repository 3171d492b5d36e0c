"""Areas of interest as files."""

from __future__ import annotations

import json

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.areas import MOST, Region, read_regions, to_json
from nerg_mi.workflows import demo


def test01_there_and_back(tmp_path):
    regions = [Region.of("shelf", [0, 1, 2], [1, 2, 3.5]), Region.of("Käse & Co", [-1, -1, -1], [0, 0, 0])]
    (tmp_path / "a.json").write_text(to_json(regions))
    assert read_regions(tmp_path / "a.json") == regions
    assert np.array_equal(regions[0].corners, [[0, 1, 2], [1, 2, 3.5]])


def test02_those_of_the_store():
    regions = read_regions(demo.store_scene().parent / "regions.json")
    assert len(regions) > 20 and all((r.corners[0] < r.corners[1]).all() for r in regions)


def test03_the_ways_to_write_them(tmp_path):
    corners = [[0, 0, 0], [1, 2, 3]]
    for value in ({"shelf": corners}, {"shelf": {"min": corners[0], "max": corners[1]}}):
        (tmp_path / "a.json").write_text(json.dumps(value))
        assert read_regions(tmp_path / "a.json") == [Region.of("shelf", *corners)]


def test04_what_lies_in_a_box():
    box = Region.of("b", [0, 0, 0], [1, 1, 1])
    points = np.array([[0.5, 0.5, 0.5], [1.0, 0.0, 1.0], [1.01, 0.5, 0.5], [np.inf, 0, 0], [0.5, 0.5, -0.2]])
    assert box.holds(points).tolist() == [True, True, False, False, False]
    assert box.holds(points, 0.02).tolist() == [True, True, True, False, False]
    assert box.holds(points.reshape(1, 5, 3)).shape == (1, 5)


BOX = {"name": "a", "min": [0, 0, 0], "max": [1, 1, 1]}


@pytest.mark.parametrize(
    "found",
    [
        [],
        {},
        {"regions": 3},
        {"a": [[0, 0, 0], [1, 1, float("nan")]]},
        {"a": [0, 1]},
        {"a": [0, 0, 0, 1, 1, 1]},
        {"a": None},
        {"": [[0, 0, 0], [1, 1, 1]]},
        {"regions": [3]},
        {"regions": [{"name": "a"}]},
        {"regions": [BOX | {"min": [0, 0]}]},
        {"regions": [BOX | {"min": "000"}]},
        {"regions": [BOX | {"min": [0, 0, "x"]}]},
        {"regions": [BOX | {"min": [0, 0, True]}]},
        {"regions": [BOX | {"min": [1, 0, 0]}]},
        {"regions": [BOX | {"max": [1, 1, 1.1e7]}]},
        {"regions": [BOX | {"max": [1, 1, 10**400]}]},
        {"regions": [BOX | {"name": 7}]},
        {"regions": [BOX | {"name": ""}]},
        {"regions": [BOX | {"name": "a\n"}]},
        {"regions": [BOX | {"name": "a" * 81}]},
        {"regions": [BOX, BOX]},
        {"regions": [BOX] * (MOST + 1)},
    ],
)
def test05_others_are_told_in_a_sentence(tmp_path, found):
    path = tmp_path / "a.json"
    path.write_text(json.dumps(found))
    with pytest.raises(NergError) as told:
        read_regions(path)
    assert str(path) in str(told.value) and "\n" not in str(told.value)


def test06_no_json(tmp_path):
    path = tmp_path / "a.json"
    path.write_bytes(b"\xff{")
    with pytest.raises(NergError, match="a.json"):
        read_regions(path)
    with pytest.raises(NergError, match="b.json"):
        read_regions(tmp_path / "b.json")
