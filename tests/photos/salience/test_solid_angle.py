"""Solid angles of pixels against closed forms of whole pictures, and against the Jacobian of each lens."""

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.photos import cameras
from nerg_mi.photos.cameras import Intrinsics, pixel_directions
from nerg_mi.photos.salience import pixel_solid_angles

PLAIN = Intrinsics(96, 64, 60.0, 55.0, 44.0, 30.5)
BARREL = replace(PLAIN, k1=-0.15, k2=0.03, p1=0.002, p2=-0.001)
FISHEYE = Intrinsics(96, 64, 40.0, 41.0, 47.0, 31.0, 0.02, -0.004, fisheye=True)


def corner(x, y):
    return np.arctan(x * y / np.sqrt(1 + x * x + y * y))


def test_a_pinholes_pixels_sum_to_its_frustum():
    i = PLAIN
    x, y = (np.array([0, i.width]) - i.cx) / i.fx, (np.array([0, i.height]) - i.cy) / i.fy
    expected = corner(x[1], y[1]) - corner(x[0], y[1]) - corner(x[1], y[0]) + corner(x[0], y[0])
    assert pixel_solid_angles(i).sum() == pytest.approx(expected, rel=1e-12)
    # And pixel by pixel.
    x, y = np.meshgrid((np.arange(97) - i.cx) / i.fx, (np.arange(65) - i.cy) / i.fy)
    f = corner(x, y)
    assert np.allclose(pixel_solid_angles(i), f[1:, 1:] - f[1:, :-1] - f[:-1, 1:] + f[:-1, :-1], rtol=1e-9)


@pytest.mark.parametrize("i", [PLAIN, BARREL, FISHEYE], ids=["pinhole", "barrel", "fisheye"])
def test_the_sum_is_that_of_the_border(i):
    """Between the axis and the border at azimuth φ lie 1 - cos θ(φ) of area for each radian."""
    n = 20000
    u, v = np.linspace(0, i.width, n, endpoint=False), np.linspace(0, i.height, n, endpoint=False)
    edge = np.concatenate(
        [
            np.stack(p, axis=-1)
            for p in ((u, 0 * u), (0 * v + i.width, v), (i.width - u, 0 * u + i.height), (0 * v, i.height - v))
        ]
    )
    d = cameras.rays((edge - [i.cx, i.cy]) / [i.fx, i.fy], i)
    phi, height = np.unwrap(np.arctan2(d[:, 1], d[:, 0])), 1 - d[:, 2]
    turn = np.diff(phi, append=phi[0] + 2 * np.pi)
    expected = np.sum(turn * 0.5 * (height + np.roll(height, -1)))
    assert pixel_solid_angles(i).sum() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("widest", [np.radians(100), np.pi])
def test_a_fisheye_that_ends_within_the_picture_covers_a_cap(widest):
    # θ + k1 θ³ rises as far as θ = (-3 k1)^-1/2; without k1 the whole sphere is in the picture.
    i = Intrinsics(200, 200, 30.0, 30.0, 100.0, 100.0, 0.0 if widest == np.pi else -1 / (3 * widest**2), fisheye=True)
    solid = pixel_solid_angles(i)
    assert solid.sum() == pytest.approx(2 * np.pi * (1 - np.cos(widest)), rel=2e-3)
    assert (solid == 0).any() and (solid >= 0).all()


@pytest.mark.parametrize("i", [PLAIN, BARREL, FISHEYE], ids=["pinhole", "barrel", "fisheye"])
def test_a_pixel_has_the_jacobian_of_its_lens(i):
    fine = i.resized(3 * i.width, 3 * i.height)
    h = 1e-4
    x, y = np.meshgrid(
        (np.arange(fine.width) + 0.5 - fine.cx) / fine.fx, (np.arange(fine.height) + 0.5 - fine.cy) / fine.fy
    )
    ray = lambda dx, dy: cameras.rays(np.stack([x + dx, y + dy], axis=-1), i)
    across = np.cross(ray(h, 0) - ray(-h, 0), ray(0, h) - ray(0, -h)) / (4 * h * h)
    jacobian = np.linalg.norm(across, axis=-1) / (fine.fx * fine.fy)
    assert np.allclose(pixel_solid_angles(fine), jacobian, rtol=5e-4)
    if i is PLAIN:
        cos = -pixel_directions(fine)[..., 2]
        assert np.allclose(jacobian, cos**3 / (fine.fx * fine.fy), rtol=1e-6)
