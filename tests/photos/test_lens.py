"""Lens models against OpenCV's, restated; and their inverses."""

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.photos import cameras
from nerg_mi.photos.cameras import Intrinsics, pixel_directions, pixel_grid
from tests.reference import opencv

FOX = Intrinsics(135, 240, 171.94, 171.81, 69.3, 120.7, 0.0578421, -0.0805099, -0.000980296, 0.00015575)
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
    """Of the restated model, which counts pixels from the first one's centre."""
    k = (i.k1, i.k2, i.k3, i.k4) if i.fisheye else i.distortion
    return i.fx, i.fy, i.cx - 0.5, i.cy - 0.5, k


@pytest.mark.parametrize("name", LENSES)
def test_rays_of_pixels_equal_opencvs(name):
    i = LENSES[name]
    inverse = opencv.fisheye_undistort if i.fisheye else opencv.undistort
    ours = pixel_directions(i) * [1, -1, -1]
    for v in range(0, i.height, 17):
        for u in range(0, i.width, 13):
            expected = inverse(u, v, *arguments(i))
            assert np.allclose(ours[v, u], expected / np.linalg.norm(expected), atol=1e-9), (u, v)


@pytest.mark.parametrize("name", LENSES)
def test_images_of_directions_equal_opencvs(name):
    i = LENSES[name]
    rng = np.random.default_rng(0)
    d = np.concatenate([rng.uniform(-0.5, 0.5, (50, 2)), np.ones((50, 1))], axis=1) * rng.uniform(0.3, 3, (50, 1))
    if i.fisheye:
        d[:10, 2] *= -1
    xy, shown = cameras.image(d, i)
    expected = (opencv.fisheye_project if i.fisheye else opencv.project)(d, *arguments(i)) + 0.5
    assert np.allclose((xy * [i.fx, i.fy] + [i.cx, i.cy])[shown], expected[shown], atol=1e-9)
    assert shown[10:].all()


@pytest.mark.parametrize("name", LENSES)
def test_rays_project_back_to_their_pixels(name):
    i = LENSES[name]
    xy = pixel_grid(i)
    back, shown = cameras.image(cameras.rays(xy, i), i)
    assert shown.all() and np.allclose(back, xy, atol=1e-9)


def test_folding_distortion_is_refused():
    """Also where Newton's iteration finds a point: past the fold, with the same image."""
    folds = Intrinsics(10, 10, 5.0, 5.0, 5.0, 5.0, -0.5)
    with pytest.raises(ValueError, match="k1=-0.5 cannot be inverted"):
        cameras.undistort(np.array([[1.5, 1.5]]), folds)
    with pytest.raises(ValueError, match="cannot be inverted"):
        pixel_directions(folds)


def test_a_fisheye_ends_where_its_polynomial_turns():
    """1 - 3 k θ² = 0 at θ = 1: radius 2/3."""
    i = Intrinsics(10, 10, 5.0, 5.0, 5.0, 5.0, -1 / 3, fisheye=True)
    angle, radius = cameras.fisheye_limit(i)
    assert angle == pytest.approx(1, abs=1e-3) and radius == pytest.approx(2 / 3, abs=1e-5)
    assert cameras.fisheye_limit(replace(i, k1=0.0)) == pytest.approx((np.pi, np.pi))
    assert not cameras.image(np.array([1.0, 0, -1.0]), i)[1]


def test_what_lies_beyond_the_fold_of_a_pinhole_lens_is_not_shown():
    """r (1 - r²/3) turns at r = 1; the model alone would put a point at r = 1.7 near the centre."""
    i = Intrinsics(10, 10, 5.0, 5.0, 5.0, 5.0, -1 / 3)
    assert cameras.pinhole_limit(i) == pytest.approx(1)
    assert np.array_equal(
        cameras.image(np.array([[0.99, 0, 1], [1.01, 0, 1], [1.7, 0, 1]]), i)[1], [True, False, False]
    )
    assert cameras.pinhole_limit(LENSES["plain"]) == np.inf
    # A pole of the rational model: 1 - t/4.
    assert cameras.pinhole_limit(replace(i, k1=0.0, k4=-0.25)) == pytest.approx(4)
