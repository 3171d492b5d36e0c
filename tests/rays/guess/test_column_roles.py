"""What names of columns tell."""

import pytest

from nerg_mi.rays.guess import find_roles, in_degrees, time_unit


@pytest.mark.parametrize(
    "columns",
    [
        ["x", "y", "z"],
        ["PositionX", "PositionY", "PositionZ"],
        ["tx_world_device", "ty_world_device", "tz_world_device"],
        ["head.pos.x", "head.pos.y", "head.pos.z"],
        ["X Pos", "Y Pos", "Z Pos"],
        ["gaze origin x [mm]", "gaze origin y [mm]", "gaze origin z [mm]"],
        ["px", "py", "pz"],
    ],
)
def test_vectors(columns):
    assert list(find_roles(["t", *columns, "other"]).vectors.values()) == [tuple(columns)]


def test_quaternions_and_matrices():
    roles = find_roles([*(f"q{a}" for a in "wxyz"), *(f"QuaternionG{a}" for a in "XYZW")])
    assert roles.quaternions["q*"] == ("qx", "qy", "qz", "qw") and len(roles.quaternions) == 2
    m = [f"ctw_{r}{c}" for r in range(3) for c in range(4)]
    assert find_roles(m[::-1]).matrices == {"ctw": tuple(m)} and find_roles(m[1:]).matrices == {}
    whole = [f"m{r}{c}" for r in range(4) for c in range(4)]
    assert find_roles(whole).matrices == {"": tuple(whole)}


def test_what_is_no_place_has_no_role():
    names = ["velocity", "angular_velocity", "gyro", "gaze_target_pos", "head_scale", "PupilPos"]
    assert find_roles([f"{n}_{a}" for n in names for a in "xyz"]).vectors == {}
    assert find_roles(["gaze_x_px", "gaze_y_px", "a,b", "c=d"]).vectors == {}
    assert find_roles([f"gravity_{a}_world" for a in "xyz"]).gravity == tuple(f"gravity_{a}_world" for a in "xyz")


def test_angles_times_and_people():
    roles = find_roles(
        ["device_timestamp_ns", "timestamp [ns]", "relative time", "left_yaw_rads", "yaw_rads", "pitch_rads", "UserId"]
    )
    assert roles.yaw_pitch_roll == ("yaw_rads", "pitch_rads") and roles.person == "UserId"
    assert roles.times[0] == "timestamp [ns]" and sorted(roles.times[1:]) == ["device_timestamp_ns", "relative time"]
    assert find_roles(["azimuth [deg]", "elevation [deg]"]).azel == ("azimuth [deg]", "elevation [deg]")
    assert find_roles(["duration", "blink"]).times == []


@pytest.mark.parametrize(
    "name, unit",
    [
        ("timestamp [ns]", 1e-9),
        ("time_us", 1e-6),
        ("Time (ms)", 1e-3),
        ("time_s", 1.0),
        ("time", None),
        ("t [h]", None),
    ],
)
def test_units_of_time(name, unit):
    assert time_unit(name) == unit


def test_units_of_angles():
    assert (
        in_degrees(["yaw_deg", "pitch"]) is True and in_degrees(["yaw_rads"]) is False and in_degrees(["yaw"]) is None
    )
