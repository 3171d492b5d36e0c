"""Where points lie in a picture, against a pinhole written down by hand."""

import numpy as np
import pytest

from nerg_mi.rendering.scene_writer import pixel_of


@pytest.fixture
def camera(rgb):
    return rgb.load_dict(
        {
            "type": "perspective",
            "fov": 60,
            "fov_axis": "x",
            "to_world": rgb.ScalarTransform4f().look_at([1, -4, 2], [0, 0, 1], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 30, "height": 20},
        }
    )


def test_pixels_of_points(rgb, camera):
    origin, ahead = np.array([1.0, -4, 2]), np.array([-1.0, 4, -1])
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    for point in ((0, 0, 1), (0.5, 0.2, 1.4), (-1, 1, 0.5)):
        x, y, z = (np.subtract(point, origin) @ v for v in (right, up, ahead))
        focal = 15 / np.tan(np.radians(30))
        wanted = 15 + focal * x / z - 0.5, 10 - focal * y / z - 0.5
        np.testing.assert_allclose(pixel_of(camera, rgb.Point3f(*point)), wanted, atol=1e-3)


def test_what_is_not_in_the_picture(rgb, camera):
    assert pixel_of(camera, rgb.Point3f(2, -8, 3)) is None  # behind
    assert pixel_of(camera, rgb.Point3f(20, 0, 1)) is None  # beside
