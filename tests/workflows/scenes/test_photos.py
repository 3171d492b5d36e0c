"""The camera of a photo, against the pose in its file, in the coordinates in which a field was trained."""

from __future__ import annotations

import json

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import file_sha256
from nerg_mi.workflows.scene_places import camera_of_photo, cameras_of_photos

POSE = np.array([[1, 0, 0, 0.5], [0, 0, -1, -3], [0, 1, 0, 1.2], [0, 0, 0, 1]], float)  # looks along +y, up is +z


@pytest.fixture
def photos(rgb, tmp_path):
    frames = []
    for k in range(3):
        rgb.Bitmap(np.full((20, 30, 3), 99, np.uint8)).write(str(tmp_path / f"p{k}.png"))
        pose = POSE.copy()
        pose[0, 3] += k
        frames.append({"file_path": f"p{k}.png", "transform_matrix": pose.tolist()})
    lens = {"w": 30, "h": 20, "fl_x": 25.0, "fl_y": 25.0, "cx": 12.0, "cy": 10.0}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return tmp_path


@pytest.mark.parametrize("photo", ["1", "p1", "p1.png"])
def test_pose_and_lens(photos, photo):
    found = camera_of_photo(photos, photo, {})
    assert found.name == "p1.png" and not found.bent
    np.testing.assert_allclose(found.eye.origin, [1.5, -3, 1.2])
    np.testing.assert_allclose(found.eye.target - found.eye.origin, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(found.eye.up, [0, 0, 1], atol=1e-12)
    assert found.lens.fov == pytest.approx(np.degrees(2 * np.arctan(15 / 25))) and found.lens.aspect == 1.5
    assert found.lens.offset == pytest.approx((0.1, 0))


def test_coordinates_of_the_training(photos):
    # The field is twice as large as the file, and moved.
    to_file = np.diag([0.5, 0.5, 0.5, 1.0])
    to_file[:3, 3] = -1
    about = {"sha256": file_sha256(photos / "transforms.json"), "to_file": to_file.tolist()}
    found = camera_of_photo(photos, "0", about)
    np.testing.assert_allclose(to_file[:3, :3] @ found.eye.origin + to_file[:3, 3], POSE[:3, 3])
    np.testing.assert_allclose(found.eye.target - found.eye.origin, [0, 1, 0], atol=1e-12)


def test_other_photos(photos):
    with pytest.raises(NergError, match="field was trained"):
        camera_of_photo(photos, "0", {"sha256": "0" * 64})
    for photo in ("3", "p9", "-1"):
        with pytest.raises(NergError, match='--photo.*0.*2.*"p0.png"'):
            camera_of_photo(photos, photo, {})


def test_all_of_them(photos):
    assert [c.name for c in cameras_of_photos(photos, {})] == ["p0.png", "p1.png", "p2.png"]
    assert [c.name for c in cameras_of_photos(photos, {}, most=2)] == ["p0.png", "p2.png"]
    for k, camera in enumerate(cameras_of_photos(photos, {})):
        np.testing.assert_array_equal(camera.eye.origin, camera_of_photo(photos, str(k), {}).eye.origin)
