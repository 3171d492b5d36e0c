import numpy as np
import pytest

from nerg_mi.maths import vmf
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.probes.kde import leave_one_out_kappa
from nerg_mi.probes.probes import person_weights, place_probes
from nerg_mi.rays.rays import Rays


@pytest.fixture(scope="module")
def rays():
    """Four people in a 3 x 2 m room who look at (1.5, 4, 1), give or take κ = 60."""
    rng = np.random.default_rng(5)
    n = 6000
    origin = rng.uniform([0, 0, 1.5], [3, 2, 1.7], (n, 3))
    to = np.array([1.5, 4, 1]) - origin
    mu = to / np.linalg.norm(to, axis=1, keepdims=True)
    return Rays(np.arange(n) * 0.1, rng.integers(0, 4, n), tuple("abcd"), origin, vmf.sample(mu, 60.0, rng), np.ones(n))


@pytest.mark.parametrize("placement", ["data", "grid", "random"])
@pytest.mark.parametrize("rule", ["silverman", "fixed"])
def test_density_integrates_to_one(rays, placement, rule):
    probes = place_probes(
        rays, 0.25, placement=placement, count=30, min_rays=16, kappa_rule=rule, kappa=100.0, kappa_max=100.0
    )
    density = probes.density(fibonacci_directions(8192), "llvm")
    assert density.shape == (len(probes), 8192) and (probes.kappa <= 100).all()
    assert np.abs(density.mean(axis=1, dtype=np.float64) * 4 * np.pi - 1).max() < 1e-3


def test_holds_the_nearest_rays_within_the_radius(rays):
    probes = place_probes(rays, 0.2, count=20, cap=40, min_rays=10)
    for p in range(len(probes)):
        held = probes.indices[probes.offsets[p] : probes.offsets[p + 1]]
        far = np.linalg.norm(rays.origin - probes.queries[p], axis=1)
        inside = np.flatnonzero(far < 0.2)
        assert 10 <= len(held) <= 40 and len(held) == min(40, len(inside))
        assert np.all(np.diff(far[held]) >= 0) and np.isclose(far[held].max(), np.sort(far)[len(held) - 1])
        assert np.allclose(probes.positions[p], rays.origin[held].mean(axis=0))
        assert np.array_equal(probes.directions[probes.offsets[p] : probes.offsets[p + 1]], rays.direction[held])


def test_centre_seed_and_queries(rays):
    a, b = (place_probes(rays, 0.25, count=10, seed=3) for _ in range(2))
    assert np.array_equal(a.queries, b.queries) and np.array_equal(a.indices, b.indices)
    c = place_probes(rays, 0.25, queries=a.queries, centre="query")
    assert np.array_equal(c.positions, a.queries) and not np.array_equal(a.positions, a.queries)
    grid = place_probes(rays, 0.25, placement="grid", spacing=0.5, min_rays=8)
    steps = np.unique(np.round(np.diff(np.unique(np.round(grid.queries[:, 0], 9))), 9))
    assert np.allclose(steps, 0.5)


def test_kappa_rules(rays):
    silverman = place_probes(rays, 0.25, count=8)
    R = [
        np.linalg.norm(rays.direction[silverman.indices[a:b]].mean(axis=0))
        for a, b in zip(silverman.offsets, silverman.offsets[1:])
    ]
    assert np.allclose(silverman.kappa, vmf.silverman_kappa(R, silverman.counts))
    loo = place_probes(rays, 0.25, count=8, kappa_rule="loo")
    assert ((loo.kappa > 20) & (loo.kappa < 1000)).all()


def test_leave_one_out_sees_through_repetition():
    # Each person's rays repeat one direction: leaving out the ray alone would
    # choose the sharpest kernel there is.
    rng = np.random.default_rng(0)
    centre = vmf.sample(np.tile([0, 0, 1.0], (12, 1)), 20.0, rng)
    rays, person = np.repeat(centre, 20, axis=0), np.repeat(np.arange(12), 20)
    assert leave_one_out_kappa(rays) > 900
    assert leave_one_out_kappa(rays, person) < 100


def test_refusals(rays):
    with pytest.raises(ValueError, match="placement"):
        place_probes(rays, 0.25, placement="hexagons", queries=np.zeros((1, 3)))
    with pytest.raises(ValueError, match="kappa_rule"):
        place_probes(rays, 0.25, kappa_rule="magic")
    with pytest.raises(ValueError, match="enlarge the radius"):
        place_probes(rays, 0.001, count=10)
    with pytest.raises(ValueError, match="min_rays"):
        place_probes(rays, 0.25, cap=10, min_rays=20)


def test_people_of_a_probe_can_count_alike():
    """One who stayed a hundred times as long weighs as much as the other; times the rays' own weights, within a
    person."""
    toward = np.array([[1.0, 0, 0]] * 100 + [[0, 1.0, 0]])
    rays = Rays(
        np.arange(101.0), np.array([0] * 100 + [1]), ("stays", "passes"), np.zeros((101, 3)), toward, np.ones(101)
    )
    both = np.array([[[1.0, 0, 0], [0, 1.0, 0]]])
    about = dict(queries=np.zeros((1, 3)), min_rays=1, kappa_rule="fixed", kappa=50.0)
    stays, passes = place_probes(rays, 0.2, weights="person", **about).density(both)[0]
    assert stays == pytest.approx(passes, rel=1e-5)
    assert np.divide(*place_probes(rays, 0.2, **about).density(both)[0]) == pytest.approx(100, rel=1e-3)
    some = np.array([1.0] * 50 + [0.0] * 50 + [1.0])
    stays, passes = place_probes(rays, 0.2, weights="person", ray_weights=some, **about).density(both)[0]
    assert stays == pytest.approx(passes, rel=1e-5)


def test_distance_and_the_rays_own_weights_multiply():
    """Of rays at 0, R/2 and the very rim; the last keeps a trace of weight, so that a probe of rims alone is one."""
    x = np.array([0.0, 0.1, 0.2])
    rays = Rays(np.arange(3.0), np.zeros(3), ("a",), x[:, None] * [1.0, 0, 0], np.eye(3), np.ones(3))
    about = dict(queries=np.zeros((1, 3)), min_rays=1, kappa_rule="fixed", kappa=200.0)
    alone = place_probes(rays, 0.2, weights="distance", **about)
    assert alone.weights == pytest.approx([1.0, 0.5, 1e-6], rel=1e-9)
    own = np.array([0.25, 3.0, 1.0])
    both = place_probes(rays, 0.2, weights="distance", ray_weights=own, **about)
    assert both.weights == pytest.approx([0.25, 1.5, 1e-6], rel=1e-9)
    assert both.positions[0, 0] == pytest.approx((0.25 * 0 + 1.5 * 0.1) / 1.75, rel=1e-5)
    peaks = both.density(np.eye(3)[None])[0]
    assert peaks[1] / peaks[0] == pytest.approx(6, rel=1e-4)
    rim = place_probes(rays.select([2]), 0.2, weights="distance", **about)
    assert rim.density(np.eye(3)[None])[0, 2] > 10


def test_person_weights_of_people_without_rays():
    """Names without rays do not count as people: the mean stays one, and everybody who is there has the same sum."""
    person = np.array([0] * 6 + [3] * 2)
    rays = Rays(np.arange(8.0), person, tuple("abcd"), np.zeros((8, 3)), np.tile([1.0, 0, 0], (8, 1)), np.ones(8))
    weights = person_weights(rays)
    assert weights == pytest.approx([8 / 2 / 6] * 6 + [8 / 2 / 2] * 2)
    assert weights.mean() == pytest.approx(1)
