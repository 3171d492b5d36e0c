"""A page's camera: its frame, and the rays of its picture."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.viewer.points import View, heading_of


def test01_the_frame_of_a_page():
    # Ahead along +y, down along -z: as a camera that is held level and looks north.
    turn = Rotation.from_matrix(np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]]))
    x, y, z, w = turn.as_quat()
    camera = SimpleNamespace(
        wxyz=(w, x, y, z), position=(1.0, 2.0, 3.0), fov=0.8, image_width=600, image_height=400, aspect=1.5
    )
    view = View.of_page(camera)
    assert np.allclose(view.ahead, [0, 1, 0]) and np.allclose(view.up, [0, 0, 1])
    assert view.aspect == 1.5 and view.fov == 0.8 and np.allclose(view.origin, [1, 2, 3])


def test02_rays_are_those_of_the_same_mitsuba_sensor(rgb):
    view = View.of((1, 2, 3), (4, 3, 1), (0, 0, 1), 0.9, 1.5)
    sensor = rgb.load_dict(view.camera(30).to_dict())
    height = view.height(30)
    assert height == 20
    columns, rows = np.meshgrid((np.arange(30) + 0.5) / 30, (np.arange(20) + 0.5) / 20)
    at = rgb.Point2f(columns.ravel().astype(np.float32), rows.ravel().astype(np.float32))
    ray, _ = sensor.sample_ray(0.0, 0.5, at, rgb.Point2f(0.5))
    own = view.rays(30, height, np.full((600, 2), 0.5))
    assert np.allclose(own, np.array(ray.d).T, atol=1e-5)


def test03_a_sensor_and_back(rgb):
    view = View.of((1, 2, 3), (4, 3, 1), (0, 0, 1), 0.9, 1.5)
    found = View.of_sensor(rgb.load_dict(view.camera(300).to_dict()))
    for name in ("origin", "ahead", "up", "fov", "aspect"):
        assert np.allclose(getattr(found, name), getattr(view, name), atol=1e-5), name
    assert math.isclose(view.across, math.degrees(2 * math.atan(math.tan(0.45) * 1.5)))


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -1)])
def test04_straight_down_there_is_an_up_all_the_same(up):
    view = View.of((0, 0, 5), (0, 0, 0), up, 0.9, 1.0)
    assert math.isclose(np.linalg.norm(view.up), 1) and abs(view.up @ view.ahead) < 1e-9


def test05_a_heading_is_level():
    for ahead in ((1, 2, -0.7), (0, 0, -1), (0, 0, 1)):
        turn = heading_of(np.array(ahead, float) / np.linalg.norm(ahead), np.array([0.0, 0, 1]))
        assert np.allclose(turn.T @ turn, np.eye(3)) and np.linalg.det(turn) == pytest.approx(1)
        assert np.allclose(turn[:, 2], [0, 0, 1])
