"""Tracked rays as cones: what passes a gap, and what parts of them add up to."""

import numpy as np
import pytest
from scipy.stats import norm

from nerg_mi.surfaces.laplacian import merge
from nerg_mi.surfaces.mesh import Target
from nerg_mi.surfaces.sources import RaySettings, TrackedRays, ray_sums
from tests.surfaces.meshes import box, joined, plate

SIGMA = np.radians(1.5)


def rays(n, spread=0.0, seed=0):
    rng = np.random.default_rng(seed)
    d = np.concatenate([rng.normal(0, spread, (n, 2)), np.ones((n, 1))], axis=1)
    return TrackedRays(np.zeros((n, 3)), d / np.linalg.norm(d, axis=1, keepdims=True), np.full(n, 1 / n))


def test01_a_line_goes_through_a_gap_whole_and_a_cone_by_what_passes(rgb):
    """Two plates with a slit of 5 cm between them, two metres away, and a wall behind."""
    slit = 0.025
    left = (np.array([(-3.0, -3, 2), (-slit, -3, 2), (-slit, 3, 2), (-3, 3, 2)]), np.array([(0, 1, 2), (0, 2, 3)]))
    right = (-left[0] * [1, 1, -1], left[1])
    wall = box((-5, -5, 4), (5, 5, 4.1))
    mesh = joined(left, right, wall)
    target, behind = Target(mesh), mesh.corners[:, :, 2].min(axis=1) > 3
    line = ray_sums(target, rays(1000), RaySettings())
    assert line.face[behind].sum() == np.float64(1000) * (1 / 1000) or np.isclose(line.face[behind].sum(), 1)
    cone = ray_sums(target, rays(4000), RaySettings(cone=SIGMA, bundle=16))
    # One of the two angles of the Gaussian has to stay within the slit's.
    passes = 2 * norm.cdf(np.arctan(slit / 2) / SIGMA) - 1
    assert abs(cone.face[behind].sum() - passes) < 0.01 and 0.3 < passes < 0.4
    left_of = mesh.corners[:, :, 0].max(axis=1) < 0
    assert abs(cone.face[left_of & ~behind].sum() - (1 - passes) / 2) < 0.01
    assert np.isclose(cone.face.sum() + cone.escaped + cone.elsewhere, cone.total)


def test02_a_thin_edge_gets_its_part(rgb):
    """A rod of 1 cm, which hardly any line meets that is aimed at it with an error of a degree."""
    rod = joined(box((-0.005, -3, 2), (0.005, 3, 2.01)))
    sums = ray_sums(Target(rod), rays(20_000), RaySettings(cone=SIGMA))
    expected = 2 * norm.cdf(np.arctan(0.005 / 2) / SIGMA) - 1
    assert np.isclose(sums.face.sum(), expected, rtol=0.05)
    assert np.isclose(sums.escaped, 1 - sums.face.sum())


def test03_parts_give_the_same_as_often_as_they_are_made(rgb):
    target, settings = Target(joined(plate(9, side=4.0, z=2.0))), RaySettings(cone=SIGMA, bundle=8, seed=5)
    every = rays(1000, spread=0.2, seed=1)
    parts = [every.part(a, a + 300) for a in range(0, 1000, 300)]
    assert [p.first for p in parts] == [0, 300, 600, 900] and len(parts[-1]) == 100
    first, again = (merge(ray_sums(target, p, settings) for p in parts) for _ in range(2))
    assert np.array_equal(first.vertex, again.vertex) and first.count == 1000
    assert np.isclose(first.total, 1) and abs(first.unaccounted) < 1e-12
    other = ray_sums(target, parts[0], RaySettings(cone=SIGMA, bundle=8, seed=6))
    assert not np.array_equal(other.vertex, ray_sums(target, parts[0], settings).vertex)


@pytest.mark.parametrize("cone", [0.0, SIGMA])
def test04_on_elsewhere_and_escaped_add_up_where_something_hides_the_surface(rgb, cone):
    """A plate across x < 0 at z = 2, of which a shape at z = 1 hides y < 0 and reaches beyond it; the rest escapes."""
    plate_left = (np.array([(-9.0, -9, 2), (0, -9, 2), (0, 9, 2), (-9, 9, 2)]), np.array([(0, 1, 2), (0, 2, 3)]))
    hiding = (np.array([(-9.0, -9, 1), (9, -9, 1), (9, 0, 1), (-9, 0, 1)]), np.array([(0, 1, 2), (0, 2, 3)]))
    some = rays(4000, spread=0.3, seed=2)
    some = TrackedRays(some.origins, some.directions, np.linspace(0.5, 1.5, 4000))
    sums = ray_sums(Target(joined(plate_left), [hiding]), some, RaySettings(cone=cone, bundle=8))
    hidden, left = some.directions[:, 1] < 0, some.directions[:, 0] < 0
    expected = [some.weights[rows].sum() for rows in (~hidden & left, hidden, ~hidden & ~left)]
    found = [sums.on_surface, sums.elsewhere, sums.escaped]
    assert np.allclose(found, expected, rtol=1e-9 if cone == 0 else 0.03)
    assert sum(found) == pytest.approx(sums.weight, rel=1e-12) and sums.total == sums.weight == some.weights.sum()
