"""Tests of `nerg_mi.photos.posed`."""

import csv
import gzip

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.photos import posed
from nerg_mi.photos.posed import PosedFrame, UnusedFrame, describe_unused, drop_duplicates, read_semidense, rigid_pose
from nerg_mi.photos.transforms import read_transforms
from tests.photos.written_sets import frame

# ---- Frames in files: lenses, poses and coordinate transforms ----


def test_focal_length_takes_precedence(write):
    t = read_transforms(
        write(
            {
                "w": 20.0,
                "h": 10.0,
                "fl_x": 30.0,
                "camera_angle_x": 1.0,
                "cx": 9.0,
                "k1": 0.1,
                "frames": [frame("b.png"), frame("a.png")],
            }
        )
    )
    assert [f.name for f in t.frames] == ["a.png", "b.png"]
    i = t.frames[0].intrinsics(20, 10)
    assert (i.fx, i.fy, i.cx, i.cy, i.distortion[:4]) == (30.0, 30.0, 9.0, 5.0, (0.1, 0, 0, 0))
    half = t.frames[0].intrinsics(10, 5)
    assert (half.fx, half.cx, half.width) == (15.0, 4.5, 10)


def test_bad_intrinsics_name_the_frame(write):
    t = read_transforms(write({"frames": [frame("a.png")]}))
    with pytest.raises(ValueError, match="a.png.*focal length"):
        t.frames[0].intrinsics(8, 8)
    t = read_transforms(write({"w": 8, "h": 4, "fl_x": 3.0, "frames": [frame("a.png")]}))
    with pytest.raises(ValueError, match="a.png.*8 x 8"):
        t.frames[0].intrinsics(8, 8)


def test_scale_in_pose_is_removed(write):
    scaled = np.diag([2.0, 2, 2, 1])
    scaled[:3, 3] = 5
    f = read_transforms(write({"fl_x": 1.0, "frames": [frame("a.png", transform_matrix=scaled.tolist())]})).frames[0]
    assert np.allclose(f.to_world[:3, :3], np.eye(3)) and np.allclose(f.to_world[:3, 3], 5)


def test_mirroring_transform_is_refused(write):
    t = read_transforms(write({"fl_x": 1.0, "frames": [frame("a.png")]}))
    with pytest.raises(ValueError, match="mirrored"):
        t.transform(np.diag([1.0, 1, -1, 1]))
    with pytest.raises(ValueError, match="transposed"):
        t.transform(np.eye(4) + np.eye(4, k=-3))


def test_rounded_pose_becomes_nearest_rotation():
    turned = np.array([[0.0, -1.001, 0.0, 1], [1.0, 0.0, 0.0, 2], [0.0, 0.0, 1.0, 3]])
    pose = rigid_pose(turned.tolist())
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12) and np.allclose(pose[:3, 3], [1, 2, 3])
    assert np.abs(pose[:3] - turned).max() < 2e-3
    np.testing.assert_allclose(rigid_pose(np.diag([2.0, 2, 2, 1])), np.eye(4), atol=1e-12)


@pytest.mark.parametrize(
    "matrix, reason",
    [
        ("x", "numbers"),
        (np.diag([1.0, 1, -1, 1]), "mirrored"),
        (np.diag([1.0, 1, 2, 1]), "not a rotation"),
        (np.eye(4) + np.eye(4, k=-3), "transposed"),
        (np.eye(4) + 0.1 * np.eye(4)[[3, 2, 1, 0]], "last row is 0.1, 0, 0, 1"),
        (np.diag([1.0, 1, 1, 2]), "last row is 0, 0, 0, 2"),
        (np.zeros((3, 3)), "shape"),
        (np.diag([1e13, 1e13, 1e13, 1]), "beyond"),
        (np.full((4, 4), np.nan), "finite"),
    ],
)
def test_invalid_poses_are_refused(matrix, reason):
    with pytest.raises(NergError, match=reason):
        rigid_pose(matrix)


