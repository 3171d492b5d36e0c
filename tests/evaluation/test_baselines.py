"""Tests of `nerg_mi.evaluation.baselines`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.evaluation import baselines
from nerg_mi.evaluation.baselines import (
    CONDITIONAL_HITS,
    CONDITIONAL_KDE,
    DEFAULT_SETTINGS,
    NEAREST_RAYS,
    PRIOR,
    REAIMED_HITS,
    STACK,
    UNIFORM,
    CachedBaseline,
    NearestRays,
    NeighbourDensity,
    format_settings,
    make_prior_baseline,
    make_tuned_baselines,
    make_uniform_baseline,
)
from nerg_mi.maths import vmf
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.tracking.folds import Fold, iter_folds
from nerg_mi.tracking.probes import compute_participant_weights
from nerg_mi.tracking.rays import Rays
from tests.reference.kde import kde as reference

X = fibonacci_directions(1024)
AT = np.array([[1.0, 1.0, 1.55], [3.0, 2.0, 1.55]])


def room(participants: int = 1, count: int = 3000, spread: float = 40.0) -> Rays:
    """Participants in a room of 4 x 4 m who look at an object in its middle, with ``spread`` as the concentration."""
    rng = np.random.default_rng(1)
    origin = rng.uniform([0, 0, 1.5], [4, 4, 1.6], (count, 3))
    target = np.array([2.0, 2.0, 0.5])
    away = target - origin
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    direction = vmf.sample(away / distance, spread, rng)
    names = tuple("abcdefgh"[:participants])
    person = np.arange(count) % participants
    hit = origin + direction * distance
    return Rays(np.arange(count) * 1.0, person, names, origin, direction, np.ones(count), hit)


@pytest.fixture(scope="module")
def rays():
    return room()


def test_the_prior_is_the_kernel_density_of_all_rays(rays):
    density = make_prior_baseline(rays, kappa=30.0, backend="llvm")
    want = reference(X, rays.direction, [0, len(rays)], [30.0])
    assert density(np.zeros((3, 3)), X).shape == (3, 1024) and np.allclose(density(AT, X), want, rtol=2e-4)
    individual = density(np.zeros((2, 3)), np.stack([X, X[::-1]]))
    assert np.allclose(individual[0], individual[1, ::-1], rtol=1e-5)


def test_the_prior_can_give_each_participant_the_same_weight():
    """9,000 rays are several runs, whose weights differ."""
    rays = room(count=9000)
    person = np.minimum(np.arange(9000) // 1000, 3)
    rays = replace(rays, person=person, persons=tuple("abcd"))
    density = make_prior_baseline(rays, kappa=30.0, weights=compute_participant_weights(rays))(np.zeros((1, 3)), X)
    each = [reference(X, rays.direction[person == p], [0, np.sum(person == p)], [30.0])[0] for p in range(4)]
    assert np.allclose(density[0], np.mean(each, axis=0), rtol=2e-4)


def test_cached_baseline_evaluates_equal_arrays_once():
    calls = []
    method = CachedBaseline(lambda *options: calls.append(1) or make_uniform_baseline()(*options))
    positions, directions = np.zeros((2, 3)), fibonacci_directions(8)
    first = method(positions, directions)
    assert method(positions, directions) is first and len(calls) == 1
    # Equal values in other arrays are not compared.
    np.testing.assert_array_equal(method(positions.copy(), directions), first)
    assert len(calls) == 2
    with pytest.raises(ValueError, match="read-only"):
        first[0] = 0


@pytest.mark.parametrize("bandwidth", [None, 0.3])
@pytest.mark.parametrize("is_aimed", [False, True])
def test_neighbours_are_those_of_a_float64_reference(rays, bandwidth, is_aimed):
    hits = rays.hit.copy()
    hits[:100] = np.nan
    neighbours = NearestRays(rays, hits if is_aimed else None)
    prior = make_prior_baseline(rays, kappa=10.0)
    settings = {"count": 300, "kappa": 20.0, "prior_weight": 0.25, "bandwidth": bandwidth}
    density = NeighbourDensity(neighbours, prior, **settings)(AT, X)
    for at, row in zip(AT, density):
        distance = np.linalg.norm(rays.origin - at, axis=1)
        near = np.argsort(distance)[:300]
        directions = rays.direction[near]
        if is_aimed:
            aimed = hits[near] - at
            aimed /= np.linalg.norm(aimed, axis=1, keepdims=True)
            directions = np.where(np.isfinite(aimed), aimed, directions)
        weights = np.ones(300) if bandwidth is None else np.exp(-0.5 * (distance[near] / bandwidth) ** 2)
        kernels = 20 / (2 * np.pi * -np.expm1(-40.0)) * np.exp(20 * (X @ directions.T - 1))
        want = 0.75 * kernels @ (weights / weights.sum()) + 0.25 * prior(at[None], X)[0]
        assert np.allclose(row, want, rtol=3e-4) and 4 * np.pi * row.mean() == pytest.approx(1, abs=2e-3)
    individual = NeighbourDensity(neighbours, prior, **settings)(AT, np.stack([X, X[::-1]]))
    assert np.allclose(individual[1, ::-1], density[1], rtol=1e-5)


def test_a_prior_weight_of_one_is_the_prior(rays):
    prior = make_prior_baseline(rays, kappa=10.0)
    alone = NeighbourDensity(NearestRays(rays), prior, count=30, kappa=20.0, prior_weight=1.0)
    assert np.array_equal(alone(AT, X), prior(AT, X))


def test_tuned_settings_have_the_highest_density_of_held_out_rays():
    """All look at one object, so hit points predict best, with the concentration of the gaze."""
    rays = room(participants=6, spread=100.0)
    tuned = make_tuned_baselines(rays, 0.3, rays.hit)
    assert list(tuned) == [UNIFORM, PRIOR, NEAREST_RAYS, CONDITIONAL_KDE, REAIMED_HITS, CONDITIONAL_HITS, STACK]
    assert all(tuned[name].folds == 4 for name in tuned if name not in (UNIFORM, PRIOR))
    settings = tuned[REAIMED_HITS].settings
    assert settings["kappa"] >= 100 and settings["prior weight"] <= 0.05 and settings["rays"] >= 256
    new = room(participants=6, spread=100.0, count=500)
    log = {
        name: np.log(baseline.density(new.origin, new.direction[:, None])).mean() for name, baseline in tuned.items()
    }
    assert log[UNIFORM] < log[PRIOR] < log[NEAREST_RAYS] < log[REAIMED_HITS]
    assert tuned[CONDITIONAL_HITS].settings["kappa"] >= 100 and log[NEAREST_RAYS] < log[CONDITIONAL_HITS]
    assert log[STACK] > log[NEAREST_RAYS] and tuned[STACK].settings["kernels"] > 1
    for name in (CONDITIONAL_HITS, STACK):
        density = tuned[name].density(AT, X)
        assert density.shape == (2, 1024) and 4 * np.pi * density.mean(axis=1) == pytest.approx(1, abs=0.02)
        individual = tuned[name].density(AT, np.stack([X, X[::-1]]))
        np.testing.assert_allclose(individual[1, ::-1], density[1], rtol=1e-5)
    text = format_settings(tuned)
    assert "re-aimed hits (rays" in text and "not tuned" not in text


def test_without_hit_points_there_are_no_re_aimed_hits():
    rays = replace(room(participants=3, count=900), hit=None)
    assert REAIMED_HITS not in make_tuned_baselines(rays, 0.5)


def test_folds_and_their_samples_follow_the_seed(monkeypatch):
    rays, draw, samples = replace(room(participants=3, count=900), hit=None), Fold.sample, []

    def record(fold: Fold, count: int, seed: int) -> Rays:
        samples.append((fold.held_out.t, seed))
        return draw(fold, count, seed)

    monkeypatch.setattr(Fold, "sample", record)
    assert REAIMED_HITS not in make_tuned_baselines(rays, 0.5, np.full((900, 3), np.nan), prior_kappa=10.0, seed=5)
    folds, others = ([fold.held_out.t for fold in iter_folds(rays, 0.5, 4, seed)] for seed in (5, 0))
    assert len(samples) == len(folds) and not all(map(np.array_equal, folds, others))
    assert all(np.array_equal(t, fold) for (t, _), fold in zip(samples, folds))
    assert [seed for _, seed in samples] == [5 + k for k in range(len(folds))]


def test_of_too_few_rays_nothing_is_tuned_and_that_is_stated():
    tuned = make_tuned_baselines(room(participants=2, count=20), 0.2)
    assert tuned[NEAREST_RAYS].settings == DEFAULT_SETTINGS[NEAREST_RAYS] and tuned[NEAREST_RAYS].folds == 0
    assert "not tuned" in format_settings(tuned)
    assert np.isfinite(tuned[NEAREST_RAYS].density(AT, X)).all()


def test_the_scores_of_the_folds_are_those_of_the_densities():
    """Tuning and evaluation are separate code: their log densities agree."""
    rays = room(participants=2, count=1500)
    train, test = rays.select(rays.person == 0), rays.select(np.flatnonzero(rays.person == 1)[:50])
    prior = make_prior_baseline(train, kappa=20.0)
    at_rays = lambda density: density(test.origin, test.direction[:, None])[:, 0]
    blocks = baselines._find_neighbours(train, test, True)
    for is_conditional, is_aimed in ((False, False), (True, False), (False, True)):
        scored = baselines._score_neighbours(blocks, test, at_rays(prior), is_conditional, is_aimed)
        for index in (0, len(scored.settings) // 2, len(scored.settings) - 2):
            neighbours = NearestRays(train, train.hit if is_aimed else None)
            density = baselines._make_neighbour_density(neighbours, prior, scored.settings[index])
            np.testing.assert_allclose(scored.log_density[index], np.log(at_rays(density)), atol=2e-3)


def test_uniform_baseline():
    assert np.allclose(make_uniform_baseline()(AT, X), 1 / (4 * np.pi))
    assert make_uniform_baseline()(AT, np.stack([X, X])).shape == (2, 1024)


def test_settings_are_scored_with_equal_weight_of_participants():
    rng = np.random.default_rng(0)
    person = np.array([0, 0, 0, 0, 2, 2, 1])
    directions = np.tile([1.0, 0, 0], (7, 1))
    rays = Rays(np.arange(7.0), person, ("a", "b", "c"), np.zeros((7, 3)), directions, np.ones(7))
    log_density = rng.normal(size=(3, 7))
    expected = [[row[:4].mean(), row[6], row[4:6].mean()] for row in log_density]
    np.testing.assert_allclose(baselines._average_participants(log_density, rays), expected)
