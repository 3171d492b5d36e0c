"""Tests of `nerg_mi.formats.boxes`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.boxes import Region, read_twin_objects
from nerg_mi.tracking.readers.base import TrackingFrame


def test03b_box_contains_points():
    box = Region.create("b", [0, 0, 0], [1, 1, 1])
    points = np.array([[0.5, 0.5, 0.5], [1.0, 0.0, 1.0], [1.01, 0.5, 0.5], [np.inf, 0, 0], [0.5, 0.5, -0.2]])
    assert box.contains(points).tolist() == [True, True, False, False, False]
    assert box.contains(points, 0.02).tolist() == [True, True, True, False, False]
    assert box.contains(points.reshape(1, 5, 3)).shape == (1, 5)


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
