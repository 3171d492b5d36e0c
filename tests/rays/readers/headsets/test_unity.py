"""Logs of Unity projects."""

import gzip

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.rays.readers.reading import dropped, read

TURN = Rotation.from_euler("YX", [90, 30], degrees=True)  # of Unity: to the right, then down


@pytest.mark.parametrize("stem", ["gaze_dir", "gaze_direction", "Gaze_Forward"])
def test_unity(tmp_path, stem):
    path = tmp_path / "p7.csv.gz"
    with gzip.open(path, "wt") as out:
        out.write(
            f"timestamp,gaze_origin_x,gaze_origin_y,gaze_origin_z,{stem}_x,{stem}_y,{stem}_z,hit_x,hit_y,hit_z,status\n"
        )
        out.write("0,1,1.6,3,0,0,1,1,1.6,5,valid\n20,1,1.6,3,0,0,1,,,,INVALID\n40,1,1.6,3,0,0,2,,,,Valid\n")
    rays = read("unity", path, tick=1e-3)
    assert (
        np.allclose(rays.origin, [1, 3, 1.6])
        and np.allclose(rays.direction, [0, 1, 0])
        and np.allclose(rays.t, [0, 0.04])
    )
    assert rays.persons == ("p7",) and np.allclose(rays.hit, [[1, 5, 1.6], [np.nan] * 3], equal_nan=True)
    assert list(dropped(rays).values()) == [[[3, 3]]] and rays.metadata["preset"] == "unity"


def test_unity_local_and_head(tmp_path):
    q = TURN.as_quat()
    path = tmp_path / "log.csv"
    path.write_text(
        "time,user_id,head_pos_x,head_pos_y,head_pos_z,head_rot_x,head_rot_y,head_rot_z,head_rot_w,gaze_origin_x,gaze_origin_y,gaze_origin_z,"
        "gaze_dir_x,gaze_dir_y,gaze_dir_z\n" + ",".join(map(str, (0, 4, 1, 1.6, 2, *q, 0, 0, 0.1, 0, 0.5, 1))) + "\n"
    )
    head = read("unity_head", path)
    assert (
        np.allclose(head.origin, [1, 2, 1.6])
        and np.allclose(head.direction, [3**0.5 / 2, 0, -0.5])
        and head.persons == ("4",)
    )
    local = read("unity_local", path)
    assert np.allclose(local.origin, head.origin + 0.1 * head.direction)
    d = TURN.apply([0, 0.5, 1]) / 1.25**0.5
    assert np.allclose(local.direction, d[[0, 2, 1]])
    # The head is kept beside gaze in the head, beside gaze in the world, and not beside itself.
    world = read("unity", path)
    assert np.allclose(local.head, head.direction) and np.allclose(world.head, head.direction) and head.head is None
    path.write_text("head_pos_x,head_pos_y,head_pos_z,head_rot_x,head_rot_y,head_rot_z\n1,1.6,2,30,90,0\n")
    assert np.allclose(read("unity_head", path).direction, head.direction)


def test_unity_names_what_is_missing(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,gaze_origin_x,gaze_origin_y,gaze_origin_z\n0,0,0,0\n")
    with pytest.raises(ValueError, match="no columns gaze_dir_{x,y,z} or .*name them with --map"):
        read("unity", path)
    head = "gaze_origin_x,gaze_origin_y,gaze_origin_z,gaze_dir_x,gaze_dir_y,gaze_dir_z"
    path.write_text(head + "\n0,0,0,0,0,1\n")
    (tmp_path / "b.csv").write_text("time," + head + "\n0,0,0,0,0,0,1\n")
    with pytest.raises(ValueError, match="b.csv has other columns"):
        read("unity", path, tmp_path / "b.csv")


@pytest.mark.parametrize(
    "head",
    [
        "time,gazeOrigin_x,gazeOrigin_y,gazeOrigin_z,gazeDirection_x,gazeDirection_y,gazeDirection_z",
        "Time,GazeOriginX,GazeOriginY,GazeOriginZ,GazeDirX,GazeDirY,GazeDirZ",
        "time,origin_x,origin_y,origin_z,dir_x,dir_y,dir_z",
        "t,x,y,z,dx,dy,dz",
        "t,Position (x),Position (y),Position (z),Direction.x,Direction.y,Direction.z",
        "time [s],gaze origin x [m],gaze origin y [m],gaze origin z [m],gaze dir x,gaze dir y,gaze dir z",
    ],
)
def test_names_that_are_usual_elsewhere(tmp_path, head):
    path = tmp_path / "ann.csv"
    path.write_text(head + "\n0.5,1,1.6,3,0,0,2\n")
    rays = read("unity", path)
    assert np.allclose(rays.origin, [[1, 3, 1.6]]) and np.allclose(rays.direction, [[0, 1, 0]]) and rays.t[0] == 0.5


def test_heads_of_bare_names(tmp_path):
    path, q = tmp_path / "ann.csv", TURN.as_quat()
    path.write_text("t,x,y,z,qx,qy,qz,qw\n" + ",".join(map(str, (0, 1, 1.6, 2, *q))) + "\n")
    rays = read("unity_head", path)
    assert np.allclose(rays.direction, [3**0.5 / 2, 0, -0.5]) and np.allclose(rays.origin, [[1, 2, 1.6]])
    path.write_text("t,posX,posY,posZ,rotX,rotY,rotZ\n0,1,1.6,2,30,90,0\n")
    assert np.allclose(read("unity_head", path).direction, rays.direction)


HEAD = "time,gaze_origin_x,gaze_origin_y,gaze_origin_z,gaze_dir_x,gaze_dir_y,gaze_dir_z"


def log(path, column, values):
    rows = (f"{0.02 * k},1,1.6,{k / 50},0,0,1,{value}" for k, value in enumerate(values))
    path.write_text(f"{HEAD},{column}\n" + "\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize(
    "column, values, kept",
    [
        ("gaze_status", [0, 1, 2, 2], [2, 3]),  # Varjo's codes
        ("isValid", ["True", "False", "true", ""], [0, 2]),
        ("GazeValidity", [1, 0, 0, 1], [0, 3]),
        ("gaze_is_valid", ["1.0", "0.0", "1.0", "nan"], [0, 2]),
    ],
)
def test_validity(tmp_path, column, values, kept):
    rays = read("unity", log(tmp_path / "a.csv", column, values))
    assert np.allclose(rays.t, 0.02 * np.array(kept)) and sum(map(len, dropped(rays).values())) > 0


def test_values_of_validity_are_of_all_files(tmp_path):
    files = log(tmp_path / "a.csv", "gaze_status", [1, 1]), log(tmp_path / "b.csv", "gaze_status", [1, 2])
    assert len(read("unity", *files)) == 1
    with pytest.raises(ValueError, match="'gaze_status'.*1.*2"):
        read("unity", files[0])
    assert len(read("unity", files[0], valid="gaze_status=1")) == 2 and len(read("unity", files[0], valid="none")) == 2


def test_a_counter_is_no_participant(tmp_path):
    rays = read("unity", log(tmp_path / "ann.csv", "id", range(40)))
    assert rays.persons == ("ann",) and rays.metadata["unused_columns"] == ["id"]
    assert "'id' has another value in nearly every row" in rays.metadata["complaints"][0]
    few = read("unity", log(tmp_path / "ann.csv", "id", [k // 10 for k in range(40)]))
    assert few.persons == ("0", "1", "2", "3") and "complaints" not in few.metadata
