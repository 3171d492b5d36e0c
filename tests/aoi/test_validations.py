"""Tests of `nerg_mi.aoi.validations`: tables of all programs, sessions and invalid tables."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.aoi.validations import Validation, read_validation
from nerg_mi.errors import NergError

TOBII = "Recording timestamp\tParticipant name\tAverage calibration accuracy (degrees)\t" + "\t".join(
    f"Average validation {what} ({unit})" for unit in ("mm", "degrees") for what in ("accuracy", "precision SD")
)


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("own.csv", "participant,accuracy,precision\nann,3,0\nann,1,0.2\n", {"ann": (2.0, 0.1)}),
        ("quality.csv", "person,std,accuracy\na,0.2,1\nb,,1\nc,0.2,\n", {"a": (1.0, 0.2), "b": (1.0, np.nan)}),
        ("names.csv", "User ID,Accuracy [deg]\n7.0,1\n", {"7": (1.0, np.nan)}),
        (
            "etdq.csv",
            "file,eye,target_id,accuracy,rms_s2s,std,bcea\nann.tsv,left,1,0.5,9,0.1,9\nann.tsv,right,1,1.5,9,0.3,9\n",
            {"ann": (1.0, 0.2)},
        ),
        (
            "dataQuality.tsv",
            "recording\tmarker_interval\ttype\ttarget\torder\tacc_x\tacc_y\tacc\trms\tstd_x\tstd\n"
            "P1\t1\tpose_vidpos_ray\t1\t1\t-9\t9\t1.5\t9\t9\t0.2\nP1\t1\tpose_vidpos_ray\t2\t2\t9\t9\tnan\tnan\tnan\tnan\n",
            {"P1": (1.5, 0.2)},
        ),
        (
            "tobii.tsv",
            TOBII + "\n1\tAnn\t9\t5\t2\t0,5\t0,2\n2\tAnn\t9\t5\t2\t0,5\t0,2\n1\tBo\t9\t\t\t\t\n",
            {"Ann": (0.5, 0.2)},
        ),
        (
            "titta.csv",
            ",pid,accuracy_left_eye (deg),accuracy_right_eye (deg),RMS_S2S_left_eye (deg),RMS_S2S_right_eye (deg),"
            "SD_left_eye (deg),SD_right_eye (deg)\n0,s1,0.4,0.6,9,9,0.1,0.3\n1,s2,0.7,,9,,0.1,\n",
            {"s1": (0.5, 0.2), "s2": (0.7, 0.1)},
        ),
    ],
)
def test_tables_of_programs(tmp_path, name, text, expected):
    (tmp_path / name).write_text(text)
    validations = read_validation(tmp_path / name)
    assert list(validations) == list(expected)
    for person, (accuracy, precision) in expected.items():
        (validation,) = validations[person]
        assert validation.start == 0 and validation.accuracy == pytest.approx(accuracy)
        assert validation.precision == pytest.approx(precision, nan_ok=True)


def test_a_start_tells_sessions_apart(tmp_path):
    file = tmp_path / "quality.csv"
    file.write_text("participant,start,std,accuracy\na,12.5,0.2,1\na,900,0.4,2\na,900,0.2,4\n")
    assert read_validation(file) == {"a": [Validation(12.5, 1.0, 0.2), Validation(900.0, 3.0, pytest.approx(0.3))]}


@pytest.mark.parametrize(
    "text",
    [
        "person,accuracy,precision\np,21,0\n",
        "person,accuracy,precision\np,-1,0\n",
        "person,precision\na,1\n",
        "person,accuracy\na,\n",
        "person,start,accuracy\na,,1\n",
        "Participant name,Average calibration accuracy (degrees)\na,1\n",
        "accuracy,std\n1,1\n",
        "",
    ],
)
def test_invalid_tables_are_refused(tmp_path, text):
    (tmp_path / "errors.csv").write_text(text)
    with pytest.raises(NergError):
        read_validation(tmp_path / "errors.csv")
