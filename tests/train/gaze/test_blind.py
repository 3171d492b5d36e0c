"""The blind density: of rays by person or by ray, and put together from views."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import look_up, table_directions
from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.photos.salience import pixel_solid_angles
from nerg_mi.rays.rays import Rays
from nerg_mi.train.gaze_data import blind_of_rays, blind_of_views
from nerg_mi.train.geometry import GazePlace

from .looks import BOX
from .views import LENS, around, view


def test_the_blind_density_counts_people_or_rays():
    """Nine rays of one person, one of another, elsewhere: the ratio of the kernels' peaks."""
    direction = np.array(9 * [[1.0, 0, 0]] + [[0, 1.0, 0]])
    rays = Rays(np.arange(10.0), np.array(9 * [0] + [1]), ("a", "b"), np.zeros((10, 3)), direction, np.ones(10))
    for weights, ratio in (("equal", 9), ("person", 1)):
        table = np.exp(blind_of_rays(rays, 64, weights=weights).astype(np.float64).ravel())
        x, y = (table[np.argmax(table_directions(64) @ d)] for d in ((1, 0, 0), (0, 1, 0)))
        tail = np.exp(-10.0)  # of the other kernel, at a right angle
        expected = (ratio + tail) / (1 + ratio * tail)
        assert x / y == pytest.approx(expected, rel=0.02), weights


def test_kernels_that_the_table_cannot_show_are_refused():
    """Of one much narrower than a texel nothing would be left but the uniform part."""
    rays = Rays(np.arange(3.0), np.zeros(3), ("a",), np.zeros((3, 3)), np.tile([0.6, 0.0, 0.8], (3, 1)), np.ones(3))
    assert np.exp(blind_of_rays(rays, 64, kappa=400.0)).max() > 40  # 1/sr; its peak is 400 / 2π
    with pytest.raises(NergError, match="64.*1660"):
        blind_of_rays(rays, 64, kappa=1700.0)


def test_it_is_in_the_frame_of_the_place():
    """Everybody looks along x, which is y in a place that lies a quarter turn from the rays."""
    direction = np.tile([1.0, 0, 0], (10, 1))
    rays = Rays(np.arange(10.0), np.zeros(10), ("a",), np.zeros((10, 3)), direction, np.ones(10))
    turned = GazePlace(None, BOX, "none", align=Similarity([[0, -3, 0, 1], [3, 0, 0, 2], [0, 0, 3, 0], [0, 0, 0, 1]]))
    for place, towards in ((None, (1, 0, 0)), (turned, (0, 1, 0))):
        peak = table_directions(32)[np.argmax(blind_of_rays(rays, 32, place).ravel())]
        assert peak @ towards > 0.99


def test_a_blind_law_is_put_together_from_its_parts():
    """No view shows more than a sixth of the sphere; the law does not depend on the position."""
    law = lambda p, d: np.exp(1.5 * d[:, 0] - 4 * (d[:, 2] + 0.1) ** 2)
    table = blind_of_views(around(60, density=law), 24)
    ns, d = namespace("llvm"), fibonacci_directions(4000)
    found = np.exp(np.array(look_up(ns.Float(table.ravel()), 24, ns.Array3f(np.ascontiguousarray(d.T, np.float32)))))
    assert 4 * np.pi * found.mean() == pytest.approx(1, abs=1e-3)
    seen = np.abs(d[:, 2]) < 0.7
    found, expected = (v[seen] / v[seen].mean() for v in (found, law(None, d)))
    assert np.corrcoef(found, expected)[0, 1] > 0.97 and np.mean(expected * np.log(expected / found)) < 0.05


def test_one_view_counts_as_much_as_the_uniform_one_that_links_all():
    """Closed form for one view of A sr, of density p in it: inside b is in proportion to p + 1/4π."""
    right = lambda p, d: (d[:, 1] < 0).astype(float)
    one = view(right, (0, 0, 1.6), (1.0, 0, 0))
    table = blind_of_views([one], 24)
    ns = namespace("llvm")
    # Farther from the middle than densities are smoothed.
    angle = np.radians(32)
    d = np.array([[np.cos(angle), s * np.sin(angle), z] for s in (1, -1) for z in (-0.1, 0, 0.1)])
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    log = look_up(ns.Float(table.ravel()), 24, ns.Array3f(np.ascontiguousarray(d.T, np.float32)))
    found = np.exp(np.array(log)).reshape(2, 3).mean(axis=1)
    extent = pixel_solid_angles(LENS).sum()
    assert found[0] / found[1] == pytest.approx(1 / (1 + 8 * np.pi / extent), rel=0.2)
