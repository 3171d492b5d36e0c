"""Tests of `nerg_mi.photos.cameras`."""

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.photos import cameras
from nerg_mi.photos.cameras import (
    Intrinsics,
    PosedCamera,
    find_view_tangents,
    make_area_weights,
    make_sensor_dict,
    pixel_directions,
    pixel_grid,
    project,
    resize_by_area,
    resize_mask,
    resize_nearest,
)
from tests.reference import opencv

# ---- Camera rays: distortion, projection, and agreement with Mitsuba's camera ----

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
    camera = PosedCamera(FOX, pose(np.random.default_rng(1)))
    d = pixel_directions(FOX) @ camera.to_world[:3, :3].T
    points = camera.center + d.reshape(-1, 3) * np.random.default_rng(2).uniform(0.5, 5, (d.size // 3, 1))
    pixel, front = project(points, camera)
    x, y = np.meshgrid(np.arange(135) + 0.5, np.arange(240) + 0.5)
    assert front.all()
    assert np.allclose(pixel, np.stack([x.ravel(), y.ravel()], axis=1), atol=1e-6)


@pytest.mark.parametrize("fisheye", [False, True])
def test_view_tangents_contain_every_pixel(fisheye):
    i = replace(FOX, fisheye=True, p1=0.0, p2=0.0) if fisheye else FOX
    d = pixel_directions(i)
    x, y = d[..., 0] / -d[..., 2], d[..., 1] / d[..., 2]
    left, right, up, down = find_view_tangents(i)
    # The outermost pixel centres are half a pixel inside.
    for limit, reached in ((left, -x.min()), (right, x.max()), (up, -y.min()), (down, y.max())):
        assert reached < limit < reached + 0.01
    assert find_view_tangents(Intrinsics(10, 20, 10.0, 10.0, 4.0, 9.0)) == pytest.approx((0.4, 0.6, 0.9, 1.1))
    assert max(find_view_tangents(Intrinsics(10, 10, 2.0, 2.0, 5.0, 5.0, fisheye=True))) == pytest.approx(
        np.tan(np.radians(85))
    )


def test_points_behind_a_camera_are_not_in_front():
    camera = PosedCamera(FOX, np.eye(4))
    assert not project(np.array([[0.0, 0.0, 1.0]]), camera)[1][0]
    assert project(np.array([[0.0, 0.0, -1.0]]), camera)[1][0]


def test_a_fisheye_shows_points_behind_its_plane():
    camera = PosedCamera(Intrinsics(64, 64, 16.0, 16.0, 32.0, 32.0, fisheye=True), np.eye(4))
    pixel, shown = project(np.array([[1.0, 0.0, 0.1]]), camera)
    assert shown[0] and np.allclose(pixel, [[32 + 16 * np.arctan2(1, -0.1), 32]])


def test_mitsuba_sensor_has_same_rays(rgb):
    """With an off-centre principal point and a non-square image."""
    i = Intrinsics(32, 20, 25.0, 25.0, 14.0, 11.5)
    camera = PosedCamera(i, pose(np.random.default_rng(3)))
    sensor = rgb.load_dict(make_sensor_dict(camera))
    x, y = np.meshgrid((np.arange(32) + 0.5) / 32, (np.arange(20) + 0.5) / 20)
    ray, _ = sensor.sample_ray(0.0, 0.5, rgb.Point2f(x.ravel(), y.ravel()), rgb.Point2f(0.5, 0.5))
    expected = (pixel_directions(i) @ camera.to_world[:3, :3].T).reshape(-1, 3)
    assert np.allclose(ray.d.numpy().T, expected, atol=2e-5)


def test_sensor_refuses_unsupported_cameras():
    with pytest.raises(ValueError, match="distortion"):
        make_sensor_dict(PosedCamera(FOX, np.eye(4)))
    with pytest.raises(ValueError, match="fisheye"):
        make_sensor_dict(PosedCamera(Intrinsics(8, 8, 10.0, 10.0, 4.0, 4.0, fisheye=True), np.eye(4)))
    with pytest.raises(ValueError, match="square pixels"):
        make_sensor_dict(PosedCamera(Intrinsics(8, 8, 10.0, 11.0, 4.0, 4.0), np.eye(4)))


# ---- Lenses for other image sizes ----


def test_resized_image_has_same_lens():
    lens = Intrinsics(40, 20, 30.0, 31.0, 19.0, 11.0, 0.1, p2=0.01)
    half = lens.resized(20, 5)
    assert (half.width, half.height, half.fx, half.fy, half.cx, half.cy) == (20, 5, 15.0, 7.75, 9.5, 2.75)
    assert half.distortion == lens.distortion and half.resized(40, 20) == lens


def test_is_distorted():
    plain = Intrinsics(4, 4, 3.0, 3.0, 2.0, 2.0)
    assert not plain.is_distorted and plain.distortion == (0.0,) * 8
    assert Intrinsics(4, 4, 3.0, 3.0, 2.0, 2.0, k6=1e-3).is_distorted
    assert Intrinsics(4, 4, 3.0, 3.0, 2.0, 2.0, fisheye=True).is_distorted


# ---- Lens models compared with a reference implementation of OpenCV, and their inverses ----

LENSES = {
    "fox": FOX,
    "strong": replace(FOX, k1=-0.2, k2=0.05, p1=0.002, p2=-0.003),
    "rational": replace(FOX, k1=0.4, k2=0.1, k3=0.02, k4=0.5, k5=0.05, k6=0.01),
    "six": replace(FOX, k3=0.03),
    "plain": Intrinsics(135, 240, 171.94, 171.81, 69.3, 120.7),
    "fisheye": Intrinsics(160, 120, 60.0, 61.0, 81.0, 59.0, 0.03, -0.01, k3=0.002, k4=-0.0004, fisheye=True),
    "wide": Intrinsics(160, 160, 45.0, 45.0, 80.0, 80.0, 0.01, -0.002, fisheye=True),
}


def arguments(i):
    """Arguments of the reference implementation, which counts pixels from the centre of the first pixel."""
    k = (i.k1, i.k2, i.k3, i.k4) if i.fisheye else i.distortion
    return i.fx, i.fy, i.cx - 0.5, i.cy - 0.5, k


@pytest.mark.parametrize("name", LENSES)
def test_directions_equal_opencv(name):
    i = LENSES[name]
    inverse = opencv.fisheye_undistort if i.fisheye else opencv.undistort
    ours = pixel_directions(i) * [1, -1, -1]
    for v in range(0, i.height, 17):
        for u in range(0, i.width, 13):
            expected = inverse(u, v, *arguments(i))
            assert np.allclose(ours[v, u], expected / np.linalg.norm(expected), atol=1e-9), (u, v)


@pytest.mark.parametrize("name", LENSES)
def test_image_coordinates_equal_opencv(name):
    i = LENSES[name]
    rng = np.random.default_rng(0)
    d = np.concatenate([rng.uniform(-0.5, 0.5, (50, 2)), np.ones((50, 1))], axis=1) * rng.uniform(0.3, 3, (50, 1))
    if i.fisheye:
        d[:10, 2] *= -1
    xy, shown = cameras.directions_to_image(d, i)
    expected = (opencv.fisheye_project if i.fisheye else opencv.project)(d, *arguments(i)) + 0.5
    assert np.allclose((xy * [i.fx, i.fy] + [i.cx, i.cy])[shown], expected[shown], atol=1e-9)
    assert shown[10:].all()


@pytest.mark.parametrize("name", LENSES)
def test_rays_project_back_to_their_pixels(name):
    i = LENSES[name]
    xy = pixel_grid(i)
    back, shown = cameras.directions_to_image(cameras.image_to_directions(xy, i), i)
    assert shown.all() and np.allclose(back, xy, atol=1e-9)


def test_folding_distortion_is_refused():
    """Also if Newton's method finds a solution beyond the fold."""
    folds = Intrinsics(10, 10, 5.0, 5.0, 5.0, 5.0, -0.5)
    with pytest.raises(ValueError, match="k1=-0.5 cannot be inverted"):
        cameras.undistort(np.array([[1.5, 1.5]]), folds)
    with pytest.raises(ValueError, match="cannot be inverted"):
        pixel_directions(folds)


def test_fisheye_ends_at_maximum_of_polynomial():
    """1 - 3 k θ² = 0 at θ = 1: radius 2/3."""
    i = Intrinsics(10, 10, 5.0, 5.0, 5.0, 5.0, -1 / 3, fisheye=True)
    angle, radius = cameras.find_fisheye_limit(i)
    assert angle == pytest.approx(1, abs=1e-3) and radius == pytest.approx(2 / 3, abs=1e-5)
    assert cameras.find_fisheye_limit(replace(i, k1=0.0)) == pytest.approx((np.pi, np.pi))
    assert not cameras.directions_to_image(np.array([1.0, 0, -1.0]), i)[1]


def test_directions_beyond_fold_are_invisible():
    """r (1 - r²/3) turns at r = 1; without the limit, the model would map r = 1.7 near the centre."""
    i = Intrinsics(10, 10, 5.0, 5.0, 5.0, 5.0, -1 / 3)
    assert cameras.find_pinhole_limit(i) == pytest.approx(1)
    assert np.array_equal(
        cameras.directions_to_image(np.array([[0.99, 0, 1], [1.01, 0, 1], [1.7, 0, 1]]), i)[1], [True, False, False]
    )
    assert cameras.find_pinhole_limit(LENSES["plain"]) == np.inf
    # A pole of the rational model: 1 - t/4.
    assert cameras.find_pinhole_limit(replace(i, k1=0.0, k4=-0.25)) == pytest.approx(4)


# ---- Resized images, compared with sums over the pixels that each new pixel covers ----


def average_reference(image, width, height):
    """Average over an image of sub-pixels that divide both old and new pixels."""
    h, w, c = image.shape
    fine = image.repeat(height, axis=0).repeat(width, axis=1)
    return fine.reshape(height, h, width, w, c).mean(axis=(1, 3))


@pytest.mark.parametrize("size", [(3, 2), (5, 4), (7, 6), (1, 1)])
def test_areas_are_averaged(size):
    image = np.random.default_rng(0).random((6, 7, 3)).astype(np.float32)
    assert np.allclose(resize_by_area(image, *size), average_reference(image, *size), atol=1e-6)


def test_colours_are_weighted_by_alpha():
    image = np.zeros((1, 2, 4), np.float32)
    image[0, 0], image[0, 1] = (1, 0.5, 0, 0.25), (0, 0, 1, 0.75)
    assert np.allclose(resize_by_area(image, 1, 1)[0, 0], [0.25, 0.125, 0.75, 0.5])
    assert np.all(resize_by_area(image * [1, 1, 1, 0], 1, 1) == 0)


def test_area_weights_preserve_total():
    shares = make_area_weights(7, 3).toarray()
    assert np.allclose(shares.sum(axis=1), 1) and np.allclose(shares.sum(axis=0), 3 / 7)


def test_nearest_value_is_at_centre():
    values = np.arange(12.0).reshape(3, 4)
    assert np.array_equal(resize_nearest(values, 2, 1), [[5, 7]]) and np.array_equal(
        resize_nearest(values, 4, 3), values
    )


def test_resized_mask_needs_all_pixels():
    mask = np.ones((4, 4), bool)
    mask[1, 2] = False
    assert np.array_equal(resize_mask(mask, 2, 2), [[True, False], [True, True]])
    assert resize_mask(mask, 4, 4) is mask
