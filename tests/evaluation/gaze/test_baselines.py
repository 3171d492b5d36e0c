import numpy as np
import pytest

from nerg_mi.evaluation import gaze, metrics
from nerg_mi.maths import vmf
from nerg_mi.maths.sphere import fibonacci_directions, uniform_directions
from nerg_mi.probes.probes import place_probes
from nerg_mi.rays.rays import Rays
from tests.reference.kde import kde as reference

X = fibonacci_directions(1024)


@pytest.fixture(scope="module")
def rays():
    """People who look at one thing in the middle of the room."""
    rng = np.random.default_rng(1)
    origin = rng.uniform([0, 0, 1.5], [4, 4, 1.6], (9000, 3))
    to = np.array([2.0, 2.0, 1.0]) - origin
    mu = to / np.linalg.norm(to, axis=1, keepdims=True)
    n = len(mu)
    return Rays(np.arange(n) * 1.0, np.zeros(n), ("a",), origin, vmf.sample(mu, 40.0, rng), np.ones(n))


def test_position_blind_is_the_kde_of_all(rays):
    density = gaze.position_blind(rays, kappa=30.0, backend="llvm")(np.zeros((3, 3)), X)
    want = reference(X, rays.direction, [0, len(rays)], [30.0])
    assert density.shape == (3, 1024) and np.allclose(density, want, rtol=2e-4)
    own = gaze.position_blind(rays, kappa=30.0, backend="llvm")(np.zeros((2, 3)), np.stack([X, X[::-1]]))
    assert np.allclose(own[0], own[1, ::-1], rtol=1e-5)


def test_nearest_probes(rays):
    probes = place_probes(rays, 0.4, count=50, kappa_rule="fixed", kappa=20.0)
    density = probes.density(X, "llvm")
    one = gaze.nearest_probes(probes, 1, backend="llvm")(probes.positions[:5], X)
    assert np.allclose(one, density[:5], rtol=1e-5)
    at = np.array([[1.0, 1.0, 1.55]])
    near = np.argsort(np.linalg.norm(probes.positions - at, axis=1))[:4]
    four = gaze.nearest_probes(probes, 4, backend="llvm")
    assert np.allclose(four(at, X)[0], density[near].mean(axis=0), rtol=1e-5)
    assert np.allclose(four(at, X[None])[0], four(at, X)[0], rtol=1e-5)
    # Averaged in float64 either way: float32 would lose digits of what differs little.
    assert four(at, X).dtype == four(at, X[None]).dtype == np.float64


def test_nearest_rays(rays):
    at = np.array([[1.0, 1.0, 1.55], [3.0, 2.0, 1.55]])
    density = gaze.nearest_rays(rays, 300, kappa=20.0, backend="llvm")(at, X)
    near = np.argsort(np.linalg.norm(rays.origin - at[1], axis=1))[:300]
    assert np.allclose(density[1], reference(X, rays.direction[near], [0, 300], [20.0])[0], rtol=2e-4)


def test_all_integrate_to_one_and_position_helps(rays):
    rng = np.random.default_rng(0)
    at = rng.uniform([0.5, 0.5, 1.5], [3.5, 3.5, 1.6], (12, 3))
    to = np.array([2.0, 2.0, 1.0]) - at
    truth = np.exp(vmf.log_density(X, (to / np.linalg.norm(to, axis=1, keepdims=True))[:, None], 40.0))
    probes = place_probes(rays, 0.4, count=200, kappa_rule="fixed", kappa=20.0)
    scores = {}
    for name, baseline in {
        "uniform": gaze.uniform(),
        "blind": gaze.position_blind(rays, backend="llvm"),
        "probes": gaze.nearest_probes(probes, 4, backend="llvm"),
        "rays": gaze.nearest_rays(rays, 256, backend="llvm"),
    }.items():
        density = baseline(at, X)
        assert np.allclose(density.mean(axis=1) * 4 * np.pi, 1, atol=1e-3)
        scores[name] = metrics.cc(truth, density).mean()
    assert scores["uniform"] == 0 and scores["blind"] < 0.5 < 0.7 < min(scores["probes"], scores["rays"])


def test_own_directions_of_nearest_rays(rays):
    rng = np.random.default_rng(0)
    at, own = rays.origin[:70], uniform_directions(70 * 8, rng).reshape(70, 8, 3)
    f = gaze.nearest_rays(rays, 100, backend="llvm")
    assert np.allclose(f(at, own)[66], f(at[66:67], own[66])[0], rtol=1e-5)


@pytest.mark.parametrize("weights", ["distance", "person"])
def test_probes_keep_their_weights(rays, weights):
    """What a probe weighs its rays by is part of its density, for one probe and for several."""
    one = lambda w: np.concatenate([np.zeros(8000), np.arange(1, 1001) % 7]).astype(int) if w else np.zeros(9000, int)
    people = Rays(rays.t, one(True), tuple("abcdefg"), rays.origin, rays.direction, np.ones(9000))
    probes = place_probes(people, 0.4, count=50, kappa_rule="fixed", kappa=20.0, weights=weights)
    assert probes.weights is not None and np.ptp(probes.weights) > 0
    density = probes.density(X, "llvm")
    plain = place_probes(people, 0.4, count=50, kappa_rule="fixed", kappa=20.0).density(X, "llvm")
    assert np.abs(density - plain).max() > 0.02
    at = probes.positions[:4]
    assert np.allclose(gaze.nearest_probes(probes, 1, backend="llvm")(at, X), density[:4], rtol=1e-4, atol=1e-5)
    near = np.argsort(np.linalg.norm(probes.positions - at[0], axis=1))[:3]
    assert np.allclose(
        gaze.nearest_probes(probes, 3, backend="llvm")(at[:1], X)[0], density[near].mean(axis=0), rtol=1e-4, atol=1e-5
    )


def test_the_standard_ones_are_what_they_are_called(rays):
    blind, named = gaze.standard_baselines(rays, 0.4, count=60)
    at = np.array([[1.0, 1.0, 1.55], [3.0, 2.0, 1.55]])
    assert np.allclose(blind(at, X), named["position-blind, kappa 50"](at, X))
    assert np.allclose(blind(at, X)[0], reference(X, rays.direction, [0, len(rays)], [50.0])[0], rtol=2e-4)
    # Without a say, one alone has the width that it has among the others.
    assert np.allclose(blind(at, X), gaze.position_blind(rays)(at, X), rtol=1e-6)
    assert np.allclose(named["uniform"](at, X), 1 / (4 * np.pi))
    assert np.allclose(named["4,096 nearest rays"](at, X), gaze.nearest_rays(rays, 4096, kappa=20.0)(at, X))


def test_a_remembered_density_is_asked_once_for_the_same_arrays():
    asked = []
    method = gaze.Remembered(lambda *given: asked.append(1) or gaze.uniform()(*given))
    positions, directions = np.zeros((2, 3)), fibonacci_directions(8)
    first = method(positions, directions)
    assert method(positions, directions) is first and len(asked) == 1
    # Equal values are not the same arrays: they are not compared.
    np.testing.assert_array_equal(method(positions.copy(), directions), first)
    assert len(asked) == 2
    with pytest.raises(ValueError, match="read-only"):
        first[0] = 0
