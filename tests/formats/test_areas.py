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
    format_areas,
    list_area_files,
    read_areas,
    read_regions,
    read_twin_objects,
)
from nerg_mi.rays.readers.base import TrackingFrame
from nerg_mi.workflows import demo

# ---- Kinds of areas, and resolution of groups ----

A, B = Region.create("a", [0, 0, 0], [1, 1, 1]), Region.create("b", [2, 0, 0], [3, 1, 1])


def test01_group_elements_are_unique():
    areas = AreaSet((AreaGroup("all", ("pair", "a")), A, B, AreaGroup("pair", ("a", "b"))))
    assert areas.element_indices() == {"all": (0, 1), "a": (0,), "b": (1,), "pair": (0, 1)}
    assert areas.elements == (A, B) and areas.names == ("all", "a", "b", "pair")


def test02_duplicate_names_are_refused():
    with pytest.raises(NergError, match='two areas have the name "a"'):
        AreaSet((A, A))


def test03_nested_groups_are_resolved_once():
    # Both groups contain all previous ones; without caching, the run time would be exponential.
    groups = [AreaGroup("g0", ("a", "b"))] + [AreaGroup(f"g{k}", (f"g{k - 1}", "a")) for k in range(1, 7)]
    assert AreaSet((A, B, *groups)).element_indices()["g6"] == (0, 1)


# ---- Files with all kinds of areas of interest ----

BOX = {"name": "shelf", "min": [0, 0, 0], "max": [1, 2, 3]}


@pytest.mark.parametrize("key", ["rotation", "Orientation", "yaw", "quat"])
def test_a_rotation_under_another_name_is_refused(tmp_path, key):
    with pytest.raises(NergError, match=f'"{key}".*"turn"'):
        read_areas(write_areas(tmp_path, {**BOX, key: 30}))
    assert read_areas(write_areas(tmp_path, {**BOX, "category": "sweets"})).names == ("shelf",)


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
    # Programs that support only boxes read the boxes, and preserve the others when they save the file.
    assert read_regions(path) == [areas.areas[0]] == areas.boxes
    (tmp_path / "b.json").write_text(format_areas(areas.boxes, areas.non_boxes))
    assert read_areas(tmp_path / "b.json") == areas


def test_names_are_composed(tmp_path):
    composed, decomposed = "K\u00fche", "Ku\u0308he"
    path = write_areas(tmp_path, {**BOX, "name": decomposed}, {"name": "all", "parts": [composed]})
    assert read_areas(path).names == (composed, "all")
    with pytest.raises(NergError, match="same name"):
        read_areas(write_areas(tmp_path, {**BOX, "name": decomposed}, {**BOX, "name": composed}))


@pytest.mark.parametrize("value", [[[0, 0, 0], [1, 2, 3]], {"min": [0, 0, 0], "max": [1, 2, 3]}])
@pytest.mark.parametrize("name", ["Käse & Co", "mesh"])
def test02_older_files_are_read(tmp_path, name, value):
    (tmp_path / "a.json").write_text(json.dumps({name: value}))
    assert list(read_areas(tmp_path / "a.json").areas) == read_regions(tmp_path / "a.json")
    assert read_regions(tmp_path / "a.json") == [Region.create(name, [0, 0, 0], [1, 2, 3])]


