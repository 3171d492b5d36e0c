"""Columns by their usual names."""

import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.columns import ColumnFinder, column_words


@pytest.fixture
def table(tmp_path):
    (tmp_path / "t.csv").write_text("Gaze Dir.X,gaze_dir_y,GAZE_DIR_Z,hit_x,hit_y,Time,time\n")
    return ColumnFinder(tmp_path / "t.csv")


def test_spaces_dots_and_cases_are_one(table):
    assert table.vector("look", "gaze_dir") == ("Gaze Dir.X", "gaze_dir_y", "GAZE_DIR_Z")
    assert table.find_vector("hit") is None and table.find_vector("hit", axes="xy") == ("hit_x", "hit_y")
    # Of columns whose names differ in case alone, the first.
    assert table.find("clock", "time") == "Time" and table.find("person") is None


def test_what_is_missing_is_named_with_what_is_there(table):
    with pytest.raises(NergError, match="t.csv.*Dir.X.*--map"):
        table.vector("head", "hmd", axes="xyzw")


def test_names_as_they_are_come_first(tmp_path):
    """What was found before names were taken apart is found still, though a name in words stands ahead of it."""
    (tmp_path / "t.csv").write_text("gazeDir_x,gazeDir_y,gazeDir_z,look_x,look_y,look_z,userId,id\n")
    table = ColumnFinder(tmp_path / "t.csv")
    assert table.vector("gaze_dir", "look") == ("look_x", "look_y", "look_z") and table.find("user_id", "id") == "id"
    assert table.vector("gaze_dir") == ("gazeDir_x", "gazeDir_y", "gazeDir_z") and table.find("user_id") == "userId"


@pytest.mark.parametrize(
    "name, words",
    [
        ("gazeOrigin_x", "gaze_origin_x"),
        ("GazeOriginX", "gaze_origin_x"),
        ("HMDPosition.x", "hmd_position_x"),
        ("gaze_origin_L.x(mm)", "gaze_origin_l_x"),
        ("Gaze origin [X]", "gaze_origin_x"),
        ("timestamp [ns]", "timestamp"),
        ("ctw_00", "ctw_00"),
        ("[]", ""),
    ],
)
def test_words(name, words):
    assert column_words(name) == words
