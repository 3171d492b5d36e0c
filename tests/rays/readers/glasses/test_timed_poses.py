"""Poses with times of their own."""

import json

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.scene_glasses import is_timed, read_timed_poses

NAMES = "translation_x translation_y translation_z rotation_x rotation_y rotation_z rotation_w"
CSV = ",".join(["start_timestamp", "end_timestamp", *NAMES.split()]) + "\n"


def test_which_files_have_times(tmp_path):
    names = ("aligned_poses.csv", "camera_pose.json", "poses.p", "transforms.json", "sparse")
    assert [is_timed(tmp_path / n) for n in names] == [True, True, True, False, False]


def test_quaternions_and_vectors_are_the_same(tmp_path):
    half = np.sqrt(0.5)
    a, b = tmp_path / "aligned_poses.csv", tmp_path / "camera_pose.json"
    a.write_text(
        CSV + f"0,0.1,1,2,3,0,0,0,1\n0.1,0.2,4,5,6,0,0,{half},{half}\n0.2,0.3,4,5,6,0,0,0,0\n,,1,1,1,0,0,0,1\n"
    )
    keys = ["start_timestamp", *(f"translation_{k}" for k in "xyz"), *(f"rotation_{k}" for k in "xyz")]
    b.write_text(json.dumps([dict(zip(keys, row)) for row in ([0, 1, 2, 3, 0, 0, 0], [0.1, 4, 5, 6, 0, 0, np.pi / 2])]))
    (one, of_one), (two, of_two) = read_timed_poses(a), read_timed_poses(b)
    assert (of_one, of_two) == (4, 2) and np.array_equal(one.times, [0, 0.1])
    for field in ("times", "vectors", "places"):
        assert np.allclose(getattr(one, field), getattr(two, field))


@pytest.mark.parametrize(
    "name, text, message",
    [
        ("aligned_poses.csv", CSV + "0,1,1,1,1,0,0,0,1\n", "holds 1 poses"),
        ("aligned_poses.csv", "a,b\n1,2\n", "no column start_timestamp"),
        ("camera_pose.json", "{}", "no list of camera poses"),
        ("camera_pose.json", '[{"start_timestamp": 0}]', "no list of camera poses"),
        ("poses.p", "x", "pickle, which may run"),
    ],
)
def test_what_holds_no_poses(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(NergError, match=message):
        read_timed_poses(tmp_path / name)