def test_duplicate_image_counts_once(tmp_path):
    (tmp_path / "a.png").touch()
    (tmp_path / "b.png").symlink_to(tmp_path / "a.png")
    first = PosedFrame("a.png", tmp_path / "a.png", np.eye(4), {})
    again = PosedFrame("b.png", tmp_path / "b.png", np.diag([1.0, -1, -1, 1]), {})
    unique, unused = drop_duplicates([first, again])
    assert unique == [first] and "a different pose" in unused[0].reason


def test_unused_frames_are_described_once_for_each_reason():
    missing = [UnusedFrame(f"{k:02}.png", f'its image "images/{k:02}.png" does not exist') for k in range(17)]
    assert describe_unused([]) == [] and describe_unused(missing[:1]) == [str(missing[0])]
    other = UnusedFrame("99.png", "its pose is singular")
    many, one = describe_unused([*missing[:9], other, *missing[9:]])
    assert "17" in many and "00.png" in many and missing[0].reason in many and "16.png" not in many
    assert one == str(other)


# ---- Semi-dense points of Project Aria ----

HEAD = "uid,graph_uid,px_world,py_world,pz_world,inv_dist_std,dist_std"


def write(path, *rows):
    path.write_bytes(gzip.compress("\n".join([HEAD, *rows, ""]).encode()))
    return path


def test_precise_points_of_one_world(tmp_path, monkeypatch):
    monkeypatch.setattr(posed, "_BLOCK", 2)
    path = write(
        tmp_path / "semidense_points.csv.gz",
        *("1,a,1,2,3,0.005,0.01", "2,a,4,5,6,0.0051,0.001", "3,a,7,8,9,0.001,0.02", "4,b,1,1,1,0.001,0.001"),
        *("5,a,nan,8,9,0.001,0.01", "", "6,a,0.5,0,-1,0,0"),
    )
    points = read_semidense(path)
    assert points.dtype == np.float32 and points.tolist() == [[1, 2, 3], [0.5, 0, -1]]
    assert read_semidense(path, "b").tolist() == [[1, 1, 1]]
    assert len(read_semidense(path, "a", max_inv_dist_std=1, max_dist_std=1)) == 4
    with pytest.raises(ValueError, match='"c"'):
        read_semidense(path, "c")
    with pytest.raises(ValueError, match="contains no point with deviations up to 0.005 1/m and -1 m"):
        read_semidense(path, max_dist_std=-1)
    monkeypatch.setattr(posed, "_MAX_WORLDS", 1)
    with pytest.raises(ValueError, match="more than 1 worlds"):
        read_semidense(path)


def test_other_files_are_refused(tmp_path):
    for row, why in (
        ("1,a,1,2", "line 2: 4 cells, the header has 7"),
        ("1,a,1,2,3,0,0,0,0", "line 2: 9 cells, the header has 7"),
        ("1,a,x,2,3,0,0", "is not a point"),
    ):
        with pytest.raises(ValueError, match=why):
            read_semidense(write(tmp_path / "p.csv.gz", row))
    (tmp_path / "p.csv").write_text("px_world,py_world,pz_world,inv_dist_std,dist_std,graph_uid\n1,2,3,0,0\n")
    with pytest.raises(ValueError, match="5 cells, the header has 6"):
        read_semidense(tmp_path / "p.csv")
    (tmp_path / "p.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="graph_uid.*px_world"):
        read_semidense(tmp_path / "p.csv")


def test_recorded_points(recorded):
    path = recorded("aria") / "gen1/mps_sample/trajectory/global_points.csv.gz"
    points = read_semidense(path)
    with gzip.open(path, "rt") as file:
        rows = [r for r in csv.DictReader(file) if float(r["inv_dist_std"]) <= 0.005 and float(r["dist_std"]) <= 0.01]
    assert points.shape == (len(rows), 3) and len(points) == 27231
    last = rows[-1]
    assert np.allclose(points[-1], [float(last[f"p{a}_world"]) for a in "xyz"], atol=1e-6)
