"""The objects of Aria Digital Twin as boxes in the frame of rays."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.areas import read_areas, read_twin_objects
from nerg_mi.rays.readers.base import Frame

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
    in_rays = in_twin @ Frame(up="y").to_rays()[:3, :3].T
    assert np.allclose(chair.bounds, [in_rays.min(axis=0), in_rays.max(axis=0)])
    assert chair.holds(in_rays, 1e-9).all() and not chair.holds(in_rays + (0, 0, 0.3)).all()
    assert np.allclose(found[1].bounds, [[0, -0.1, 1], [0.1, 0, 1.1]])


def test02_categories_and_groups(tmp_path):
    write_twin(tmp_path / "twin")
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"regions": [{"adt": "twin", "categories": ["cup"], "name": "cups"}]}))
    areas = read_areas(path)
    assert areas.names == ("Cup 1", "Cup 2", "cups") and areas.members()["cups"] == (0, 1)
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
