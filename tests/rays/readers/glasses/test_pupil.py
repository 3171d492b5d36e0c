"""Exports of Pupil Core."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.rays.readers.reading import dropped, read


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
    rays = read("pupil", folder, marker=0.05, up="z")
    assert rays.persons == ("anna",) and np.allclose(rays.t, [10.51, 10.53]) and rays.metadata["marker"] == 0.05
    turn = Rotation.from_rotvec([[0, 0, 0.51 * np.pi / 2], [0, 0, 0.53 * np.pi / 2]])
    assert np.allclose(rays.direction, [0, 0, 1]) and np.allclose(rays.head, [0, 0, 1])
    assert rays.metadata["floor"] == "unknown"
    want = 0.05 * np.array([[0.51, 20, 30], [0.53, 20, 30]]) + turn.apply(
        1e-3 * np.array([[-10, 10, -20], [-40, 10, -20]])
    )
    assert np.allclose(rays.origin, want)
    assert dropped(rays) == {"confidence below 0.6": [[3, 3]], "there is no head pose at that time": [[5, 5]]}
    with pytest.raises(ValueError, match="length in metres"):
        read("pupil", folder)
    (folder / "head_pose_tracker_poses.csv").unlink()
    with pytest.raises(ValueError, match="run the head pose tracker"):
        read("pupil", folder / "gaze_positions.csv", marker=0.05)


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
    rays = read("pupil", folder, marker=1.0, up="z")
    assert np.allclose(rays.t, [10.01, 10.06, 10.92, 11.04]) and np.allclose(rays.origin[:, 0], rays.t)
    assert dropped(rays) == {"there is no head pose at that time": [[4, 4]]}
    # What was read is written down: both files, by person, since their names are alike in every recording.
    assert [s["file"] for s in rays.metadata["sources"]] == [
        "anna/head_pose_tracker_poses.csv",
        "anna/gaze_positions.csv",
    ]
