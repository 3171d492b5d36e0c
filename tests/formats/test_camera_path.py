"""Camera paths of nerfstudio: read, refused, and rendered as frames."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.environment.rendering_files import read_frames
from nerg_mi.errors import NergError
from nerg_mi.formats.camera_path import CameraPath, read_camera_path


def path(count=4):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(np.random.default_rng(0).normal(size=(count, 4))).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(1).normal(size=(count, 3))
    return CameraPath(poses, np.linspace(40, 60, count), 96, 64, 24.0)


def write_camera_path(file, path):
    """Write ``path`` as the viewer of nerfstudio does."""
    frames = [
        {"camera_to_world": pose.ravel().tolist(), "fov": float(fov), "aspect": path.width / path.height}
        for pose, fov in zip(path.to_world, path.fov)
    ]
    size = {"render_width": path.width, "render_height": path.height, "fps": path.fps}
    file.write_text(json.dumps({"camera_type": "perspective", **size, "is_cycle": False, "camera_path": frames}))


def test_a_path_is_read_as_written(tmp_path):
    write_camera_path(tmp_path / "camera_path.json", path())
    again = read_camera_path(tmp_path / "camera_path.json")
    assert np.array_equal(again.to_world, path().to_world) and np.array_equal(again.fov, path().fov)
    assert (again.width, again.height, again.fps) == (96, 64, 24.0)


def test_frames_are_the_cameras_of_the_path(rgb, tmp_path):
    write_camera_path(tmp_path / "camera_path.json", path())
    numbers = lambda text: [float(v) for v in text.split(",")]
    for frame, pose, fov in zip(read_frames(tmp_path / "camera_path.json"), path().to_world, path().fov):
        look_at = rgb.ScalarTransform4d().look_at(*(numbers(frame[name]) for name in ("camera", "target", "up")))
        # Mitsuba's cameras have x to the left and look along +z.
        assert np.allclose(np.array(look_at.matrix) @ np.diag([-1, 1, -1, 1]), pose, atol=1e-7)
        across = np.tan(np.radians(float(frame["fov"])) / 2)
        assert np.isclose(across / np.tan(np.radians(fov) / 2), 1.5)


TRANSPOSED = np.eye(4) + np.eye(4, k=-3)


@pytest.mark.parametrize(
    "change, said",
    [
        ({"camera_type": "fisheye"}, "fisheye"),
        ({"camera_path": []}, "1 to 100,000"),
        ({"camera_path": [{"camera_to_world": np.diag([1.0, 2, 1, 1]).ravel().tolist(), "fov": 50}]}, "rotation"),
        ({"camera_path": [{"camera_to_world": np.diag([-1.0, 1, 1, 1]).ravel().tolist(), "fov": 50}]}, "mirrored"),
        ({"camera_path": [{"camera_to_world": (np.eye(4) + np.eye(4, k=-1)).ravel().tolist(), "fov": 50}]}, "last row"),
        (
            {"camera_path": [{"camera_to_world": m.ravel().tolist(), "fov": 50} for m in (np.eye(4), TRANSPOSED)]},
            "frame 2: it is transposed",
        ),
        ({"camera_path": [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 200}]}, "fov"),
        ({"camera_path": [{"fov": 50}]}, "camera_to_world"),
        ({"render_width": 0}, "render_width"),
    ],
)
def test_other_files_are_refused(tmp_path, change, said):
    write_camera_path(tmp_path / "a.json", path())
    data = json.loads((tmp_path / "a.json").read_text())
    (tmp_path / "a.json").write_text(json.dumps(data | change))
    with pytest.raises(NergError, match=said):
        read_camera_path(tmp_path / "a.json")
