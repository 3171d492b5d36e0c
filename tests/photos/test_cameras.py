"""Rays of cameras: distortion, projection, and agreement with Mitsuba's own camera."""

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.photos.cameras import Camera, Intrinsics, pixel_directions, project, sensor_dict, view_tangents

FOX = Intrinsics(135, 240, 171.94, 171.81, 69.3, 120.7, 0.0578421, -0.0805099, -0.000980296, 0.00015575)


def pose(rng):
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    if np.linalg.det(q) < 0:
        q[:, 0] *= -1
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = q, rng.normal(size=3)
    return m


def test_pixel_rays_project_back_to_their_pixels():
    camera = Camera(FOX, pose(np.random.default_rng(1)))
    d = pixel_directions(FOX) @ camera.to_world[:3, :3].T
    points = camera.center + d.reshape(-1, 3) * np.random.default_rng(2).uniform(0.5, 5, (d.size // 3, 1))
    pixel, front = project(points, camera)
    x, y = np.meshgrid(np.arange(135) + 0.5, np.arange(240) + 0.5)
    assert front.all()
    assert np.allclose(pixel, np.stack([x.ravel(), y.ravel()], axis=1), atol=1e-6)


@pytest.mark.parametrize("fisheye", [False, True])
def test_view_tangents_hold_every_pixel(fisheye):
    i = replace(FOX, fisheye=True, p1=0.0, p2=0.0) if fisheye else FOX
    d = pixel_directions(i)
    x, y = d[..., 0] / -d[..., 2], d[..., 1] / d[..., 2]
    left, right, up, down = view_tangents(i)
    # The outermost centres lie half a pixel inside.
    for limit, reached in ((left, -x.min()), (right, x.max()), (up, -y.min()), (down, y.max())):
        assert reached < limit < reached + 0.01
    assert view_tangents(Intrinsics(10, 20, 10.0, 10.0, 4.0, 9.0)) == pytest.approx((0.4, 0.6, 0.9, 1.1))
    assert max(view_tangents(Intrinsics(10, 10, 2.0, 2.0, 5.0, 5.0, fisheye=True))) == pytest.approx(
        np.tan(np.radians(85))
    )


def test_points_behind_a_camera_are_not_in_front():
    camera = Camera(FOX, np.eye(4))
    assert not project(np.array([[0.0, 0.0, 1.0]]), camera)[1][0]
    assert project(np.array([[0.0, 0.0, -1.0]]), camera)[1][0]


def test_a_fisheye_shows_points_behind_its_plane():
    camera = Camera(Intrinsics(64, 64, 16.0, 16.0, 32.0, 32.0, fisheye=True), np.eye(4))
    pixel, shown = project(np.array([[1.0, 0.0, 0.1]]), camera)
    assert shown[0] and np.allclose(pixel, [[32 + 16 * np.arctan2(1, -0.1), 32]])


def test_mitsuba_sensor_sends_the_same_rays(rgb):
    """Principal point off the centre, no square picture."""
    i = Intrinsics(32, 20, 25.0, 25.0, 14.0, 11.5)
    camera = Camera(i, pose(np.random.default_rng(3)))
    sensor = rgb.load_dict(sensor_dict(camera))
    x, y = np.meshgrid((np.arange(32) + 0.5) / 32, (np.arange(20) + 0.5) / 20)
    ray, _ = sensor.sample_ray(0.0, 0.5, rgb.Point2f(x.ravel(), y.ravel()), rgb.Point2f(0.5, 0.5))
    expected = (pixel_directions(i) @ camera.to_world[:3, :3].T).reshape(-1, 3)
    assert np.allclose(ray.d.numpy().T, expected, atol=2e-5)


def test_sensor_refuses_what_it_cannot_express():
    with pytest.raises(ValueError, match="distortion"):
        sensor_dict(Camera(FOX, np.eye(4)))
    with pytest.raises(ValueError, match="fisheye"):
        sensor_dict(Camera(Intrinsics(8, 8, 10.0, 10.0, 4.0, 4.0, fisheye=True), np.eye(4)))
    with pytest.raises(ValueError, match="square pixels"):
        sensor_dict(Camera(Intrinsics(8, 8, 10.0, 11.0, 4.0, 4.0), np.eye(4)))