def test03_rotated_box(tmp_path):
    half = np.sqrt(0.5)
    path = write_areas(tmp_path, BOX | {"turn": 90}, BOX | {"name": "b", "turn": [0, 0, 2 * half, 2 * half]})
    for box in read_areas(path).boxes:
        # Size 1 x 2 x 3 around (0.5, 1, 1.5): a rotation by 90 degrees exchanges the first two.
        assert np.allclose(box.bounds, [[-0.5, 0.5, 0], [1.5, 1.5, 3]])
        assert box.contains(np.array([[-0.4, 1.0, 1.0], [0.5, 0.2, 1.0]])).tolist() == [True, False]
        assert np.allclose(box.to_world(box.to_local(np.array([0.3, 4.0, -2.0]))), [0.3, 4.0, -2.0])
    # Rotation by 30 degrees: the formula of a plane rotation.
    box = Region.create("c", [0, 0, 0], [2, 1, 1], 30)
    along = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0])
    assert box.contains(box.center + 0.99 * along) and not box.contains(box.center + 1.01 * along)
    assert read_regions(path) == read_areas(path).boxes
    (tmp_path / "b.json").write_text(format_areas([box]))
    assert read_regions(tmp_path / "b.json") == [box]


def test03b_box_contains_points():
    box = Region.create("b", [0, 0, 0], [1, 1, 1])
    points = np.array([[0.5, 0.5, 0.5], [1.0, 0.0, 1.0], [1.01, 0.5, 0.5], [np.inf, 0, 0], [0.5, 0.5, -0.2]])
    assert box.contains(points).tolist() == [True, True, False, False, False]
    assert box.contains(points, 0.02).tolist() == [True, True, True, False, False]
    assert box.contains(points.reshape(1, 5, 3)).shape == (1, 5)


def test03c_areas_of_store():
    regions = read_regions(demo.find_store_scene().parent / "regions.json")
    assert len(regions) > 20 and all((r.corners[0] < r.corners[1]).all() for r in regions)


def test04_box_groups_have_box_indices(tmp_path):
    other = {"name": "b", "min": [5, 0, 0], "max": [6, 1, 1]}
    mesh = {"name": "m", "mesh": "m.ply"}
    path = write_areas(
        tmp_path, BOX, other, mesh, {"name": "g", "parts": ["shelf", "b"]}, {"name": "h", "parts": ["m"]}
    )
    areas = read_areas(path)
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
def test05_invalid_areas_are_refused(tmp_path, read, value):
    path = tmp_path / "a.json"
    path.write_text(json.dumps(value))
    with pytest.raises(NergError) as message:
        read(path)
    assert str(path) in str(message.value) and "\n" not in str(message.value)


@pytest.mark.parametrize("turn", ["30", True, {"z": 30}, [[1, 0, 0], [0, 1, 0], [0, 0, 1]]])
def test_rotations_that_are_no_angles_are_named(tmp_path, turn):
    with pytest.raises(NergError, match='the "turn" .*degrees'):
        read_areas(write_areas(tmp_path, BOX | {"turn": turn}))


def test06_group_depth_is_limited(tmp_path):
    entries = [BOX, {"name": "0", "parts": ["shelf"]}]
    entries += [{"name": str(k), "parts": [str(k - 1)]} for k in range(1, 400)]
    assert read_areas(write_areas(tmp_path, *entries)).element_indices()["399"] == (0,)
    assert read_areas(write_areas(tmp_path, *entries[60::-1])).element_indices()["59"] == (0,)
    with pytest.raises(NergError, match="deeper"):
        read_areas(write_areas(tmp_path, *entries[::-1]))


# ---- Objects of Aria Digital Twin as boxes in the frame of gaze samples ----

BOX_HEAD = (
    "object_uid,timestamp[ns],p_local_obj_xmin[m],p_local_obj_xmax[m],p_local_obj_ymin[m],p_local_obj_ymax[m],"
    "p_local_obj_zmin[m],p_local_obj_zmax[m]"
)

POSE_HEAD = "object_uid,timestamp[ns],t_wo_x[m],t_wo_y[m],t_wo_z[m],q_wo_w,q_wo_x,q_wo_y,q_wo_z"
HALF = np.sqrt(0.5)


