"""Lattices and surfaces of a field with closed-form density and colour."""

import math
from types import SimpleNamespace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields import extraction
from nerg_mi.fields.extraction import FieldSampler, Lattice, cell_opacity, find_crossings, surface_density
from nerg_mi.fields.occupancy import OccupancyGrid
from nerg_mi.maths.geometry import Box
from tests.refusals import mentions


class Ramp:
    """Density 10 + 4 x + 2 y - z in a flat box; its colour is view-dependent."""

    ns, occupancy = ns, None
    box = Box((-1, 0, 0.5), (3, 2, 1.5))

    def density(self, p, active=True):
        return dr.select(active, 10 + 4 * p.x + 2 * p.y - p.z, 0)

    def density_features(self, p):
        return self.density(p), [p.x]

    def color(self, features, d):
        return ns.Array3f(features[0], d.x * d.x, d.z)


def sigma(p):
    return 10 + 4 * p[..., 0] + 2 * p[..., 1] - p[..., 2]


def test_lattice_covers_the_box_evenly():
    lattice = Lattice.for_field(Ramp(), 10)
    assert lattice.step == pytest.approx(0.4) and lattice.shape == (10, 5, 3)
    # Three cells of 0.4 exceed the height of 1 by 0.1 on either side.
    assert np.allclose(lattice.lower, (-1, 0, 0.4))
    assert np.allclose(
        lattice.points([[0, 0, 0], [9, 4, 2], [0.5, 1, 0]]), [[-0.8, 0.2, 0.6], [2.8, 1.8, 1.4], [-0.6, 0.6, 0.6]]
    )
    assert Lattice.for_field(SimpleNamespace(box=Box((0, 0, 0), (1, 1, 0.01))), 2).shape == (2, 2, 2)
    with pytest.raises(ValueError, match="at least 2 cells"):
        Lattice.for_field(Ramp(), 1)
    with pytest.raises(NergError, check=mentions("resolution")):
        Lattice.for_field(SimpleNamespace(box=Box((0, 0, 0), (1, 1, 1))), 2048)
    assert -math.expm1(-surface_density(lattice) * 0.4) == pytest.approx(0.5)
    assert np.allclose(cell_opacity(np.array([0, surface_density(lattice), 1e9]), lattice), [0, 0.5, 1])


@pytest.mark.parametrize("batch", [1 << 21, 7])
def test_density_and_opacity_on_a_lattice(batch, monkeypatch):
    monkeypatch.setattr(extraction, "_BATCH", batch)
    lattice, sampler = Lattice.for_field(Ramp(), 5), FieldSampler(Ramp())
    nx, ny, nz = lattice.shape
    z, y, x = np.meshgrid(np.arange(nz), np.arange(ny), np.arange(nx), indexing="ij")
    p = lattice.points(np.stack([x, y, z], axis=-1).reshape(-1, 3))
    assert np.allclose(sampler.density_on(lattice).ravel(), sigma(p), rtol=1e-5)
    assert np.allclose(sampler.density(p), sigma(p), rtol=1e-5)
    # Cells in eighths: the mean opacity of their centres.
    parts = np.array(np.meshgrid(*[[-0.25, 0.25]] * 3)).reshape(3, -1).T * lattice.step
    want = np.mean([-np.expm1(-sigma(p + q) * lattice.step) for q in parts], axis=0)
    assert np.allclose(sampler.opacity_on(lattice, 2).ravel(), want, rtol=1e-5)
    assert np.allclose(sampler.opacity_on(lattice, 1).ravel(), -np.expm1(-sigma(p) * lattice.step), rtol=1e-5)


def test_empty_cells_are_masked_unless_disabled():
    field = Ramp()
    bits = np.zeros((2, 2, 2), bool)
    bits[:, :, 1] = True  # the half with larger x
    field.occupancy = OccupancyGrid(bits, ns, 0.0)
    p = np.array([[-0.5, 1, 1], [2.5, 1, 1]])
    assert np.allclose(FieldSampler(field).density(p), [0, sigma(p[1])])
    assert np.allclose(FieldSampler(field).density(p, masked=False), sigma(p))


def test_diffuse_color_averages_normal_and_oblique_views():
    sampler, rng = FieldSampler(Ramp()), np.random.default_rng(0)
    p, n = rng.uniform(0, 1, (9, 3)), rng.normal(size=(9, 3))
    n[0], n[1] = (1, 0, 0), (0, 0, -1)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    assert np.allclose(sampler.color(p, n), np.stack([p[:, 0], n[:, 0] ** 2, n[:, 2]], axis=1), atol=1e-6)
    result = sampler.diffuse_color(p, n)
    # Over the normal direction and four at 45 degrees around it, d = -n and -(n + t) / sqrt 2 with t all around: the
    # mean of d is -n (1 + 4 / sqrt 2) / 5, that of d_x² is (n_x² + 4 (n_x² + (1 - n_x²) / 2) / 2) / 5.
    assert np.allclose(result[:, 0], p[:, 0], atol=1e-6)
    assert np.allclose(result[:, 2], -n[:, 2] * (1 + 4 / math.sqrt(2)) / 5, atol=1e-6)
    assert np.allclose(result[:, 1], (n[:, 0] ** 2 + 2 * (n[:, 0] ** 2 + (1 - n[:, 0] ** 2) / 2)) / 5, atol=1e-6)


class Wall(Ramp):
    """Density 100 behind an oblique plane, x + y / 4 > 0.68, up to x = 2.1 and y = 0.9."""

    def density(self, p, active=True):
        return dr.select(active & (p.x + 0.25 * p.y > 0.68) & (p.x < 2.1) & (p.y < 0.9), ns.Float(100), 0)


def test_crossings_are_located_along_edges():
    lattice, sampler = Lattice.for_field(Wall(), 10), FieldSampler(Wall())
    # x = -0.8 + 0.4 i and y = 0.2 + 0.4 j. Points without a crossing, or not on an edge, stay.
    index = np.array([[3.9, 1, 1], [3.1, 0, 0], [4, 1.1, 1], [5.5, 1, 1], [3.0, 1, 1], [1, 0.5, 1]])
    moved, unseen = find_crossings(sampler, lattice, index, 50.0)
    want = [[(0.68 - 0.15 + 0.8) / 0.4, 1, 1], [(0.68 - 0.05 + 0.8) / 0.4, 0, 0], [4, (0.9 - 0.2) / 0.4, 1]]
    assert np.allclose(moved[:3], want, atol=2**-8) and np.array_equal(moved[3:], index[3:]) and not unseen.any()


def test_border_of_occupied_cells_is_not_a_surface():
    field = Wall()
    bits = np.ones((4, 4, 4), bool)
    bits[:, :, 3] = False  # unoccupied from x = 2 on
    field.occupancy = OccupancyGrid(bits, ns, 0.0)
    lattice = Lattice.for_field(field, 10)
    # Between i = 6 (1.6) and 7 (2.0) density ends at x = 2, but the networks continue with it, up to 2.1.
    moved, unseen = find_crossings(
        FieldSampler(field), lattice, np.array([[6.5, 1, 1], [7.4, 1, 1], [3.5, 1, 1]]), 50.0
    )
    assert unseen.tolist() == [True, False, False]
    assert np.allclose(moved[0, 0], 7, atol=2**-8) and np.allclose(moved[2, 0], 3.325, atol=2**-8)
