import gzip

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.rays.readers import unity as headsets
from nerg_mi.rays.readers.vr_supermarket import PRESETS, preset

TURN = Rotation.from_euler("YX", [90, 30], degrees=True)  # of Unity: to the right, then down


def dropped(rays):
    return {d["reason"]: d["rows"] for d in rays.metadata["dropped"]}


@pytest.mark.parametrize("stem", ["gaze_dir", "gaze_direction", "Gaze_Forward"])
def test_unity(tmp_path, stem):
    path = tmp_path / "p7.csv.gz"
    with gzip.open(path, "wt") as out:
        out.write(
            f"timestamp,gaze_origin_x,gaze_origin_y,gaze_origin_z,{stem}_x,{stem}_y,{stem}_z,hit_x,hit_y,hit_z,status\n"
        )
        out.write("0,1,1.6,3,0,0,1,1,1.6,5,valid\n20,1,1.6,3,0,0,1,,,,INVALID\n40,1,1.6,3,0,0,2,,,,Valid\n")
    rays = preset("unity").read([path], tick=1e-3)
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
    head = preset("unity_head").read([path])
    assert (
        np.allclose(head.origin, [1, 2, 1.6])
        and np.allclose(head.direction, [3**0.5 / 2, 0, -0.5])
        and head.persons == ("4",)
    )
    local = preset("unity_local").read([path])
    assert np.allclose(local.origin, head.origin + 0.1 * head.direction)
    d = TURN.apply([0, 0.5, 1]) / 1.25**0.5
    assert np.allclose(local.direction, d[[0, 2, 1]])
    path.write_text("head_pos_x,head_pos_y,head_pos_z,head_rot_x,head_rot_y,head_rot_z\n1,1.6,2,30,90,0\n")
    assert np.allclose(preset("unity_head").read([path]).direction, head.direction)


