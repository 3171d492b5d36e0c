"""Changes to a scene: read, and made."""

from __future__ import annotations

import json

import numpy as np
import pytest

from nerg_mi.aoi.scene import changed_areas, changed_scene, read_changes
from nerg_mi.errors import NergError
from nerg_mi.formats.areas import Areas, Group, Region, SceneShape
from nerg_mi.rendering.scene import load_scene

from .place import SIGN, write_place


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(write_place(tmp_path_factory.mktemp("place"), gaze=False), merge=False)


def written(tmp_path, **changes):
    (tmp_path / "c.json").write_text(json.dumps(changes))
    return read_changes(tmp_path / "c.json")


def cast(scene, o, d):
    import mitsuba as mi

    ray = mi.Ray3f(mi.Point3f(*map(float, o)), mi.Vector3f(*map(float, d)))
    return float(np.array(scene.ray_intersect_preliminary(ray).t).ravel()[0])


EYE, EAST = (1.0, 1.6, 1.6), (1.0, 0, 0)


def test01_moved_and_turned(scene, tmp_path):
    assert cast(scene, EYE, EAST) == pytest.approx(1.5)
    moved, shapes = changed_scene(scene, written(tmp_path, move=[{"shape": "stand", "by": [0.3, 0, 0]}]))
    assert cast(moved, EYE, EAST) == pytest.approx(1.8, abs=1e-5) and set(shapes) == {"room", "sign", "stand"}
    # A quarter turn about its own middle: 0.4 x 1 m become 1 x 0.4 m.
    turned, _ = changed_scene(scene, written(tmp_path, move=[{"shape": "stand", "turn": 90}]))
    assert cast(turned, EYE, EAST) == pytest.approx(2.7 - 0.5 - 1.0, abs=1e-5)
    assert cast(turned, (1.0, 1.9, 1.6), EAST) == pytest.approx(3.0, abs=1e-5)
    # The scene that there was is as it was, and so are the names of its shapes.
    assert cast(scene, EYE, EAST) == pytest.approx(1.5)
    assert {s.id() for s in scene.shapes()} == {"room", "sign", "stand"}


def test02_removed_added_and_swapped(scene, tmp_path):
    removed, shapes = changed_scene(scene, written(tmp_path, remove=["stand"]))
    assert cast(removed, EYE, EAST) == pytest.approx(3.0) and "stand" not in shapes
    wall = {"name": "wall", "min": [2, 0, 0], "max": [2.1, 4, 3]}
    added, shapes = changed_scene(scene, written(tmp_path, add=[wall]))
    assert cast(added, EYE, EAST) == pytest.approx(1.0) and cast(added, (2.05, 1, 1), EAST) == pytest.approx(
        0.05, abs=1e-5
    )
    swapped, _ = changed_scene(scene, written(tmp_path, swap=[wall | {"shape": "stand"}]))
    assert cast(swapped, EYE, EAST) == pytest.approx(1.0)
    (tmp_path / "tri.obj").write_text("v 2.2 0 0\nv 2.2 4 0\nv 2.2 2 9\nf 1 2 3\n")
    mesh, _ = changed_scene(scene, written(tmp_path, swap=[{"shape": "stand", "mesh": "tri.obj"}]))
    assert cast(mesh, EYE, EAST) == pytest.approx(1.2)


def test03_areas_follow(tmp_path):
    box = Region.of("shelf", *SIGN)
    areas = Areas((box, SceneShape("stand", "stand"), Group("all", ("shelf", "stand")), Group("g", ("stand",))))
    found = changed_areas(
        areas, written(tmp_path, move=[{"area": "shelf", "by": [1, 0, 0], "turn": 90}], remove=["stand"])
    )
    assert found.names == ("shelf", "all") and found.members()["all"] == (0,)
    assert np.allclose(found.boxes[0].bounds, [[4.6, 1.9, 1.0], [5.6, 2.1, 2.0]])
    more = changed_areas(areas, written(tmp_path, add=[{"name": "x", "min": [0, 0, 0], "max": [1, 1, 1]}]))
    assert more.areas[-1] == SceneShape("x", "x")
    for wrong in ("stand", "nobody"):
        with pytest.raises(NergError, match="cannot be moved as an area"):
            changed_areas(areas, written(tmp_path, move=[{"area": wrong}]))


def test04_observers(tmp_path):
    found = written(tmp_path, observers=[[1, 2, 3]], shift=[0, 0, -0.5])
    assert found.observers.tolist() == [[1, 2, 3]] and found.shift.tolist() == [0, 0, -0.5] and not found.of_shapes


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"remove": ["nobody"]}, 'no shape "nobody"'),
        ({"move": [{"shape": "nobody"}]}, 'no shape "nobody"'),
        ({"remove": ["sign"], "move": [{"shape": "sign"}]}, "taken away"),
        ({"add": [{"name": "sign", "min": [0, 0, 0], "max": [1, 1, 1]}]}, "already"),
        ({"remove": ["sign", "stand", "room"]}, "no shape is left"),
    ],
)
def test05_what_cannot_be_done(scene, tmp_path, changes, said):
    with pytest.raises(NergError, match=said):
        changed_scene(scene, written(tmp_path, **changes))


def test06_a_field_cannot_be_taken_apart(tmp_path):
    with pytest.raises(NergError, match="give one"):
        changed_scene(None, written(tmp_path, remove=["sign"]))


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"mvoe": []},
        {"move": []},
        {"move": 3},
        {"move": [3]},
        {"move": [{"by": [1, 0, 0]}]},
        {"move": [{"shape": "a", "area": "b"}]},
        {"move": [{"shape": "a", "by": [1, 0]}]},
        {"move": [{"shape": "a", "by": [1, 0, 1e300]}]},
        {"move": [{"shape": "a", "turn": "x"}]},
        {"move": [{"shape": "a", "spin": 1}]},
        {"remove": [3]},
        {"remove": [""]},
        {"add": [{"min": [0, 0, 0], "max": [1, 1, 1]}]},
        {"add": [{"name": "a"}]},
        {"add": [{"name": "a", "mesh": "../a.ply"}]},
        {"add": [{"name": "a", "mesh": "/a.ply"}]},
        {"add": [{"name": "a", "mesh": "a.stl"}]},
        {"swap": [{"name": "a", "mesh": "a.ply"}]},
        {"observers": [[1, 2]]},
        {"shift": [1, 2, None]},
    ],
)
def test07_others_are_told_in_a_sentence(tmp_path, changes):
    with pytest.raises(NergError) as told:
        written(tmp_path, **changes)
    assert str(tmp_path) in str(told.value) and "\n" not in str(told.value)
