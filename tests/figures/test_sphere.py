"""Tests of `nerg_mi.figures.sphere`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Heat
from nerg_mi.figures.sphere import PROJECTIONS, find_projection, resample_panorama, sphere_figure
from nerg_mi.figures.style import encode, figure_of
from nerg_mi.transport.geometry import pixel_directions

# ---- Projections ----

RNG = np.random.default_rng(0)
LONGITUDE, LATITUDE = RNG.uniform(-np.pi, np.pi, 200), np.arcsin(RNG.uniform(-1, 1, 200))


@pytest.mark.parametrize("name", PROJECTIONS)
def test_projections_round_trip(name):
    index = find_projection(name)
    x, y = index.forward(LONGITUDE, LATITUDE)
    longitude, latitude, inside = index.inverse(x, y)
    assert inside.all() and index.summary and index.name == name
    np.testing.assert_allclose(longitude, LONGITUDE, atol=1e-9)
    np.testing.assert_allclose(latitude, LATITUDE, atol=1e-7)


def test_mollweide_satisfies_its_equation():
    """Snyder, p. 249: x = 2√2/π λ cos θ and y = √2 sin θ with 2θ + sin 2θ = π sin φ, here over 2√2 and √2."""
    x, y = PROJECTIONS["mollweide"].forward(LONGITUDE, LATITUDE)
    for λ, φ, a, b in zip(LONGITUDE, LATITUDE, x, y):
        θ = brentq(lambda t, φ=φ: 2 * t + np.sin(2 * t) - np.pi * np.sin(φ), -np.pi / 2, np.pi / 2, xtol=1e-14)
        assert (a, b) == pytest.approx((λ / np.pi * np.cos(θ), np.sin(θ)), abs=1e-9)


def test_mollweide_has_equal_areas():
    """The area fraction of a part of the sphere equals its fraction of the map."""
    side = 1000
    axis = (np.arange(side) + 0.5) / side * 2 - 1
    longitude, latitude, inside = PROJECTIONS["mollweide"].inverse(*np.meshgrid(axis, axis))
    assert inside.mean() == pytest.approx(np.pi / 4, abs=1e-3)
    for low, high, west, east in ((0.2, 0.7, -2.0, -1.0), (-1.5, -1.0, -3.0, 3.0), (0.9, np.pi / 2, 0.0, 1.5)):
        part = inside & (latitude > low) & (latitude < high) & (longitude > west) & (longitude < east)
        wanted = (np.sin(high) - np.sin(low)) * (east - west) / (4 * np.pi)
        assert part.sum() / inside.sum() == pytest.approx(wanted, abs=1e-3)


def test_resampling_uses_nearest_pixels():
    height, width = 20, 36
    panorama = np.arange(height * width, dtype=float).reshape(height, width)
    flat, inside = resample_panorama(panorama, PROJECTIONS["equirectangular"], width)
    assert flat.shape == (18, 36) and inside.all()
    # Rows of the panorama are nodes from pole to pole, those of the paper are cells.
    rows = np.rint((np.arange(18) + 0.5) / 18 * 19).astype(int)
    np.testing.assert_array_equal(flat, panorama[rows])
    round_, inside = resample_panorama(panorama, PROJECTIONS["mollweide"], 200)
    assert round_.shape == (100, 200) and not inside[0, 0] and inside[50, 100]
    assert round_[50, 100] in panorama[9:11, 17:19]


def test_unknown_projection_is_refused():
    with pytest.raises(NergError, match="unknown projection"):
        find_projection("Mollweide")


# ---- Figure ----

HEIGHT, WIDTH = 90, 180
BLACK, NO_GAZE = np.zeros((HEIGHT, WIDTH, 3)), np.zeros((HEIGHT, WIDTH))
ALL = np.ones((HEIGHT, WIDTH), bool)
HEAT = Heat(vmax=1.0, ramp=1e-6, opacity=1.0)


def spot(direction, half=0.15):
    """1 in a small cap around a direction of the panorama's frame."""
    toward = np.asarray(direction, float) / np.linalg.norm(direction)
    return (pixel_directions(WIDTH, HEIGHT) @ toward > np.cos(half)).astype(float)


@pytest.mark.parametrize("projection", ["mollweide", "equirectangular"])
@pytest.mark.parametrize(
    "direction, place",
    [
        # The frame's +Y is up and the front +Z; what lies to its right is the side of -X (`envmap`'s mapping).
        ((0, 0, 1), (0.0, 0.0)),
        ((-1, 0, 0), (0.5, 0.0)),
        ((1, 0, 0), (-0.5, 0.0)),
        ((0, 1, 0), (0.0, 1.0)),
        ((0, -1, 0), (0.0, -1.0)),
    ],
)
def test_directions_on_the_map(projection, direction, place):
    figure = figure_of(sphere_figure(BLACK, spot(direction), ALL, HEAT, projection=projection))
    (image,) = figure.axes[0].images
    assert tuple(image.get_extent()) == (-1, 1, -1, 1)
    bright = image.get_array()[..., 0] > 0.5
    paper = image.get_array().min(axis=-1) > 0.99
    y, x = np.nonzero(bright & ~paper)
    result = (
        (x.mean() + 0.5) / image.get_array().shape[1] * 2 - 1,
        1 - 2 * (y.mean() + 0.5) / image.get_array().shape[0],
    )
    assert result == pytest.approx(place, abs=0.08)


def test_unknown_pixels_are_hatched():
    unknown = ALL & (np.arange(HEIGHT)[:, None] < HEIGHT // 2)
    plain = figure_of(sphere_figure(BLACK, NO_GAZE, ALL, HEAT, projection="mollweide"))
    hatched = figure_of(sphere_figure(BLACK, NO_GAZE, ALL, HEAT, projection="mollweide", unknown=unknown))
    a, b = (f.axes[0].images[0].get_array() for f in (plain, hatched))
    differ = np.any(a != b, axis=-1)
    inside = a.max(axis=-1) < 0.99
    np.testing.assert_array_equal(differ, inside & (np.arange(HEIGHT)[:, None] < HEIGHT // 2))
    assert "no data" in [t.get_text() for axes in hatched.axes for t in axes.texts]


def test_figures_are_reproducible():
    made = [encode(sphere_figure(BLACK, spot((1, 1, 1)), ALL, HEAT), ".png", {"Comment": "seed 1"}) for _ in range(2)]
    assert made[0] == made[1] and b"seed 1" in made[0]


def test_figure_with_unknown_projection_is_refused():
    with pytest.raises(NergError, match='"mercator"'):
        figure_of(sphere_figure(BLACK, NO_GAZE, ALL, HEAT, projection="mercator"))
