"""The observer's sphere as a map: where its parts lie, and that each map shows what the panorama has."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Heat
from nerg_mi.figures.sphere import sphere_figure
from nerg_mi.figures.style import encode
from nerg_mi.transport.geometry import pixel_directions

HEIGHT, WIDTH = 90, 180
BLACK, NOBODY = np.zeros((HEIGHT, WIDTH, 3)), np.zeros((HEIGHT, WIDTH))
ALL = np.ones((HEIGHT, WIDTH), bool)
HEAT = Heat(top=1.0, ramp=1e-6, opacity=1.0)


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
def test_where_directions_lie(projection, direction, place):
    figure = sphere_figure(BLACK, spot(direction), ALL, HEAT, projection=projection)
    (image,) = figure.axes[0].images
    assert tuple(image.get_extent()) == (-1, 1, -1, 1)
    bright = image.get_array()[..., 0] > 0.5
    paper = image.get_array().min(axis=-1) > 0.99
    y, x = np.nonzero(bright & ~paper)
    found = (
        (x.mean() + 0.5) / image.get_array().shape[1] * 2 - 1,
        1 - 2 * (y.mean() + 0.5) / image.get_array().shape[0],
    )
    assert found == pytest.approx(place, abs=0.08)


def test_hatched_where_nothing_is_known():
    unknown = ALL & (np.arange(HEIGHT)[:, None] < HEIGHT // 2)
    plain = sphere_figure(BLACK, NOBODY, ALL, HEAT, projection="mollweide")
    hatched = sphere_figure(BLACK, NOBODY, ALL, HEAT, projection="mollweide", unknown=unknown)
    a, b = (f.axes[0].images[0].get_array() for f in (plain, hatched))
    differ = np.any(a != b, axis=-1)
    inside = a.max(axis=-1) < 0.99
    np.testing.assert_array_equal(differ, inside & (np.arange(HEIGHT)[:, None] < HEIGHT // 2))
    assert "no data" in [t.get_text() for axes in hatched.axes for t in axes.texts]


def test_equal_input_equal_file():
    made = [encode(sphere_figure(BLACK, spot((1, 1, 1)), ALL, HEAT), ".png", {"Comment": "seed 1"}) for _ in range(2)]
    assert made[0] == made[1] and b"seed 1" in made[0]


def test_a_map_that_is_not_there():
    with pytest.raises(NergError, match='"mercator"'):
        sphere_figure(BLACK, NOBODY, ALL, HEAT, projection="mercator")
