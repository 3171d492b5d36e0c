"""Tests of `nerg_mi.tracking.readers.columns`."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.tracking.readers.columns import (
    ColumnFinder,
    ColumnMap,
    find_valid_values,
    is_validity_column,
    mark_valid,
    may_be_validity_column,
    parse_time_unit,
    parse_valid,
    require_valid_values,
    split_column_name,
)

# ---- Columns by their usual names ----


@pytest.fixture
def table(tmp_path):
    (tmp_path / "t.csv").write_text("Gaze Dir.X,gaze_dir_y,GAZE_DIR_Z,hit_x,hit_y,Time,time\n")
    return ColumnFinder(tmp_path / "t.csv")


def test_spaces_dots_and_case_are_ignored(table):
    assert table.require_vector("look", "gaze_dir") == ("Gaze Dir.X", "gaze_dir_y", "GAZE_DIR_Z")
    assert table.find_vector("hit") is None and table.find_vector("hit", axes="xy") == ("hit_x", "hit_y")
    # Of columns whose names only differ in case, the first is used.
    assert table.find("clock", "time") == "Time" and table.find("person") is None


def test_missing_columns_are_reported_with_available_ones(table):
    with pytest.raises(NergError, match="t.csv.*Dir.X.*columns"):
        table.require_vector("head", "hmd", axes="xyzw")


def test_literal_names_have_precedence(tmp_path):
    """Literal matches have precedence over matches by words, also if those are listed first."""
    (tmp_path / "t.csv").write_text("gazeDir_x,gazeDir_y,gazeDir_z,look_x,look_y,look_z,userId,id\n")
    table = ColumnFinder(tmp_path / "t.csv")
    assert (
        table.require_vector("gaze_dir", "look") == ("look_x", "look_y", "look_z")
        and table.find("user_id", "id") == "id"
    )
    assert (
        table.require_vector("gaze_dir") == ("gazeDir_x", "gazeDir_y", "gazeDir_z")
        and table.find("user_id") == "userId"
    )


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
    assert split_column_name(name) == words


# ---- Column map ----


@pytest.mark.parametrize(
    "text",
    [
        "origin=x,y,z direction=dx,dy,dz hit=hx,hy,hz t=time person=id confidence=c cohort=g",
        "origin=x,y,z wxyz=a,b,c,d t=time",
        "origin=x,y,z ypr=yaw,pitch",
        "direction=a,b,c matrix=" + ",".join(f"m{i}" for i in range(12)) + " eye=e,f,g",
        'origin=x,y,z direction=a,b,c "t=timestamp [ns]"',
        "origin=x,y,z azel=az,-el",
        'origin=x,y,z "yawpitch=-gaze yaw (rad),pitch" xyzw=a,b,c,d eye=e,f,g',
        r'origin=x,y,z direction=a,b,c "t=the \"time\" in \\s"',
        "origin=x,y,z direction=a,b,c head=qx,qy,qz,qw eyes=e,f,g,h,i,j",
    ],
)
def test_round_trip(text):
    columns = ColumnMap.parse(text)
    assert str(columns) == text and ColumnMap.parse(str(columns)) == columns


@pytest.mark.parametrize(
    "text, message",
    [
        ("origin=x,y,z", "direction is missing"),
        ("direction=x,y,z", "origin is missing"),
        ("origin=x,y direction=a,b,c", "origin needs 3"),
        ("origin=x,y,z xyzw=a,b,c", "xyzw needs 4"),
        ("origin=x,y,z direction=a,b,c speed=v", "'speed' is unknown"),
        ("origin=x,y,z origin=x,y,z direction=a,b,c", "given twice"),
        ("origin=x,y,z xyzw=a,b,c,d ypr=e,f,g", "two poses"),
        ("origin=x,y,z direction=a,b,c azel=d,e", "direction and azel are two directions"),
        ("origin=x,y,z azel=d,e yawpitch=f,g", "azel and yawpitch are two directions"),
        ("origin=x,y,z azel=d", "azel needs 2"),
        ("origin=x,y,z matrix=" + ",".join("abcdefghijkl"), "leave out origin"),
        ("origin=x,y,z direction=a,b,c eye=e,f,g", "orientation; add one of"),
        ("origin=x,y,z direction=a,b,c xyzw=d,e,f,g head=h,i,j", "leave out head or xyzw"),
        ("origin=x,y,z xyzw=d,e,f,g head=h,i,j", "leave out head"),
        ("origin=x,y,x direction=a,b,c", "'x' has two roles"),
        ("origin=x,y,z direction=a,b,z", "'z' has two roles"),
        ("origin=x,y,z direction=a,b,c t=n person=n", "'n' has two roles"),
        ("origin=x,y,z azel=-x,el", "'x' has two roles"),
    ],
)
def test_invalid_maps_are_refused(text, message):
    with pytest.raises(NergError, match=message):
        ColumnMap.parse(text)


# ---- Column names of validity, and the meaning of their values ----


@pytest.mark.parametrize(
    "name",
    "isValid IsGazeValid GazeValidity gaze_is_valid valid Status GazeStatus gaze_status tracking_state "
    "combinedGazeValid eye_tracked gazeRay.isValid validity_flag IsEyeTrackingEnabledAndValid HasValidGaze".split(),
)
def test_names_of_validity(name):
    assert is_validity_column(name) and may_be_validity_column(name)


@pytest.mark.parametrize(
    "name",
    "left_valid RightEyeValidity left_eye_data_validata_bit_mask calibration_is_valid "
    "blink eye_detected GazeAvailable gaze.lost left_tracked".split(),
)
def test_names_of_other_validities(name):
    assert not is_validity_column(name) and may_be_validity_column(name)


@pytest.mark.parametrize("name", "state trial_status time statusbar gaze_dir_x blinks_per_minute".split())
def test_names_without_validity(name):
    assert not is_validity_column(name) and not may_be_validity_column(name)


@pytest.mark.parametrize(
    "name, values, valid",
    [
        ("isValid", ["True", "False", ""], ["True"]),
        ("gaze_valid", ["1.0", "0.0", "nan"], ["1.0"]),
        ("valid", ["0"], []),
        ("gaze_status", ["VALID", "Adjust", "INVALID"], ["VALID"]),
        ("tracking_state", ["Not Tracked", "Tracking", "limited"], ["Tracking"]),
        ("gaze_status", ["0", "1", "2"], ["2"]),
        ("GazeStatus", ["2.0", "0.0"], ["2.0"]),
        ("gaze_status", ["0", "1"], None),  # calibrating, or true
        ("status", ["0", "1", "2"], None),  # of an unknown device
        ("isValid", ["1", "-1"], None),
        ("isValid", ["+1", " 0"], ["+1"]),
        ("valid", ["0", "1", "4"], None),  # for some trackers 0 is best
        ("status", ["good", "valid"], None),
    ],
)
def test_meaning_of_values(name, values, valid):
    assert find_valid_values(name, values) == valid


def test_uncertain_values_are_reported():
    with pytest.raises(NergError, match="'status'.*3.*90.*4.*valid"):
        require_valid_values("a.csv", "status", {"": 4, "3": 90})


def test_values_given_by_the_user():
    assert parse_valid(None) is None and parse_valid("none") == {}
    assert parse_valid('"gaze status=2" isValid=true,1') == {"gaze status": ("2",), "isValid": ("true", "1")}
    for text in ("", "status", "status=", "=2", '"status=2'):
        with pytest.raises(NergError, match="valid is"):
            parse_valid(text)
    assert mark_valid(np.array(["2", "2.0", "True", "3"]), ["2", "true"]).tolist() == [True, True, True, False]


def test_units_and_values_are_compared_in_the_compatible_form():
    assert parse_time_unit("t [\u00b5s]") == parse_time_unit("t [\u03bcs]") == pytest.approx(1e-6)
    assert mark_valid(np.array(["gu\u0308ltig", "nein"]), ["g\u00fcltig"]).tolist() == [True, False]
