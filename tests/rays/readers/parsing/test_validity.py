"""Names of columns of validity, and what their values mean."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.columns import (
    is_validity,
    looks_like_validity,
    mark_valid,
    parse_valid,
    require_valid_values,
    valid_values,
)


@pytest.mark.parametrize(
    "name",
    "isValid IsGazeValid GazeValidity gaze_is_valid valid Status GazeStatus gaze_status tracking_state "
    "combinedGazeValid eye_tracked gazeRay.isValid validity_flag IsEyeTrackingEnabledAndValid HasValidGaze".split(),
)
def test_names_of_validity(name):
    assert is_validity(name) and looks_like_validity(name)


@pytest.mark.parametrize(
    "name",
    "left_valid RightEyeValidity left_eye_data_validata_bit_mask calibration_is_valid "
    "blink eye_detected GazeAvailable gaze.lost left_tracked".split(),
)
def test_names_of_another_validity(name):
    assert not is_validity(name) and looks_like_validity(name)


@pytest.mark.parametrize("name", "state trial_status time statusbar gaze_dir_x blinks_per_minute".split())
def test_names_of_none(name):
    assert not is_validity(name) and not looks_like_validity(name)


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
        ("status", ["0", "1", "2"], None),  # of no device that is named
        ("isValid", ["1", "-1"], None),
        ("isValid", ["+1", " 0"], ["+1"]),
        ("valid", ["0", "1", "4"], None),  # of some trackers 0 is the best
        ("status", ["good", "valid"], None),
    ],
)
def test_what_values_mean(name, values, valid):
    assert valid_values(name, values) == valid


def test_values_without_a_certain_meaning_are_named():
    with pytest.raises(NergError, match="'status'.*3.*90.*4.*--valid"):
        require_valid_values("a.csv", "status", {"": 4, "3": 90})


def test_values_that_are_named():
    assert parse_valid(None) is None and parse_valid("none") == {}
    assert parse_valid('"gaze status=2" isValid=true,1') == {"gaze status": ("2",), "isValid": ("true", "1")}
    for text in ("", "status", "status=", "=2", '"status=2'):
        with pytest.raises(NergError, match="--valid is"):
            parse_valid(text)
    assert mark_valid(np.array(["2", "2.0", "True", "3"]), ["2", "true"]).tolist() == [True, True, True, False]
