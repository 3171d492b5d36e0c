"""The mapping of a full-sphere picture: closed forms and round trips."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.transport.geometry import direction_pixels, pixel_directions, pixel_solid_angles

SIZES = [(1, 2), (2, 3), (16, 8), (33, 17), (256, 128)]


@pytest.mark.parametrize("width, height", SIZES)
def test01_solid_angles_sum_to_the_sphere(width, height):
    ω = pixel_solid_angles(width, height)
    assert ω.shape == (height, width) and (ω > 0).all()
    assert np.isclose(ω.sum(), 4 * np.pi, rtol=1e-13)


def test02_integrals_over_the_sphere():
    # ∫ z² dω = 4π/3, and the integral of a direction is zero
    v, ω = pixel_directions(256, 128), pixel_solid_angles(256, 128)
    assert np.allclose((v**2 * ω[..., None]).sum((0, 1)), 4 * np.pi / 3, rtol=1e-3)
    assert np.allclose((v * ω[..., None]).sum((0, 1)), 0, atol=1e-12)


@pytest.mark.parametrize("width, height", [(3, 4), (16, 8), (33, 17)])
def test03_directions_and_pixels_are_inverse(width, height):
    v = pixel_directions(width, height)
    assert np.allclose(np.linalg.norm(v, axis=-1), 1)
    xy = direction_pixels(3 * v[1:-1], width, height)  # at the poles the longitude is lost
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(1, height - 1) + 0.5)
    assert np.allclose(xy, np.stack([x, y], -1), atol=1e-9)
    random = np.random.default_rng(1).normal(size=(100, 3))
    assert (direction_pixels(random, width, height) >= 0).all()


def test04_axes():
    # up is the first row, +Z the middle column
    assert np.allclose(direction_pixels([0, 1, 0], 8, 5)[1], 0.5)
    assert np.allclose(direction_pixels([0, 0, 1], 8, 5), [4, 2.5])
    assert np.allclose(direction_pixels([1, 0, 0], 8, 5), [2, 2.5])


def test05_too_small():
    with pytest.raises(NergError, match="at least 1 x 2 pixels"):
        pixel_solid_angles(4, 1)
