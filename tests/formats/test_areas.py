"""Tests of `nerg_mi.formats.areas`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.areas import (
    MAX_AREAS,
    AreaGroup,
    AreaSet,
    MeshPart,
    Region,
    SceneShape,
    list_area_files,
    read_areas,
    read_regions,
    read_twin_objects,
    format_areas,
)
from nerg_mi.rays.readers.base import TrackingFrame
from nerg_mi.workflows import demo

# ---- What an area can be, and how groups resolve ----

A, B = Region.create("a", [0, 0, 0], [1, 1, 1]), Region.create("b", [2, 0, 0], [3, 1, 1])


def test01_members_count_once():
    areas = AreaSet((AreaGroup("all", ("pair", "a")), A, B, AreaGroup("pair", ("a", "b"))))
    assert areas.element_indices() == {"all": (0, 1), "a": (0,), "b": (1,), "pair": (0, 1)}
    assert areas.elements == (A, B) and areas.names == ("all", "a", "b", "pair")


def test02_two_of_one_name():
    with pytest.raises(NergError, match='two areas are called "a"'):
        AreaSet((A, A))


def test03_many_groups_of_groups_are_resolved_at_once():
    # Each of the two holds all that came before: without care, two to the power of their number of ways.
    groups = [AreaGroup("g0", ("a", "b"))] + [AreaGroup(f"g{k}", (f"g{k - 1}", "a")) for k in range(1, 7)]
    assert AreaSet((A, B, *groups)).element_indices()["g6"] == (0, 1)


# ---- Areas of interest of every kind as files ----

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
    assert list_area_files(path, areas) == [path, tmp_path / "sign.ply"] and list_area_files(tmp_path, areas) == []
    # Boxes alone, for those who know nothing else; and what they save again has all of them.
    assert read_regions(path) == [areas.areas[0]] == areas.boxes
    (tmp_path / "b.json").write_text(format_areas(areas.boxes, areas.non_boxes))
    assert read_areas(tmp_path / "b.json") == areas


@pytest.mark.parametrize("value", [[[0, 0, 0], [1, 2, 3]], {"min": [0, 0, 0], "max": [1, 2, 3]}])
@pytest.mark.parametrize("name", ["Käse & Co", "mesh"])
def test02_old_files_read_alike(tmp_path, name, value):
    (tmp_path / "a.json").write_text(json.dumps({name: value}))
    assert list(read_areas(tmp_path / "a.json").areas) == read_regions(tmp_path / "a.json")
    assert read_regions(tmp_path / "a.json") == [Region.create(name, [0, 0, 0], [1, 2, 3])]


def test03_a_turned_box(tmp_path):
    half = np.sqrt(0.5)
    path = written(tmp_path, BOX | {"turn": 90}, BOX | {"name": "b", "turn": [0, 0, 2 * half, 2 * half]})
    for box in read_areas(path).boxes:
        # Sizes 1 x 2 x 3 about (0.5, 1, 1.5): a quarter turn exchanges the first two.
        assert np.allclose(box.bounds, [[-0.5, 0.5, 0], [1.5, 1.5, 3]])
        assert box.contains(np.array([[-0.4, 1.0, 1.0], [0.5, 0.2, 1.0]])).tolist() == [True, False]
        assert np.allclose(box.to_world(box.to_local(np.array([0.3, 4.0, -2.0]))), [0.3, 4.0, -2.0])
    # Turned by 30 degrees: the formula of a plane rotation.
    box = Region.create("c", [0, 0, 0], [2, 1, 1], 30)
    along = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0])
    assert box.contains(box.center + 0.99 * along) and not box.contains(box.center + 1.01 * along)
    assert read_regions(path) == read_areas(path).boxes
    (tmp_path / "b.json").write_text(format_areas([box]))
    assert read_regions(tmp_path / "b.json") == [box]


def test03b_what_lies_in_a_box():
    box = Region.create("b", [0, 0, 0], [1, 1, 1])
    points = np.array([[0.5, 0.5, 0.5], [1.0, 0.0, 1.0], [1.01, 0.5, 0.5], [np.inf, 0, 0], [0.5, 0.5, -0.2]])
    assert box.contains(points).tolist() == [True, True, False, False, False]
    assert box.contains(points, 0.02).tolist() == [True, True, True, False, False]
    assert box.contains(points.reshape(1, 5, 3)).shape == (1, 5)


def test03c_those_of_the_store():
    regions = read_regions(demo.find_store_scene().parent / "regions.json")
    assert len(regions) > 20 and all((r.corners[0] < r.corners[1]).all() for r in regions)


def test04_groups_of_boxes_are_solids(tmp_path):
    other = {"name": "b", "min": [5, 0, 0], "max": [6, 1, 1]}
    mesh = {"name": "m", "mesh": "m.ply"}
    path = written(tmp_path, BOX, other, mesh, {"name": "g", "parts": ["shelf", "b"]}, {"name": "h", "parts": ["m"]})
    areas = read_areas(path)
    assert areas.box_indices == {"shelf": (0,), "b": (1,), "g": (0, 1)} and [b.name for b in areas.boxes] == ["shelf", "b"]


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


@pytest.mark.parametrize(
    "read, value",
    [
        *((read, value) for value in NO_REGIONS for read in (read_regions, read_areas)),
        *((read_areas, {"regions": entries}) for entries in NO_AREAS),
    ],
)
def test05_others_are_told_in_a_sentence(tmp_path, read, value):
    path = tmp_path / "a.json"
    path.write_text(json.dumps(value))
    with pytest.raises(NergError) as told:
        read(path)
    assert str(path) in str(told.value) and "\n" not in str(told.value)


def test06_groups_may_be_nested_so_deep(tmp_path):
    entries = [BOX, {"name": "0", "parts": ["shelf"]}]
    entries += [{"name": str(k), "parts": [str(k - 1)]} for k in range(1, 400)]
    assert read_areas(written(tmp_path, *entries)).element_indices()["399"] == (0,)
    assert read_areas(written(tmp_path, *entries[60::-1])).element_indices()["59"] == (0,)
    with pytest.raises(NergError, match="deeper"):
        read_areas(written(tmp_path, *entries[::-1]))


# ---- The objects of Aria Digital Twin as boxes in the frame of rays ----

BOX_HEAD = (
    "object_uid,timestamp[ns],p_local_obj_xmin[m],p_local_obj_xmax[m],p_local_obj_ymin[m],p_local_obj_ymax[m],"
    "p_local_obj_zmin[m],p_local_obj_zmax[m]"
)

POSE_HEAD = "object_uid,timestamp[ns],t_wo_x[m],t_wo_y[m],t_wo_z[m],q_wo_w,q_wo_x,q_wo_y,q_wo_z"
HALF = np.sqrt(0.5)


def write_twin(folder: Path) -> Path:
    """A chair that is turned by a quarter about the vertical, two cups, and one that is carried about."""
    folder.mkdir(parents=True, exist_ok=True)
    boxes = ["1,-1,-0.2,0.4,0,1,-0.1,0.1", "2,-1,0,0.1,0,0.1,0,0.1", "3,-1,0,0.1,0,0.1,0,0.1", "4,-1,0,1,0,1,0,1"]
    poses = [f"1,-1,2,0,3,{HALF},0,{HALF},0", "2,-1,0,1,0,1,0,0,0", "3,-1,0,2,0,1,0,0,0", "4,100,0,0,0,1,0,0,0"]
    (folder / "3d_bounding_box.csv").write_text("\n".join([BOX_HEAD, *boxes]) + "\n")
    (folder / "scene_objects.csv").write_text("\n".join([POSE_HEAD, *poses]) + "\n")
    names = {"1": ("Chair", "chair"), "2": ("Cup", "cup"), "3": ("Cup", "cup"), "4": ("Carried", "cup")}
    about = {uid: {"instance_name": name, "category": category} for uid, (name, category) in names.items()}
    (folder / "instances.json").write_text(json.dumps(about))
    return folder


def test01_boxes_lie_where_the_twin_has_them(tmp_path):
    found = read_twin_objects(write_twin(tmp_path))
    assert [r.name for r in found] == ["Chair", "Cup 1", "Cup 2"]
    chair = found[0]
    # Written out: the twin's y is up. A quarter turn about y takes x to -z and z to x.
    corners = np.array([[x, y, z] for x in (-0.2, 0.4) for y in (0, 1) for z in (-0.1, 0.1)])
    in_twin = np.stack([corners[:, 2], corners[:, 1], -corners[:, 0]], axis=1) + (2, 0, 3)
    in_rays = in_twin @ TrackingFrame(up="y").to_rays()[:3, :3].T
    assert np.allclose(chair.bounds, [in_rays.min(axis=0), in_rays.max(axis=0)])
    assert chair.contains(in_rays, 1e-9).all() and not chair.contains(in_rays + (0, 0, 0.3)).all()
    assert np.allclose(found[1].bounds, [[0, -0.1, 1], [0.1, 0, 1.1]])


def test02_categories_and_groups(tmp_path):
    write_twin(tmp_path / "twin")
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"regions": [{"adt": "twin", "categories": ["cup"], "name": "cups"}]}))
    areas = read_areas(path)
    assert areas.names == ("Cup 1", "Cup 2", "cups") and areas.element_indices()["cups"] == (0, 1)
    assert len(read_areas(tmp_path / "twin").boxes) == 3
    path.write_text(json.dumps({"regions": [{"adt": "twin", "categories": ["sofa"]}]}))
    with pytest.raises(NergError, match="chair, cup"):
        read_areas(path)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("3d_bounding_box.csv", "-0.2", "x"),
        ("3d_bounding_box.csv", "-0.2", "nan"),
        ("3d_bounding_box.csv", "-0.2", "0.9"),
        ("3d_bounding_box.csv", "object_uid", "uid"),
        ("3d_bounding_box.csv", "1,-1,", "1,"),
        ("3d_bounding_box.csv", "0,1,-0.1,0.1", "0,1,-0.1,0.1,9"),
        ("scene_objects.csv", f"{HALF},0,{HALF},0", "0,0,0,0"),
        ("scene_objects.csv", ",2,0,3,", ",2,0,1e300,"),
        ("instances.json", '"Chair"', "7"),
        ("instances.json", "{", "["),
    ],
)
def test03_damage_is_told(tmp_path, name, old, new):
    write_twin(tmp_path)
    text = (tmp_path / name).read_text()
    (tmp_path / name).write_text(text.replace(old, new, 1))
    with pytest.raises(NergError) as told:
        read_twin_objects(tmp_path)
    assert str(tmp_path) in str(told.value) and "\n" not in str(told.value)


def test04_the_boxes_of_a_recording(tmp_path, recorded):
    source = recorded("aria") / "adt" / "3d_bounding_box.csv"
    text = source.read_text()
    (tmp_path / "3d_bounding_box.csv").write_text(text)
    uids = [line.split(",")[0] for line in text.splitlines()[1:]]
    poses = [f"{uid},-1,0,0,0,1,0,0,0" for uid in uids]
    (tmp_path / "scene_objects.csv").write_text("\n".join([POSE_HEAD, *poses]))
    found = {r.name: r for r in read_twin_objects(tmp_path)}
    rows = {line.split(",")[0]: np.array(line.split(",")[2:], float) for line in text.splitlines()[1:]}
    assert len(found) == len(rows) == 349
    for uid, (x0, x1, y0, y1, z0, z1) in rows.items():
        # (x, y, z) becomes (x, -z, y); what is thinner than a millimetre is made so thick.
        expected = np.array([[x0, -z1, y0], [x1, -z0, y1]])
        assert np.abs(found[uid].bounds - expected).max() <= 1e-3 + 1e-9