def test_unity_names_what_is_missing(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,gaze_origin_x,gaze_origin_y,gaze_origin_z\n0,0,0,0\n")
    with pytest.raises(ValueError, match="no columns gaze_dir_{x,y,z} or .*name them with --map"):
        headsets.unity([path])
    head = "gaze_origin_x,gaze_origin_y,gaze_origin_z,gaze_dir_x,gaze_dir_y,gaze_dir_z"
    path.write_text(head + "\n0,0,0,0,0,1\n")
    (tmp_path / "b.csv").write_text("time," + head + "\n0,0,0,0,0,0,1\n")
    with pytest.raises(ValueError, match="b.csv has other columns"):
        headsets.unity([path, tmp_path / "b.csv"])


def test_varjo(tmp_path):
    q = ", ".join(f"{v:.6f}" for v in TURN.as_quat())
    path = tmp_path / "2026-01-02.csv"
    path.write_text(
        "Frame;CaptureTime;HMDPosition;HMDRotation;GazeStatus;CombinedGazeForward;CombinedGazePosition\n"
        f"1;1700000000000000000;(1.000, 1.600, 2.000);({q});VALID;(0.000, 0.500, 1.000);(0.000, 0.000, 0.100)\n"
        f"2;1700000000005000000;(1.000, 1.600, 2.000);({q});INVALID;;\n"
        f"3;1700000000010000000;(1.000, 1.600, 2.000);({q});VALID;(0.000, 0.000, 1.000);(0.000, 0.000, 0.000)\n"
    )
    rays = preset("varjo").read([path])
    assert np.allclose(rays.t, [0, 0.01], atol=1e-6) and dropped(rays) == {"GazeStatus is not VALID": [[3, 3]]}
    ahead = np.array([3**0.5 / 2, 0, -0.5])
    assert [s["file"] for s in rays.metadata["sources"]] == ["2026-01-02.csv"]
    assert np.allclose(rays.direction[1], ahead, atol=1e-6) and np.allclose(
        rays.origin, [[1, 2, 1.6] + 0.1 * ahead, [1, 2, 1.6]], atol=1e-6
    )
    path.write_text(path.read_text().replace("(0.000, 0.500, 1.000)", "(0.000, oops)"))
    with pytest.raises(ValueError, match="line 2, column 'CombinedGazeForward'"):
        preset("varjo").read([path])


def test_hololens(tmp_path):
    def line(t, seen, origin, direction, distance):
        hands = np.zeros(2 * (1 + 16 * 26))
        return ",".join(map(str, (t, *np.eye(4).ravel(), *hands, seen, *origin, 1, *direction, 0, distance)))

    path = tmp_path / "2026-01-02-101112_head_hand_eye.csv"
    path.write_text(
        "\n".join(
            [
                line(132500000000000000, 1, (1, 1.6, -2), (0, 0, -1), 2.5),
                line(132500000000200000, 0, (0, 0, 0), (0, 0, 0), 0),
                line(132500000000400000, 1, (1, 1.6, -2), (0, 1, 0), 0),
            ]
        )
    )
    rays = preset("hololens").read([path])
    assert np.allclose(rays.t, [0, 0.04], atol=1e-5) and rays.persons == ("2026-01-02-101112",)
    assert np.allclose(rays.origin, [1, 2, 1.6]) and np.allclose(rays.direction, [[0, 1, 0], [0, 0, 1]])
    assert np.allclose(rays.hit, [[1, 4.5, 1.6], [np.nan] * 3], equal_nan=True) and dropped(rays) == {
        "the eyes were not seen": [[2, 2]]
    }


def test_pupil(tmp_path):
    folder = tmp_path / "anna" / "000" / "exports" / "001"
    folder.mkdir(parents=True)
    # The camera turns by 90 degrees about the markers' z in a second and moves one edge of a marker (0.05 m) along x.
    steps = np.linspace(0, 1, 21)
    (folder / "head_pose_tracker_poses.csv").write_text(
        "timestamp,rotation_x,rotation_y,rotation_z,translation_x,translation_y,translation_z,pitch,yaw,roll\n"
        + "".join(f"{10 + s},0,0,{s * np.pi / 2},{s},20,30,0,0,0\n" for s in steps)
    )
    names = [f"{n}_{a}" for n in ("eye_center0_3d", "gaze_normal0", "eye_center1_3d", "gaze_normal1") for a in "xyz"]
    both, one = "20,10,-20,0.1,0,1,-40,10,-20,-0.1,0,1", ",,,,,,-40,10,-20,0,0,1"
    (folder / "gaze_positions.csv").write_text(
        "gaze_timestamp,world_index,confidence," + ",".join(names) + "\n"
        f"10.51,0,0.9,{both}\n10.52,0,0.3,{both}\n10.53,0,0.9,{one}\n11.5,0,0.9,{both}\n"
    )
    rays = preset("pupil").read([folder], marker=0.05, up="z")
    assert rays.persons == ("anna",) and np.allclose(rays.t, [10.51, 10.53]) and rays.metadata["marker"] == 0.05
    turn = Rotation.from_rotvec([[0, 0, 0.51 * np.pi / 2], [0, 0, 0.53 * np.pi / 2]])
    assert np.allclose(rays.direction, [0, 0, 1])
    want = 0.05 * np.array([[0.51, 20, 30], [0.53, 20, 30]]) + turn.apply(
        1e-3 * np.array([[-10, 10, -20], [-40, 10, -20]])
    )
    assert np.allclose(rays.origin, want)
    assert dropped(rays) == {"confidence below 0.6": [[3, 3]], "there is no head pose at that time": [[5, 5]]}
    with pytest.raises(ValueError, match="length in metres"):
        preset("pupil").read([folder])
    (folder / "head_pose_tracker_poses.csv").unlink()
    with pytest.raises(ValueError, match="run the head pose tracker"):
        preset("pupil").read([folder / "gaze_positions.csv"], marker=0.05)


def test_between_head_poses_far_apart_gaze_is_dropped(tmp_path):
    folder = tmp_path / "anna"
    folder.mkdir()
    head = "timestamp,rotation_x,rotation_y,rotation_z,translation_x,translation_y,translation_z\n"
    (folder / "head_pose_tracker_poses.csv").write_text(
        head + "".join(f"{t},0,0,0,{t},0,0\n" for t in (10, 10.05, 11, 11.05))
    )
    names = ",".join(
        f"{n}_{a}" for n in ("eye_center0_3d", "gaze_normal0", "eye_center1_3d", "gaze_normal1") for a in "xyz"
    )
    rows = "".join(f"{t},0.9,0,0,0,0,0,1,0,0,0,0,0,1\n" for t in (10.01, 10.06, 10.5, 10.92, 11.04))
    (folder / "gaze_positions.csv").write_text(f"gaze_timestamp,confidence,{names}\n{rows}")
    rays = preset("pupil").read([folder], marker=1.0, up="z")
    assert np.allclose(rays.t, [10.01, 10.06, 10.92, 11.04]) and np.allclose(rays.origin[:, 0], rays.t)
    assert dropped(rays) == {"there is no head pose at that time": [[4, 4]]}
    # What was read is written down: both files, by person, since their names are alike in every recording.
    assert [s["file"] for s in rays.metadata["sources"]] == [
        "anna/head_pose_tracker_poses.csv",
        "anna/gaze_positions.csv",
    ]


def test_every_preset_says_what_it_reads():
    assert all(p.summary and callable(p.read) for p in PRESETS.values())


def test_a_vector_that_is_cut_off(tmp_path):
    """Of Varjo's cells: told by line and column, or left out and counted."""
    head = "CaptureTime;HMDPosition;HMDRotation;CombinedGazePosition;CombinedGazeForward;GazeStatus\n"
    row = "{};(0, 1.6, 0);(0, 0, 0, 1);(0, 0, 0);(0, 0, 1);VALID\n"
    path = tmp_path / "ann.csv"
    path.write_text(
        head + "1;(0, 1.6;(0, 0, 0, 1);(0, 0;(0, 0, 1);VALID\n" + "".join(row.format(i * 10**7) for i in range(5))
    )
    with pytest.raises(NergError, match="line 2, column 'HMDPosition'.*--skip-bad-lines"):
        headsets.varjo([path])
    rays = headsets.varjo([path], skip_bad_lines=True)
    assert (
        len(rays) == 5
        and rays.t[0] == 0
        and rays.metadata["dropped"][0]["rows"] == [[2, 2]]
        and rays.metadata["rows_read"] == 6
    )
    path.write_text(head + "".join(row.format(i * 10**7) for i in range(5)) + "50000000;(0, 1.6, 0);(0, 0")
    rays = headsets.varjo([path], skip_bad_lines=True)
    assert len(rays) == 5 and rays.metadata["dropped"][0]["rows"] == [[7, 7]]
