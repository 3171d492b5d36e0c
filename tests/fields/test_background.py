"""What lies behind a field: where a ray leaves the sphere about it, whatever it comes from, and sizes that must fit."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGrid, HashGridConfig
from nerg_mi.fields.mlp import MLP
from nerg_mi.fields.radiance import Background, BackgroundConfig

GRID = HashGridConfig(levels=2, log2_rows=8, base=4, finest=8, dimensions=2)
CONFIG = BackgroundConfig(2.5, GRID, width=16)


def jit(v):
    return ns.Array3f(np.ascontiguousarray(np.asarray(v, np.float32).T))


def test_rays_leave_the_sphere_where_they_do():
    rng = np.random.default_rng(0)
    o, d = rng.uniform(-1.4, 1.4, (300, 3)), rng.normal(size=(300, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    b = (o * d).sum(1)
    t = -b + np.sqrt(b * b - (o * o).sum(1) + 2.5**2)
    p = o + d * t[:, None]
    assert np.allclose(np.linalg.norm(p, axis=1), 2.5)
    found = np.stack([c.numpy() for c in Background.random(CONFIG, ns).coordinates(jit(o), jit(d))], axis=1)
    assert np.allclose(found[:, 0], 2 / np.pi * np.arccos(p[:, 1] / 2.5) - 1, atol=1e-5)
    assert np.allclose(found[:, 1], np.arctan2(p[:, 2], p[:, 0]) / np.pi, atol=1e-5)


def test_a_ray_that_misses_takes_the_nearest_point():
    # Past the sphere along +z, 4 to the right: nearest at (4, 0, 0), which is seen along +x.
    theta, phi = Background.random(CONFIG, ns).coordinates(jit([[4, 0, -9]]), jit([[0, 0, 1]]))
    assert abs(theta[0]) < 1e-6 and abs(phi[0]) < 1e-6


def test_colours_are_those_of_the_place_and_of_the_direction():
    back = Background.random(CONFIG, ns, 3)
    table = np.random.default_rng(1).normal(size=len(back.grid.table)).astype(np.float32)
    back.grid.table = ns.Float(table)
    o, d = np.zeros((2, 3)), np.array([[0.6, 0, 0.8], [0, 0.6, 0.8]])
    c = np.array(back(jit(o), jit(d)))
    assert c.shape == (3, 2) and (c > 0).all() and (c < 1).all() and np.abs(c[:, 0] - c[:, 1]).max() > 1e-3
    # From elsewhere towards the same place, the direction still counts.
    place = 2.5 * d[0]
    other = np.array([1.0, 0.5, 0])
    towards = (place - other) / np.linalg.norm(place - other)
    same = back.coordinates(jit([other]), jit([towards]))
    assert np.allclose([s[0] for s in same], [s.numpy()[0] for s in back.coordinates(jit(o), jit(d))], atol=1e-5)
    assert np.abs(np.array(back(jit([other]), jit([towards])))[:, 0] - c[:, 0]).max() > 1e-4


def test_the_default_is_a_square_grid_and_others_are_refused():
    assert BackgroundConfig(1.0).grid.dimensions == 2
    for wrong in ({"grid": HashGridConfig(levels=2)}, {"width": 0}, {"hidden": 0}):
        with pytest.raises(ValueError, match="2 dimensions and sizes of at least 1"):
            BackgroundConfig(1.0, **wrong)
    for radius in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ValueError, match="radius"):
            BackgroundConfig(radius)
    assert BackgroundConfig.from_dict(CONFIG.to_dict()) == CONFIG


def test_what_does_not_belong_together_is_refused():
    rng = np.random.default_rng(0)
    grid, net = HashGrid.random(GRID, ns, rng), MLP.random(CONFIG.sizes, ns, rng)
    Background(CONFIG, grid, net)
    with pytest.raises(ValueError, match="grid"):
        Background(
            CONFIG, HashGrid.random(HashGridConfig(levels=2, log2_rows=9, base=4, finest=8, dimensions=2), ns, rng), net
        )
    with pytest.raises(ValueError, match="background_net"):
        Background(CONFIG, grid, MLP.random([CONFIG.sizes[0], 32, 3], ns, rng))
