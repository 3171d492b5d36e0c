"""Presets by names."""

import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.guess import check_is_table, preset_of_columns, preset_of_files, preset_of_text
from nerg_mi.rays.readers.columns import ColumnFinder


def table(path, head):
    path.write_text(head + "\n")
    return ColumnFinder(path)


@pytest.mark.parametrize(
    "head, preset",
    [
        ("tracking_timestamp_us,yaw_rads_cpf,pitch_rads_cpf,depth_m", "aria"),
        ("ViewIndex,FOV1,PositionX,QuaternionX,GazePosX,GazeQX,Timestamp", "eyenavgs"),
        ("timestamp [ns],gaze_origin_X,gaze_origin_Y,gaze_origin_Z,gaze_dir_X", "neon_mocap"),
    ],
)
def test_columns(tmp_path, head, preset):
    found = preset_of_columns(table(tmp_path / "a.csv", head))
    assert found is not None and found[0] == preset
    assert preset_of_columns(table(tmp_path / "a.csv", head.partition(",")[0])) is None


def test_gaze_alone_is_no_sign_of_unity(tmp_path):
    """Of which world it is, rows tell, and no name."""
    gaze = "gaze_dir_x,gaze_dir_y,gaze_dir_z,gaze_origin_x,gaze_origin_y,gaze_origin_z"
    assert preset_of_columns(table(tmp_path / "a.csv", gaze)) is None
    assert preset_of_columns(table(tmp_path / "c.csv", "x,y,z")) is None


def test_files_and_first_lines(tmp_path):
    (tmp_path / "x_head_hand_eye.csv").write_text("0\n")
    (tmp_path / "day.csv").write_text("ann|3|[1, 2]\n")
    found = preset_of_files(tmp_path / "x_head_hand_eye.csv"), preset_of_text(tmp_path / "day.csv")
    assert found[0] and found[0][0] == "hololens" and found[1] and found[1][0] == "skeleton"
    (tmp_path / "a.csv").write_text("a|b|c\n")
    assert preset_of_text(tmp_path / "a.csv") is None and preset_of_files(tmp_path / "a.csv") is None
    check_is_table(tmp_path / "a.csv")
    with pytest.raises(NergError, match="name a file of it"):
        check_is_table(tmp_path)
