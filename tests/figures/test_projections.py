"""Maps of the sphere against their closed forms, and their areas."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from nerg_mi.errors import NergError
from nerg_mi.figures.sphere import PROJECTIONS, find_projection, resample

RNG = np.random.default_rng(0)
LONGITUDE, LATITUDE = RNG.uniform(-np.pi, np.pi, 200), np.arcsin(RNG.uniform(-1, 1, 200))


@pytest.mark.parametrize("name", PROJECTIONS)
def test_there_and_back(name):
    of = find_projection(name)
    x, y = of.forward(LONGITUDE, LATITUDE)
    longitude, latitude, inside = of.inverse(x, y)
    assert inside.all() and of.summary and of.name == name
    np.testing.assert_allclose(longitude, LONGITUDE, atol=1e-9)
    np.testing.assert_allclose(latitude, LATITUDE, atol=1e-7)


def test_mollweide_against_its_equation():
    """Snyder, p. 249: x = 2√2/π λ cos θ and y = √2 sin θ with 2θ + sin 2θ = π sin φ, here over 2√2 and √2."""
    x, y = PROJECTIONS["mollweide"].forward(LONGITUDE, LATITUDE)
    for λ, φ, a, b in zip(LONGITUDE, LATITUDE, x, y):
        θ = brentq(lambda t, φ=φ: 2 * t + np.sin(2 * t) - np.pi * np.sin(φ), -np.pi / 2, np.pi / 2, xtol=1e-14)
        assert (a, b) == pytest.approx((λ / np.pi * np.cos(θ), np.sin(θ)), abs=1e-9)


def test_mollweide_has_equal_areas():
    """The share of the ellipse that a part of the sphere covers is that part's share of the sphere."""
    side = 1000
    axis = (np.arange(side) + 0.5) / side * 2 - 1
    longitude, latitude, inside = PROJECTIONS["mollweide"].inverse(*np.meshgrid(axis, axis))
    assert inside.mean() == pytest.approx(np.pi / 4, abs=1e-3)
    for low, high, west, east in ((0.2, 0.7, -2.0, -1.0), (-1.5, -1.0, -3.0, 3.0), (0.9, np.pi / 2, 0.0, 1.5)):
        part = inside & (latitude > low) & (latitude < high) & (longitude > west) & (longitude < east)
        wanted = (np.sin(high) - np.sin(low)) * (east - west) / (4 * np.pi)
        assert part.sum() / inside.sum() == pytest.approx(wanted, abs=1e-3)


def test_resampled_pixels_are_the_panoramas():
    height, width = 20, 36
    panorama = np.arange(height * width, dtype=float).reshape(height, width)
    flat, inside = resample(panorama, PROJECTIONS["equirectangular"], width)
    assert flat.shape == (18, 36) and inside.all()
    # Rows of the panorama are nodes from pole to pole, those of the paper are cells.
    rows = np.rint((np.arange(18) + 0.5) / 18 * 19).astype(int)
    np.testing.assert_array_equal(flat, panorama[rows])
    round_, inside = resample(panorama, PROJECTIONS["mollweide"], 200)
    assert round_.shape == (100, 200) and not inside[0, 0] and inside[50, 100]
    assert round_[50, 100] in panorama[9:11, 17:19]


def test_one_that_is_not_there():
    with pytest.raises(NergError, match="no projection"):
        find_projection("Mollweide")
