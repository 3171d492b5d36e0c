"""Trajectories of Aria's glasses."""

import numpy as np
import pytest

from nerg_mi.rays.readers import aria
from nerg_mi.rays.readers.aria import Trajectory, poses_at, up_axis
from tests.rays.readers.examples import ARIA_POSES, aria_pose, lines


def write(path, row, count=50):
    path.write_text(lines(ARIA_POSES, row, count=count))
    return path


def test_poses_around_the_times_are_kept_and_no_others(tmp_path):
    path = write(tmp_path / "t.csv", lambda k: aria_pose(1000 * k, place=(k, 2 * k, 1.6)), count=1000)
    found = Trajectory(path, np.array([0.0205, np.nan, 0.4]), None)
    track = found.tracks["w"]
    assert found.lines == 1000 and len(track.times) < 10 and found.up("w") == "z"
    _, place, lost = poses_at(track, np.array([0.0205, 0.4]), 0.05)
    assert np.allclose(place, [[20.5, 41, 1.6], [400, 800, 1.6]]) and not lost.any()


def test_a_little_outside(tmp_path):
    track = Trajectory(write(tmp_path / "t.csv", lambda k: aria_pose(1000 * k)), np.array([0.01]), None).tracks["w"]
    assert poses_at(track, np.array([-0.0009, -0.0011, 0.0499, 0.0501]), 0.05)[2].tolist() == [False, True, False, True]


def test_up(tmp_path):
    for name, gravity in (("z", (0, 0, -9.81)), ("-y", (0.1, 9.81, 0)), ("x", (-1, 0, 0))):
        assert up_axis(write(tmp_path / "t.csv", lambda k, g=gravity: aria_pose(k, gravity=g))) == name
    write(tmp_path / "t.csv", lambda k: aria_pose(k, gravity=("", "", "")))
    with pytest.raises(ValueError, match="no poses with their gravity"):
        up_axis(tmp_path / "t.csv")


def test_what_is_no_trajectory(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="holds 1 poses; two of one world"):
        Trajectory(write(tmp_path / "t.csv", aria_pose, count=1), np.array([0.0]), None)
    path = write(tmp_path / "t.csv", lambda k: aria_pose(k, gravity=(0, -0.1 * k, -9.81)))
    with pytest.raises(ValueError, match="gravity of the world"):
        Trajectory(path, np.array([0.0]), None)
    monkeypatch.setattr(aria, "_WORLDS", 8)
    with pytest.raises(ValueError, match="more than 8 worlds"):
        Trajectory(write(tmp_path / "t.csv", lambda k: aria_pose(k, world=k)), np.array([0.0]), None)
    still = write(tmp_path / "t.csv", lambda k: aria_pose(k, turn=(0, 0, 0, 0)))
    with pytest.raises(ValueError, match="two of one world"):
        Trajectory(still, np.array([0.0]), None)
