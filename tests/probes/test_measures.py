import numpy as np
import pytest

from nerg_mi.maths import vmf
from nerg_mi.probes.kde import kappa_grid, leave_one_out_scores
from nerg_mi.probes.probes import (
    effective_persons,
    effective_rays,
    entropy,
    integral,
    person_weights,
    place_probes,
    sample,
)
from nerg_mi.rays.rays import Rays


@pytest.fixture(scope="module")
def rays():
    """Four people in a 3 x 2 m room who look at (1.5, 4, 1), give or take κ = 60; the first of them twice as often."""
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


def test_integral_is_one_at_a_thousand_random_positions(rays):
    probes = place_probes(
        rays, 0.2, placement="random", count=1100, cap=64, min_rays=4, kappa_max=100.0, weights="distance"
    )
    assert len(probes) > 1000
    assert np.abs(integral(probes, 8192, "llvm") - 1).max() < 1e-3


def test_entropy_of_known_laws(rays):
    probes = place_probes(rays, 0.25, count=3, min_rays=1, cap=1, kappa_rule="fixed", kappa=40.0)
    # One ray: von Mises-Fisher, whose entropy is κ (1 - A(κ)) - log C(κ).
    want = 40 * (1 - vmf.mean_resultant_length(40.0)) - vmf.log_normaliser(40.0)
    assert np.allclose(entropy(probes, backend="llvm"), want, atol=1e-4)
    flat = place_probes(rays, 0.25, count=3, kappa_rule="fixed", kappa=0.0)
    assert np.allclose(entropy(flat, backend="llvm"), np.log(4 * np.pi), atol=1e-6)


def test_samples_follow_the_density(rays):
    probes = place_probes(rays, 0.3, count=2, cap=20, min_rays=20, kappa_rule="fixed", kappa=30.0, weights="distance")
    x = sample(probes, 40_000, np.random.default_rng(0))
    assert np.allclose(np.linalg.norm(x, axis=2), 1)
    for p in range(2):
        run = slice(probes.offsets[p], probes.offsets[p + 1])
        w = probes.weights[run] / probes.weights[run].sum()
        assert np.allclose(x[p].mean(axis=0), vmf.mean_resultant_length(30.0) * (w @ probes.directions[run]), atol=0.01)
        # E[log p] under its own samples is minus the entropy.
        log = np.log(probes.density(np.stack([x[0], x[1]]), "llvm")[p])
        assert np.isclose(-log.mean(), entropy(probes, backend="llvm")[p], atol=0.02)


def test_effective_numbers(rays):
    probes = place_probes(rays, 0.3, count=20)
    assert np.array_equal(effective_rays(probes), probes.counts)
    people = effective_persons(probes, rays)
    assert ((people > 2.5) & (people < 4)).all()
    even = place_probes(rays, 0.3, queries=probes.queries, ray_weights=person_weights(rays))
    assert (effective_rays(even) < even.counts).all() and effective_persons(even, rays).mean() > people.mean() + 0.1
    assert np.isclose(person_weights(rays).mean(), 1)
    counts = np.bincount(rays.person)
    assert (
        np.allclose(np.bincount(rays.person, weights=person_weights(rays)), len(rays) / 4)
        and counts[0] > 1.5 * counts[1]
    )


def test_weights_of_rays_and_distance(rays):
    q = np.array([[1.5, 1.0, 1.6]])
    plain = place_probes(rays, 0.3, queries=q, cap=5000)
    near = place_probes(rays, 0.3, queries=q, cap=5000, weights="distance", centre="query")
    d = np.linalg.norm(rays.origin[near.indices] - q, axis=1)
    assert np.array_equal(near.indices, plain.indices) and np.allclose(near.weights, 1 - d / 0.3, atol=1e-6)
    only = place_probes(rays, 0.3, queries=q, cap=5000, ray_weights=(rays.person == 2).astype(float))
    assert (rays.person[only.indices] == 2).all() and np.array_equal(
        np.sort(only.indices), np.sort(plain.indices[rays.person[plain.indices] == 2])
    )
    assert np.array_equal(only.directions, rays.direction[only.indices])
    with pytest.raises(ValueError, match="ray_weights"):
        place_probes(rays, 0.3, ray_weights=np.ones(3))


def test_one_kappa_for_all(rays):
    for rule in ("silverman", "loo"):
        each = place_probes(rays, 0.25, count=12, kappa_rule=rule)
        shared = place_probes(rays, 0.25, count=12, kappa_rule=rule, kappa_shared=True)
        assert (
            len(set(shared.kappa)) == 1
            and each.kappa.min() <= shared.kappa[0] <= each.kappa.max()
            and len(set(each.kappa)) > 1
        )


def test_leave_one_out_finds_the_true_width():
    # Many groups, one ray each: the best kernel is narrower than the law, and the likelihood near that of the law
    # itself.
    rng = np.random.default_rng(0)
    x = vmf.sample(np.tile([0, 0, 1.0], (256, 1)), 60.0, rng)
    scores = leave_one_out_scores(x, None, kappa_grid(1000.0))
    truth = np.mean(vmf.log_density(x, np.array([0, 0, 1.0]), 60.0))
    assert truth - 0.15 < scores.max() < truth + 0.02 and 60 < kappa_grid(1000.0)[scores.argmax()] < 600


def test_heads_widened_to_gaze(rays):
    heads = place_probes(rays, 0.25, count=4, kappa_rule="fixed", kappa=200.0)
    gaze = place_probes(rays, 0.25, count=4, kappa_rule="fixed", kappa=200.0, widen=37.0)
    assert np.allclose(gaze.kappa, vmf.convolved_kappa(200.0, 37.0)) and (gaze.kappa < 37).all()
    # Against what eyes do: turn each sample of the heads' density by a law of κ = 37.
    rng = np.random.default_rng(1)
    x = sample(heads, 20_000, rng)
    eyes = vmf.sample(x.reshape(-1, 3), 37.0, rng).reshape(x.shape)
    y = sample(gaze, 20_000, rng)
    assert np.allclose(eyes.mean(axis=1), y.mean(axis=1), atol=0.01)
    second = lambda v: np.einsum("pni,pnj->pij", v, v) / v.shape[1]
    assert np.allclose(second(eyes), second(y), atol=0.01)
