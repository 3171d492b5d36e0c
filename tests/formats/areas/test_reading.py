"""Areas of interest of every kind as files."""

from __future__ import annotations

import json

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.areas import Group, MeshPart, Region, SceneShape, files_of_areas, read_areas, read_regions, to_json

BOX = {"name": "shelf", "min": [0, 0, 0], "max": [1, 2, 3]}


def written(tmp_path, *entries, name="a.json"):
    path = tmp_path / name
    path.write_text(json.dumps({"regions": entries}))
    return path


def test01_one_of_every_kind(tmp_path):
    path = written(
        tmp_path,
        BOX,
        {"name": "sign", "mesh": "sign.ply", "faces": [0, [4, 9]]},
        {"name": "till", "shape": "till_0"},
        {"name": "all", "parts": ["shelf", "both"]},
        {"name": "both", "parts": ["till", "shelf"]},
    )
    areas = read_areas(path)
    assert areas.areas == (
        Region.of("shelf", [0, 0, 0], [1, 2, 3]),
        MeshPart("sign", tmp_path / "sign.ply", ((0, 0), (4, 9))),
        SceneShape("till", "till_0"),
        Group("all", ("shelf", "both")),
        Group("both", ("till", "shelf")),
    )
    assert areas.members() == {"shelf": (0,), "sign": (1,), "till": (2,), "all": (0, 2), "both": (0, 2)}
    assert areas.areas[1].chosen(12).nonzero()[0].tolist() == [0, 4, 5, 6, 7, 8, 9]
    with pytest.raises(NergError, match="face 9"):
        areas.areas[1].chosen(9)
    assert files_of_areas(path, areas) == [path, tmp_path / "sign.ply"] and files_of_areas(tmp_path, areas) == []
    # Boxes alone, for those who know nothing else; and what they save again has all of them.
    assert read_regions(path) == [areas.areas[0]] == areas.boxes
    (tmp_path / "b.json").write_text(to_json(areas.boxes, areas.others))
    assert read_areas(tmp_path / "b.json") == areas


def test02_old_files_read_alike(tmp_path):
    for k, value in enumerate(({"a": [[0, 0, 0], [1, 2, 3]]}, {"mesh": {"min": [0, 0, 0], "max": [1, 2, 3]}})):
        path = tmp_path / f"{k}.json"
        path.write_text(json.dumps(value))
        assert list(read_areas(path).areas) == read_regions(path)


def test03_a_turned_box(tmp_path):
    half = np.sqrt(0.5)
    path = written(tmp_path, BOX | {"turn": 90}, BOX | {"name": "b", "turn": [0, 0, 2 * half, 2 * half]})
    for box in read_areas(path).boxes:
        # Sizes 1 x 2 x 3 about (0.5, 1, 1.5): a quarter turn exchanges the first two.
        assert np.allclose(box.bounds, [[-0.5, 0.5, 0], [1.5, 1.5, 3]])
        assert box.holds(np.array([[-0.4, 1.0, 1.0], [0.5, 0.2, 1.0]])).tolist() == [True, False]
        assert np.allclose(box.place(box.to_own(np.array([0.3, 4.0, -2.0]))), [0.3, 4.0, -2.0])
    # Turned by 30 degrees: the formula of a plane rotation.
    box = Region.of("c", [0, 0, 0], [2, 1, 1], 30)
    along = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0])
    assert box.holds(box.middle + 0.99 * along) and not box.holds(box.middle + 1.01 * along)
    assert read_regions(path) == read_areas(path).boxes
    (tmp_path / "b.json").write_text(to_json([box]))
    assert read_regions(tmp_path / "b.json") == [box]


def test04_groups_of_boxes_are_solids(tmp_path):
    other = {"name": "b", "min": [5, 0, 0], "max": [6, 1, 1]}
    mesh = {"name": "m", "mesh": "m.ply"}
    path = written(tmp_path, BOX, other, mesh, {"name": "g", "parts": ["shelf", "b"]}, {"name": "h", "parts": ["m"]})
    areas = read_areas(path)
    assert areas.solids == {"shelf": (0,), "b": (1,), "g": (0, 1)} and [b.name for b in areas.boxes] == ["shelf", "b"]


@pytest.mark.parametrize(
    "entries",
    [
        [{"name": "g", "parts": ["g"]}],
        [{"name": "g", "parts": ["h"]}, {"name": "h", "parts": ["g"]}],
        [{"name": "g", "parts": ["nobody"]}],
        [{"name": "g", "parts": []}],
        [{"name": "g", "parts": "abc"}],
        [{"name": "g", "parts": [3]}],
        [{"parts": ["a"]}],
        [BOX, {"name": "shelf", "shape": "x"}],
        [{"name": "s", "shape": 3}],
        [{"name": "s", "shape": ""}],
        [{"name": "a\n", "shape": "x"}],
        [{"name": "m", "mesh": 3}],
        [{"name": "m", "mesh": "m.stl"}],
        [{"name": "m", "mesh": "../m.ply"}],
        [{"name": "m", "mesh": "/m.ply"}],
        [{"name": "m", "mesh": "m\0.ply"}],
        [{"name": "m", "mesh": "m.ply", "faces": []}],
        [{"name": "m", "mesh": "m.ply", "faces": [-1]}],
        [{"name": "m", "mesh": "m.ply", "faces": [[3, 2]]}],
        [{"name": "m", "mesh": "m.ply", "faces": [[1, 2, 3]]}],
        [{"name": "m", "mesh": "m.ply", "faces": [True]}],
        [{"name": "m", "mesh": "m.ply", "faces": 7}],
        [{"adt": "nowhere"}],
        [{"adt": "..", "name": "x"}],
        [BOX | {"turn": [0, 0, 0, 0]}],
        [BOX | {"turn": [0, 0, 1]}],
        [BOX | {"turn": "x"}],
        [BOX | {"turn": 1e400}],
    ],
)
def test05_others_are_told_in_a_sentence(tmp_path, entries):
    path = written(tmp_path, *entries)
    with pytest.raises(NergError) as told:
        read_areas(path)
    assert str(tmp_path) in str(told.value) and "\n" not in str(told.value)


def test06_groups_may_be_nested_so_deep(tmp_path):
    entries = [BOX, {"name": "0", "parts": ["shelf"]}]
    entries += [{"name": str(k), "parts": [str(k - 1)]} for k in range(1, 400)]
    assert read_areas(written(tmp_path, *entries)).members()["399"] == (0,)
    assert read_areas(written(tmp_path, *entries[60::-1])).members()["59"] == (0,)
    with pytest.raises(NergError, match="deeper"):
        read_areas(written(tmp_path, *entries[::-1]))
