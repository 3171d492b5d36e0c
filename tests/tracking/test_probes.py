"""Tests of `nerg_mi.tracking.probes`."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.kde import select_loo_kappa
from nerg_mi.maths import vmf
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.tracking.probes import (
    REGION_LEVELS,
    calibrate_levels,
    compute_participant_weights,
    compute_region_levels,
    format_level,
    place_probes,
    place_queries,
)
from nerg_mi.tracking.rays import Rays
from tests.refusals import mentions

# ---- Measures ----


@pytest.fixture(scope="module")
def rays_measures():
    """Four participants in a 3 x 2 m room who look at (1.5, 4, 1) with κ = 60; the first of them twice as often."""
    rng = np.random.default_rng(5)
    n = 12_000
    origin = rng.uniform([0, 0, 1.5], [3, 2, 1.7], (n, 3))
    to = np.array([1.5, 4, 1]) - origin
    mu = to / np.linalg.norm(to, axis=1, keepdims=True)
    return Rays(
        np.arange(n) * 0.1,
        np.maximum(rng.integers(-1, 4, n), 0),
        tuple("abcd"),
        origin,
        vmf.sample(mu, 60.0, rng),
        np.ones(n),
    )


def test_integral_is_one_at_a_thousand_random_positions(rays_measures):
    probes = place_probes(
        rays_measures, 0.2, placement="random", count=1100, max_rays=64, min_rays=4, kappa_max=100.0, weights="distance"
    )
    assert len(probes) > 1000
    density = probes.kde("llvm").evaluate(fibonacci_directions(8192))
    assert np.abs(4 * np.pi * density.mean(axis=1, dtype=np.float64) - 1).max() < 1e-3


# ---- Placement ----


@pytest.fixture(scope="module")
def origin():
    """A walk with a long stay in one corner."""
    rng = np.random.default_rng(0)
    return np.concatenate(
        [rng.uniform([0, 0, 1.5], [4, 3, 1.7], (3000, 3)), rng.normal([1, 1, 1.6], 0.02, (20_000, 3))]
    )


def test_blue_noise_is_even_and_covers(origin):
    rng = np.random.default_rng(1)
    result = place_queries(origin, "blue", 10_000, 0.3, 0.25, rng)
    distances = np.linalg.norm(result[:, None] - result[None], axis=2) + 10 * np.eye(len(result))
    assert distances.min() > 0.3
    # Every origin has a probe nearby: no gap is wider than the discs (and the cells of the candidates).
    assert np.linalg.norm(origin[:, None] - result[None], axis=2).min(axis=1).max() < 0.3 * 1.5
    assert {tuple(p) for p in result} <= {tuple(p) for p in origin}
    # Random origins cluster where participants stood.
    crowd = lambda p: (np.linalg.norm(p[:, :2] - [1, 1], axis=1) < 0.1).mean()
    assert crowd(place_queries(origin, "data", 500, None, 0.25, rng)) > 0.5 > 10 * crowd(result)


@pytest.mark.parametrize("count", [20, 200])
def test_blue_noise_of_a_number(origin, count):
    result = place_queries(origin, "blue", count, None, 0.1, np.random.default_rng(2))
    assert 0.4 * count <= len(result) <= count


def test_lattice_and_box(origin):
    rng = np.random.default_rng(3)
    grid = place_queries(origin, "grid", 1, None, 0.25, rng)
    assert np.allclose(np.diff(np.unique(grid[:, 0].round(9))), 0.5)
    # Equal distance to opposite walls.
    assert np.allclose(grid.min(axis=0) + grid.max(axis=0), origin.min(axis=0) + origin.max(axis=0))
    box = place_queries(origin, "random", 300, None, 0.25, rng)
    assert len(box) == 300 and (box >= origin.min(axis=0)).all() and (box <= origin.max(axis=0)).all()
    with pytest.raises(ValueError, match="placement"):
        place_queries(origin, "hexagons", 1, None, 0.25, rng)


def test_positions_far_apart_all_have_a_probe():
    """Few origins along a steep line, where cells of candidates are easily confused."""
    steps = np.arange(5.0)
    for axes in ([0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1]):
        down = np.stack([0 * steps, 0.26 * steps, 1.26 * (4 - steps)], axis=1)[:, axes]
        result = place_queries(np.repeat(down, 7, axis=0), "blue", 100, 1.0, 0.25, np.random.default_rng(0))
        assert sorted(map(tuple, result)) == sorted(map(tuple, down))


# ---- Probes ----


def test_holds_the_nearest_rays_within_the_radius(rays_measures):
    probes = place_probes(rays_measures, 0.2, count=20, max_rays=40, min_rays=10)
    for p in range(len(probes)):
        held = probes.indices[probes.offsets[p] : probes.offsets[p + 1]]
        far = np.linalg.norm(rays_measures.origin - probes.queries[p], axis=1)
        inside = np.flatnonzero(far < 0.2)
        assert 10 <= len(held) <= 40 and len(held) == min(40, len(inside))
        assert np.all(np.diff(far[held]) >= 0) and np.isclose(far[held].max(), np.sort(far)[len(held) - 1])
        assert np.allclose(probes.positions[p], rays_measures.origin[held].mean(axis=0))
        assert np.array_equal(
            probes.directions[probes.offsets[p] : probes.offsets[p + 1]], rays_measures.direction[held]
        )


def test_leave_one_out_sees_through_repetition():
    # Each participant repeats one direction: leaving out only the ray would select the largest κ.
    rng = np.random.default_rng(0)
    centre = vmf.sample(np.tile([0, 0, 1.0], (12, 1)), 20.0, rng)
    rays, person = np.repeat(centre, 20, axis=0), np.repeat(np.arange(12), 20)
    assert select_loo_kappa(rays) > 900
    assert select_loo_kappa(rays, person) < 100


def test_refusals(rays_measures):
    with pytest.raises(ValueError, match="placement"):
        place_probes(rays_measures, 0.25, placement="hexagons", queries=np.zeros((1, 3)))
    with pytest.raises(ValueError, match="kappa_rule"):
        place_probes(rays_measures, 0.25, kappa_rule="magic")
    with pytest.raises(NergError, check=mentions("radius", "min_rays")):
        place_probes(rays_measures, 0.001, count=10)
    with pytest.raises(ValueError, match="min_rays"):
        place_probes(rays_measures, 0.25, max_rays=10, min_rays=20)


def test_participants_can_have_equal_weight():
    """A stay that is a hundred times as long has the same weight; ray weights multiply within a participant."""
    toward = np.array([[1.0, 0, 0]] * 100 + [[0, 1.0, 0]])
    rays = Rays(
        np.arange(101.0), np.array([0] * 100 + [1]), ("stays", "passes"), np.zeros((101, 3)), toward, np.ones(101)
    )
    both = np.array([[[1.0, 0, 0], [0, 1.0, 0]]])
    provenance = dict(queries=np.zeros((1, 3)), min_rays=1, kappa_rule="fixed", kappa=50.0)
    stays, passes = place_probes(rays, 0.2, weights="person", **provenance).density(both)[0]
    assert stays == pytest.approx(passes, rel=1e-5)
    assert np.divide(*place_probes(rays, 0.2, **provenance).density(both)[0]) == pytest.approx(100, rel=1e-3)
    some = np.array([1.0] * 50 + [0.0] * 50 + [1.0])
    stays, passes = place_probes(rays, 0.2, weights="person", ray_weights=some, **provenance).density(both)[0]
    assert stays == pytest.approx(passes, rel=1e-5)


def test_participants_have_equal_weight_in_each_probe():
    """Two probes in which the same participants have different numbers of rays."""
    x, person = np.array([0.0] * 9 + [5.0] * 6), np.array([0] * 8 + [1] + [0] * 2 + [1] * 4)
    origin = x[:, None] * [1.0, 0, 0]
    rays = Rays(np.arange(15.0), person, ("a", "b"), origin, np.tile([0, 1.0, 0], (15, 1)), np.ones(15))
    queries = np.array([[0.0, 0, 0], [5.0, 0, 0]])
    probes = place_probes(rays, 0.2, weights="person", queries=queries, min_rays=1, kappa_rule="fixed", kappa=9.0)
    assert probes.weights is not None
    for start, end in zip(probes.offsets[:-1], probes.offsets[1:]):
        totals = np.bincount(person[probes.indices[start:end]], probes.weights[start:end])
        assert totals[0] == pytest.approx(totals[1])


def test_distance_and_ray_weights_multiply():
    """Rays at 0, R/2 and exactly at the rim; the last has a tiny weight, so that a probe with only rim rays is
    valid."""
    x = np.array([0.0, 0.1, 0.2])
    rays = Rays(np.arange(3.0), np.zeros(3), ("a",), x[:, None] * [1.0, 0, 0], np.eye(3), np.ones(3))
    provenance = dict(queries=np.zeros((1, 3)), min_rays=1, kappa_rule="fixed", kappa=200.0)
    alone = place_probes(rays, 0.2, weights="distance", **provenance)
    assert alone.weights == pytest.approx([1.0, 0.5, 1e-6], rel=1e-9)
    individual = np.array([0.25, 3.0, 1.0])
    both = place_probes(rays, 0.2, weights="distance", ray_weights=individual, **provenance)
    assert both.weights == pytest.approx([0.25, 1.5, 1e-6], rel=1e-9)
    assert both.positions[0, 0] == pytest.approx((0.25 * 0 + 1.5 * 0.1) / 1.75, rel=1e-5)
    peaks = both.density(np.eye(3)[None])[0]
    assert peaks[1] / peaks[0] == pytest.approx(6, rel=1e-4)
    rim = place_probes(rays.select([2]), 0.2, weights="distance", **provenance)
    assert rim.density(np.eye(3)[None])[0, 2] > 10


def test_participants_without_rays_are_ignored():
    """Names without rays do not count: the mean stays one, and all others have equal sums."""
    person = np.array([0] * 6 + [3] * 2)
    rays = Rays(np.arange(8.0), person, tuple("abcd"), np.zeros((8, 3)), np.tile([1.0, 0, 0], (8, 1)), np.ones(8))
    weights = compute_participant_weights(rays)
    assert weights == pytest.approx([8 / 2 / 6] * 6 + [8 / 2 / 2] * 2)
    assert weights.mean() == pytest.approx(1)


# ---- Smallest regions of densities on the sphere, and the shares to ask for ----


def test_region_levels_of_a_cap():
    """A density that decreases with the angle from z: the region up to cos a holds (e^k - e^ka) / (e^k - e^-k)."""
    d, kappa = fibonacci_directions(20_000), 3.0
    maps, at = np.exp(kappa * d[None, :, 2]), np.array([[1.0, 0.5, 0.0, -1.0]])
    level = compute_region_levels(maps, np.exp(kappa * at))
    expected = (np.exp(kappa) - np.exp(kappa * at)) / (2 * np.sinh(kappa))
    np.testing.assert_allclose(level, expected, atol=1e-3)
    assert compute_region_levels(np.ones((1, 5)), np.ones((1, 2))).tolist() == [[0.5, 0.5]]
    assert compute_region_levels(np.zeros((1, 5)), np.zeros((1, 2))).tolist() == [[0.5, 0.5]]


def test_calibrated_levels_are_weighted_quantiles():
    rng = np.random.default_rng(0)
    # If rays are at the square root of a uniform level, a level q covers q^2 of them.
    levels = np.sqrt(rng.random(40_000))
    result = calibrate_levels(levels, np.ones(len(levels)))
    np.testing.assert_allclose([result[format_level(q)] for q in REGION_LEVELS], np.sqrt(REGION_LEVELS), atol=0.01)
    # A ray of weight 3 counts three times, one of weight zero not at all.
    some = levels[:999]
    times = rng.integers(0, 4, len(some))
    assert calibrate_levels(some, times.astype(float)) == calibrate_levels(np.repeat(some, times), np.ones(times.sum()))
    assert calibrate_levels(np.array([0.3]), np.ones(1)) == {"50%": 0.3, "80%": 0.3, "95%": 0.3}


@pytest.mark.parametrize("bad", [np.inf, np.nan, -1.0])
def test_invalid_ray_weights_are_named(rays_measures, bad):
    weights = np.ones(len(rays_measures))
    weights[2] = bad
    with pytest.raises(NergError, match=r"ray_weights\[2\]"):
        place_probes(rays_measures, 0.3, ray_weights=weights)
