"""Tests of `nerg_mi.aoi.areas`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from nerg_mi.scenes.store import SCENE_FILE

from nerg_mi.aoi.areas import AreaGroup, Areas, MeshPart, SceneShape, format_areas
from nerg_mi.aoi.settings import VisitRules
from nerg_mi.aoi.statistics import statistics
from nerg_mi.errors import NergError
from nerg_mi.formats.boxes import MAX_AREAS, Region
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.tracking.rays import Rays
from tests.formats.test_boxes import write_twin

# ---- Kinds of areas, and resolution of groups ----

A, B = Region.create("a", [0, 0, 0], [1, 1, 1]), Region.create("b", [2, 0, 0], [3, 1, 1])


def test01_group_elements_are_unique():
    areas = Areas((AreaGroup("all", ("pair", "a")), A, B, AreaGroup("pair", ("a", "b"))))
    assert areas.element_indices() == {"all": (0, 1), "a": (0,), "b": (1,), "pair": (0, 1)}
    assert areas.elements == (A, B) and areas.names == ("all", "a", "b", "pair")


def test02_duplicate_names_are_refused():
    with pytest.raises(NergError, match='two areas have the name "a"'):
        Areas((A, A))


def test03_nested_groups_are_resolved_once():
    # Both groups contain all previous ones; without caching, the run time would be exponential.
    groups = [AreaGroup("g0", ("a", "b"))] + [AreaGroup(f"g{k}", (f"g{k - 1}", "a")) for k in range(1, 7)]
    assert Areas((A, B, *groups)).element_indices()["g6"] == (0, 1)


# ---- Patterns of shapes ----


def test_patterns_match_the_shapes_of_the_scene():
    ids = ["book 1", "book 2", "door", "a*"]
    assert Areas.load("mesh:book*").match_shapes(ids).names == ("book 1", "book 2")
    areas = Areas((SceneShape("books", "book ?"), SceneShape("star", "a*"), SceneShape("all", "*oo*")))
    resolved = areas.match_shapes(ids)
    assert resolved.names == ("book 1", "book 2", "books", "star", "door", "all")
    assert resolved.element_indices()["books"] == (0, 1) and resolved.element_indices()["all"] == (0, 1, 3)
    for ids in (["door"], []):
        with pytest.raises(NergError):
            areas.match_shapes(ids)


def test_nodes_of_a_mesh_are_areas(tmp_path):
    scene = trimesh.Scene()
    for name, right in (("book red", -0.5), ("book blue", 0.5), ("door", 3.0)):
        # The y axis of glTF is up, and its z axis points away from positive y.
        box = trimesh.creation.box((0.1, 0.8, 0.8)).apply_translation((2, 1.5, right))
        scene.add_geometry(box, node_name=name, geom_name=name)
    scene.export(tmp_path / "room.glb")
    aims = np.array([[2, -0.5, 1.5], [2, 0.5, 1.5], [2, 0.6, 1.5], [2, -3, 1.5]]) - (0, 0, 1.5)
    rays = Rays.from_arrays(np.tile((0, 0, 1.5), (4, 1)), aims, times=np.arange(4) / 5, tracking="eye")
    rows = statistics([rays, tmp_path / "room.glb"], "mesh:book*", rules=VisitRules(min_visit=0.0), resamples=199).aois
    assert {row["aoi"]: row["share"] for row in rows} == pytest.approx({"book red": 0.5, "book blue": 0.25})


# ---- Files with all kinds of areas of interest ----

BOX = {"name": "shelf", "min": [0, 0, 0], "max": [1, 2, 3]}


@pytest.mark.parametrize("key", ["rotation", "Orientation", "yaw", "quat"])
def test_a_rotation_under_another_name_is_refused(tmp_path, key):
    with pytest.raises(NergError, match=f'"{key}".*"turn"'):
        Areas.load(write_areas(tmp_path, {**BOX, key: 30}))
    assert Areas.load(write_areas(tmp_path, {**BOX, "category": "sweets"})).names == ("shelf",)


def write_areas(tmp_path, *entries, name="a.json"):
    path = tmp_path / name
    path.write_text(json.dumps({"regions": entries}))
    return path


def test01_one_area_of_each_kind(tmp_path):
    path = write_areas(
        tmp_path,
        BOX,
        {"name": "sign", "mesh": "sign.ply", "faces": [0, [4, 9]]},
        {"name": "till", "shape": "till_0"},
        {"name": "all", "parts": ["shelf", "both"]},
        {"name": "both", "parts": ["till", "shelf"]},
    )
    areas = Areas.load(path)
    assert areas.areas == (
        Region.create("shelf", [0, 0, 0], [1, 2, 3]),
        MeshPart("sign", tmp_path / "sign.ply", ((0, 0), (4, 9))),
        SceneShape("till", "till_0"),
        AreaGroup("all", ("shelf", "both")),
        AreaGroup("both", ("till", "shelf")),
    )
    assert areas.element_indices() == {"shelf": (0,), "sign": (1,), "till": (2,), "all": (0, 2), "both": (0, 2)}
    assert areas.areas[1].select_faces(12).nonzero()[0].tolist() == [0, 4, 5, 6, 7, 8, 9]
    with pytest.raises(NergError, match="face 9"):
        areas.areas[1].select_faces(9)
    assert areas.path == path and areas.files == (path, tmp_path / "sign.ply") and areas.boxes == [areas.areas[0]]
    assert Areas.load({"tile": {"mesh": "tile.obj"}}).files == (Path("tile.obj"),)
    # The viewer shows only boxes, and preserves the others when it saves the file.
    assert json.loads(format_areas(areas.areas, tmp_path)) == json.loads(path.read_text())


def test_names_are_composed(tmp_path):
    composed, decomposed = "K\u00fche", "Ku\u0308he"
    path = write_areas(tmp_path, {**BOX, "name": decomposed}, {"name": "all", "parts": [composed]})
    assert Areas.load(path).names == (composed, "all")
    with pytest.raises(NergError, match=f'name "{composed}"'):
        Areas.load(write_areas(tmp_path, {**BOX, "name": decomposed}, {**BOX, "name": composed}))


@pytest.mark.parametrize("value", [[[0, 0, 0], [1, 2, 3]], {"min": [0, 0, 0], "max": [1, 2, 3]}])
@pytest.mark.parametrize("name", ["Käse & Co", "mesh"])
def test02_older_files_are_read(tmp_path, name, value):
    (tmp_path / "a.json").write_text(json.dumps({name: value}))
    assert Areas.load(tmp_path / "a.json").areas == (Region.create(name, [0, 0, 0], [1, 2, 3]),)


def test03_rotated_box(tmp_path):
    half = np.sqrt(0.5)
    path = write_areas(tmp_path, BOX | {"turn": 90}, BOX | {"name": "b", "turn": [0, 0, 2 * half, 2 * half]})
    for box in Areas.load(path).boxes:
        # Size 1 x 2 x 3 around (0.5, 1, 1.5): a rotation by 90 degrees exchanges the first two.
        assert np.allclose(box.bounds, [[-0.5, 0.5, 0], [1.5, 1.5, 3]])
        assert box.contains(np.array([[-0.4, 1.0, 1.0], [0.5, 0.2, 1.0]])).tolist() == [True, False]
        assert np.allclose(box.to_world(box.to_local(np.array([0.3, 4.0, -2.0]))), [0.3, 4.0, -2.0])
    # Rotation by 30 degrees: the formula of a plane rotation.
    box = Region.create("c", [0, 0, 0], [2, 1, 1], 30)
    along = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0])
    assert box.contains(box.center + 0.99 * along) and not box.contains(box.center + 1.01 * along)
    assert Areas.load(Areas((box,)).save(tmp_path / "b.json")).areas == (box,)


def test03c_areas_of_store():
    regions = Areas.load(SCENE_FILE.parent / "regions.json").boxes
    assert len(regions) > 20 and all((r.corners[0] < r.corners[1]).all() for r in regions)


def test04_box_groups_have_box_indices(tmp_path):
    other = {"name": "b", "min": [5, 0, 0], "max": [6, 1, 1]}
    mesh = {"name": "m", "mesh": "m.ply"}
    path = write_areas(
        tmp_path, BOX, other, mesh, {"name": "g", "parts": ["shelf", "b"]}, {"name": "h", "parts": ["m"]}
    )
    areas = Areas.load(path)
    assert areas.box_indices == {"shelf": (0,), "b": (1,), "g": (0, 1)} and [b.name for b in areas.boxes] == [
        "shelf",
        "b",
    ]


NO_REGIONS = [
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
    {"regions": [BOX] * (MAX_AREAS + 1)},
]
NO_AREAS = [
    [{"name": "g", "parts": ["g"]}],
    [{"name": "g", "parts": ["h"]}, {"name": "h", "parts": ["g"]}],
    [{"name": "g", "parts": ["nobody"]}],
    [{"name": "g", "parts": []}],
    [{"name": "g", "parts": "abc"}],
    [{"name": "g", "parts": [3]}],
    [{"parts": ["a"]}],
    [BOX, {"name": "shelf", "shape": "x"}],
    [{"name": "s", "shape": 3}],
    [{"name": "s", "shape": "x", "mesh": "m.ply"}],
    [BOX | {"shape": "x"}],
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
]


@pytest.mark.parametrize("value", [*NO_REGIONS, *({"regions": entries} for entries in NO_AREAS)])
def test05_invalid_areas_are_refused(tmp_path, value):
    path = tmp_path / "a.json"
    path.write_text(json.dumps(value))
    with pytest.raises(NergError) as message:
        Areas.load(path)
    assert str(path) in str(message.value) and "\n" not in str(message.value)


@pytest.mark.parametrize("turn", ["30", True, {"z": 30}, [[1, 0, 0], [0, 1, 0], [0, 0, 1]]])
def test_rotations_that_are_no_angles_are_named(tmp_path, turn):
    with pytest.raises(NergError, match='the "turn" .*degrees'):
        Areas.load(write_areas(tmp_path, BOX | {"turn": turn}))


def test06_group_depth_is_limited(tmp_path):
    entries = [BOX, {"name": "0", "parts": ["shelf"]}]
    entries += [{"name": str(k), "parts": [str(k - 1)]} for k in range(1, 400)]
    assert Areas.load(write_areas(tmp_path, *entries)).element_indices()["399"] == (0,)
    assert Areas.load(write_areas(tmp_path, *entries[60::-1])).element_indices()["59"] == (0,)
    with pytest.raises(NergError, match="deeper"):
        Areas.load(write_areas(tmp_path, *entries[::-1]))


# ---- Objects of Aria Digital Twin ----


def test02_categories_and_groups(tmp_path):
    write_twin(tmp_path / "twin")
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"regions": [{"adt": "twin", "categories": ["cup"], "name": "cups"}]}))
    areas = Areas.load(path)
    assert areas.names == ("Cup 1", "Cup 2", "cups") and areas.element_indices()["cups"] == (0, 1)
    assert len(Areas.load(tmp_path / "twin").boxes) == 3
    path.write_text(json.dumps({"regions": [{"adt": "twin", "categories": ["sofa"]}]}))
    with pytest.raises(NergError, match="chair, cup"):
        Areas.load(path)


# ---- Areas in memory, saving, and tables ----


def test_saved_areas_are_complete(tmp_path):
    """Meshes in memory and outside of the folder are written next to the file."""
    made = trimesh.creation.box((1, 2, 3))
    made.export(tmp_path / "sign.ply")
    (tmp_path / "a").mkdir()
    areas = Areas.load(write_areas(tmp_path, BOX, {"name": "sign", "mesh": "sign.ply", "faces": [0, [2, 3]]}))
    areas = Areas(
        (*areas.areas, *Areas.load({"wall": made, "till": {"shape": "t"}}).areas, AreaGroup("all", ("sign",)))
    )
    path = areas.save(tmp_path / "a" / "b.json")
    again = Areas.load(path)
    assert again.names == areas.names and again.path == path and Areas.open(again) is again
    assert sorted(again.files) == sorted([path, *(path.parent / "b.meshes").iterdir()]) and len(again.meshes) == 2
    assert again.areas[1].faces == areas.areas[1].faces
    for file in again.meshes:
        np.testing.assert_allclose(np.ptp(read_mesh_file(file).vertices, axis=0), (1, 2, 3), atol=1e-6)
    assert Areas.load(again.save(path.with_name("c.json"))) == again and not (path.parent / "c.meshes").exists()
    with pytest.raises(NergError, match="wall.*in memory"):
        format_areas(areas.areas, tmp_path)


def test_areas_are_a_table():
    areas = Areas.load(
        {
            "box": [[1, 1, 1], [0, 0, 0]],
            "mesh": trimesh.creation.box((2, 2, 2)),
            "shape": {"shape": "s"},
            "both": {"parts": ["box", "mesh"]},
            "all": {"parts": ["both", "shape"]},
        }
    )
    table = areas.to_dataframe("pandas")
    assert table["kind"].tolist() == ["box", "mesh", "shape", "group", "group"]
    assert table["group"].tolist() == ["both", "both", "all", "all", ""]
    assert table["x_min"].tolist()[:2] == [0, -1] and table["x_min"].isna().tolist() == [
        False,
        False,
        True,
        False,
        True,
    ]
    assert table.loc[3, ["x_min", "z_max"]].tolist() == [-1, 1]
    assert repr(areas) == "<Areas in memory: 1 box, 1 mesh, 1 shape, 2 groups>" and "both" in areas._repr_html_()


@pytest.mark.parametrize("wrong, said", [(3, "dict of areas.*got int"), ({"a": [0, 1]}, 'area "a" must be a box')])
def test_what_is_no_area_is_refused(wrong, said):
    with pytest.raises(NergError, match=said):
        Areas.open(wrong)