def write_twin(folder: Path) -> Path:
    """A chair that is rotated by 90 degrees about the vertical, two static cups, and a cup that is moved."""
    folder.mkdir(parents=True, exist_ok=True)
    boxes = ["1,-1,-0.2,0.4,0,1,-0.1,0.1", "2,-1,0,0.1,0,0.1,0,0.1", "3,-1,0,0.1,0,0.1,0,0.1", "4,-1,0,1,0,1,0,1"]
    poses = [f"1,-1,2,0,3,{HALF},0,{HALF},0", "2,-1,0,1,0,1,0,0,0", "3,-1,0,2,0,1,0,0,0", "4,100,0,0,0,1,0,0,0"]
    (folder / "3d_bounding_box.csv").write_text("\n".join([BOX_HEAD, *boxes]) + "\n")
    (folder / "scene_objects.csv").write_text("\n".join([POSE_HEAD, *poses]) + "\n")
    names = {"1": ("Chair", "chair"), "2": ("Cup", "cup"), "3": ("Cup", "cup"), "4": ("Carried", "cup")}
    instances = {uid: {"instance_name": name, "category": category} for uid, (name, category) in names.items()}
    (folder / "instances.json").write_text(json.dumps(instances))
    return folder


def test01_twin_boxes_have_poses(tmp_path):
    regions = read_twin_objects(write_twin(tmp_path))
    assert [r.name for r in regions] == ["Chair", "Cup 1", "Cup 2"]
    chair = regions[0]
    # The y axis of the twin is up. A rotation by 90 degrees about y maps x to -z and z to x.
    corners = np.array([[x, y, z] for x in (-0.2, 0.4) for y in (0, 1) for z in (-0.1, 0.1)])
    in_twin = np.stack([corners[:, 2], corners[:, 1], -corners[:, 0]], axis=1) + (2, 0, 3)
    in_rays = in_twin @ TrackingFrame(up="y").to_rays()[:3, :3].T
    assert np.allclose(chair.bounds, [in_rays.min(axis=0), in_rays.max(axis=0)])
    assert chair.contains(in_rays, 1e-9).all() and not chair.contains(in_rays + (0, 0, 0.3)).all()
    assert np.allclose(regions[1].bounds, [[0, -0.1, 1], [0.1, 0, 1.1]])


def test_twin_tables_that_a_spreadsheet_saved_are_read(tmp_path):
    expected = read_twin_objects(write_twin(tmp_path))
    for path in tmp_path.glob("*.csv"):
        path.write_text("sep=;\n" + path.read_text().replace(",", ";"), "utf-16")
    assert read_twin_objects(tmp_path) == expected


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
def test03_damaged_twin_files_are_refused(tmp_path, name, old, new):
    write_twin(tmp_path)
    text = (tmp_path / name).read_text()
    (tmp_path / name).write_text(text.replace(old, new, 1))
    with pytest.raises(NergError) as message:
        read_twin_objects(tmp_path)
    assert str(tmp_path) in str(message.value) and "\n" not in str(message.value)


def test04_boxes_of_recording(tmp_path, recorded):
    source = recorded("aria") / "adt" / "3d_bounding_box.csv"
    text = source.read_text()
    (tmp_path / "3d_bounding_box.csv").write_text(text)
    uids = [line.split(",")[0] for line in text.splitlines()[1:]]
    poses = [f"{uid},-1,0,0,0,1,0,0,0" for uid in uids]
    (tmp_path / "scene_objects.csv").write_text("\n".join([POSE_HEAD, *poses]))
    regions = {r.name: r for r in read_twin_objects(tmp_path)}
    rows = {line.split(",")[0]: np.array(line.split(",")[2:], float) for line in text.splitlines()[1:]}
    assert len(regions) == len(rows) == 349
    for uid, (x0, x1, y0, y1, z0, z1) in rows.items():
        # (x, y, z) becomes (x, -z, y); boxes have a minimum thickness of a millimetre.
        expected = np.array([[x0, -z1, y0], [x1, -z0, y1]])
        assert np.abs(regions[uid].bounds - expected).max() <= 1e-3 + 1e-9
