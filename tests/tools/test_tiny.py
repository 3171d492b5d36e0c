"""Places that are small enough to be worked on thousands of times."""

from __future__ import annotations

import json

import numpy as np
import pytest

from nerg_mi.capture.dataset import open_dataset
from tools import tiny


def test_the_ball_is_where_its_camera_looks():
    pose = tiny.ball_pose(np.array([2.0, 0.5, 0.3]))
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3)) and np.linalg.det(pose[:3, :3]) > 0
    photo = tiny.ball_photo(pose)
    middle = tiny.SIDE // 2
    assert photo.shape == (tiny.SIDE, tiny.SIDE, 4) and photo[middle, middle, 3] == 1 and photo[0, 0, 3] == 0
    # Its colour is its normal, and the middle of the picture sees the point nearest to the camera.
    normal = pose[:3, 3] / np.linalg.norm(pose[:3, 3])
    assert photo[middle, middle, :3] == pytest.approx(0.5 + 0.4 * normal, abs=0.05)


def test_photos_are_a_data_set(tmp_path):
    document = json.loads((tiny.write_photos(tmp_path / "photos", count=3) / "transforms.json").read_text())
    assert len(document["frames"]) == 3 and document["w"] == tiny.SIDE
    dataset = open_dataset(tmp_path / "photos")
    assert len(dataset.train) + len(dataset.held_out) == 3


def test_looks_end_on_the_wall_and_can_be_read_back(tmp_path):
    rays = tiny.looks(50)
    assert np.allclose(rays.hit[:, 0], 1.5) and np.allclose(np.linalg.norm(rays.direction, axis=1), 1)
    lines = tiny.write_tracking(tmp_path / "track.csv", 50).read_text().splitlines()
    assert lines[0] == "t,person,x,y,z,dx,dy,dz" and len(lines) == 51
    first = [float(v) for v in lines[1].split(",")]
    assert first[2:5] == pytest.approx(rays.origin[0], abs=1e-5) and first[5:] == pytest.approx(
        rays.direction[0], abs=1e-5
    )
