"""Tests of `nerg_mi.aoi.changes`."""

from __future__ import annotations

import json

import numpy as np
import pytest

from nerg_mi.aoi.areas import AreaGroup, Areas, MeshPart, SceneShape
from nerg_mi.aoi.changes import Changes, NewShape, apply_changes, apply_to_areas, read_changes
from nerg_mi.aoi.placed import open_placed_areas
from nerg_mi.errors import NergError
from nerg_mi.formats.boxes import Region

from .place import SIGN, write_place


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    environment = write_place(tmp_path_factory.mktemp("place"), gaze=False)
    return open_placed_areas(environment, None, Areas(()))


def written(tmp_path, **changes):
    (tmp_path / "c.json").write_text(json.dumps(changes))
    return read_changes(tmp_path / "c.json")


def change(placed, tmp_path, **changes):
    """Return the environment after changes."""
    return apply_changes(placed, written(tmp_path, **changes)).environment


def cast(environment, o, d):
    return environment.trace_depth(np.array([o]), np.array([d])).item()


EYE, EAST = (1.0, 1.6, 1.6), (1.0, 0, 0)


def test_shapes_are_moved_and_rotated(place, tmp_path):
    assert cast(place.environment, EYE, EAST) == pytest.approx(1.5)
    moved = change(place, tmp_path, move=[{"shape": "stand", "by": [0.3, 0, 0]}])
    assert cast(moved, EYE, EAST) == pytest.approx(1.8, abs=1e-5) and set(moved.shapes) == {"room", "sign", "stand"}
    # A quarter turn about its centre: 0.4 x 1 m become 1 x 0.4 m.
    turned = change(place, tmp_path, move=[{"shape": "stand", "turn": 90}])
    assert cast(turned, EYE, EAST) == pytest.approx(2.7 - 0.5 - 1.0, abs=1e-5)
    assert cast(turned, (1.0, 1.9, 1.6), EAST) == pytest.approx(3.0, abs=1e-5)
    # The original scene and the names of its shapes are unchanged.
    assert cast(place.environment, EYE, EAST) == pytest.approx(1.5)
    assert {s.id() for s in place.environment.scene_geometry.scene.shapes()} == {"room", "sign", "stand"}


def test_shapes_are_removed_added_and_swapped(place, tmp_path):
    removed = change(place, tmp_path, remove=["stand"])
    assert cast(removed, EYE, EAST) == pytest.approx(3.0) and "stand" not in removed.shapes
    wall = {"name": "wall", "min": [2, 0, 0], "max": [2.1, 4, 3]}
    added = change(place, tmp_path, add=[wall])
    assert cast(added, EYE, EAST) == pytest.approx(1.0) and cast(added, (2.05, 1, 1), EAST) == pytest.approx(
        0.05, abs=1e-5
    )
    swapped = change(place, tmp_path, swap=[wall | {"shape": "stand"}])
    assert cast(swapped, EYE, EAST) == pytest.approx(1.0)
    (tmp_path / "tri.obj").write_text("v 2.2 0 0\nv 2.2 4 0\nv 2.2 2 9\nf 1 2 3\n")
    mesh = change(place, tmp_path, swap=[{"shape": "stand", "mesh": "tri.obj"}])
    assert cast(mesh, EYE, EAST) == pytest.approx(1.2)


def test_areas_follow_shapes(tmp_path):
    box = Region.create("shelf", *SIGN)
    areas = Areas((box, SceneShape("stand", "stand"), AreaGroup("all", ("shelf", "stand")), AreaGroup("g", ("stand",))))
    result = apply_to_areas(
        areas, written(tmp_path, move=[{"area": "shelf", "by": [1, 0, 0], "turn": 90}], remove=["stand"])
    )
    assert result.names == ("shelf", "all") and result.element_indices()["all"] == (0,)
    assert np.allclose(result.boxes[0].bounds, [[4.6, 1.9, 1.0], [5.6, 2.1, 2.0]])
    options = apply_to_areas(areas, written(tmp_path, add=[{"name": "x", "min": [0, 0, 0], "max": [1, 1, 1]}]))
    assert options.areas[-1] == SceneShape("x", "x")
    for wrong in ("stand", "nobody"):
        with pytest.raises(NergError, match="cannot be moved as an area"):
            apply_to_areas(areas, written(tmp_path, move=[{"area": wrong}]))


def test_observers_are_changed(tmp_path):
    result = written(tmp_path, observers=[[1, 2, 3]], shift=[0, 0, -0.5])
    assert (
        result.observers.tolist() == [[1, 2, 3]] and result.shift.tolist() == [0, 0, -0.5] and not result.changes_shapes
    )


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"remove": ["nobody"]}, 'no shape "nobody"'),
        ({"move": [{"shape": "nobody"}]}, 'no shape "nobody"'),
        ({"remove": ["sign"], "move": [{"shape": "sign"}]}, "both moved and removed"),
        ({"add": [{"name": "sign", "min": [0, 0, 0], "max": [1, 1, 1]}]}, "already"),
        ({"remove": ["sign", "stand", "room"]}, "keep at least one"),
    ],
)
def test_invalid_changes_are_refused(place, tmp_path, changes, said):
    with pytest.raises(NergError, match=said):
        change(place, tmp_path, **changes)


def test_changes_need_a_scene(tmp_path):
    with pytest.raises(NergError, match="need a scene"):
        change(open_placed_areas(None, None, Areas(())), tmp_path, remove=["sign"])


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
def test_malformed_changes_are_refused(tmp_path, changes):
    with pytest.raises(NergError) as texts:
        written(tmp_path, **changes)
    assert str(tmp_path) in str(texts.value) and "\n" not in str(texts.value)


def test_unused_mesh_content_is_reported_once(tmp_path):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    for name, extra in (("one", "usemtl red\n"), ("two", "vp 1 2\n")):
        (tmp_path / f"{name}.obj").write_text(extra + triangle)
    one, two = tmp_path / "one.obj", tmp_path / "two.obj"
    areas = Areas((MeshPart("a", one), MeshPart("b", one, ((0, 0),))))
    placed = open_placed_areas({"type": "scene", "s": {"type": "sphere"}}, None, areas)
    assert placed.warnings == [f"of {one}: unused statements: usemtl"]
    changes = Changes(add=(NewShape("c", one), NewShape("d", two)))
    assert apply_changes(placed, changes).warnings == [*placed.warnings, f"of {two}: unused statements: vp"]
