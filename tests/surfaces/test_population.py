"""Time of rays, and observers that stand for a crowd."""

import numpy as np
import pytest

from nerg_mi.rays.rays import Rays
from nerg_mi.surfaces.sources import ray_seconds, ray_weights, thin


def rays(t, person):
    n = len(t)
    return Rays(t, person, ("a", "b"), np.zeros((n, 3)), np.tile([1.0, 0, 0], (n, 1)), np.ones(n))


def test01_a_ray_stands_for_the_time_until_the_next_of_its_person():
    of = rays([0, 0.1, 0.3, 9.0, 9.1, 0.0, 0.2], [0, 0, 0, 0, 0, 1, 1])
    # Pauses count as half a second at most; the last of each as the median of theirs.
    assert np.allclose(ray_seconds(of), [0.1, 0.2, 0.5, 0.1, 0.15, 0.2, 0.2])
    assert np.allclose(ray_seconds(of, gap=0.05), 0.05)
    assert np.allclose(ray_seconds(rays([5.0], [0])), 0.5)


@pytest.mark.parametrize("by, share", [("time", 1.05 / 1.45), ("person", 0.5), ("equal", 5 / 7)])
def test02_weights_add_up_to_one(by, share):
    of = rays([0, 0.1, 0.3, 9.0, 9.1, 0.0, 0.2], [0, 0, 0, 0, 0, 1, 1])
    w = ray_weights(of, by)
    assert np.isclose(w.sum(), 1) and np.isclose(w[:5].sum(), share)


def test03_observers_stand_where_somebody_was_with_the_time_of_all_near():
    rng = np.random.default_rng(0)
    places = np.array([(0, 0, 1.6), (4, 0, 1.6), (0, 5, 1.6)])
    which = rng.choice(3, 3000, p=(0.5, 0.3, 0.2))
    positions = places[which] + rng.normal(0, 0.05, (3000, 3))
    weights = rng.random(3000)
    found = thin(positions, weights, 3, seed=1)
    expected = np.bincount(which, weights) / weights.sum()
    order = np.argsort(-found.weights)
    assert np.allclose(found.weights[order], expected[np.argsort(-expected)])
    assert all((positions == p).all(axis=1).any() for p in found.positions)
    # The error that is told is that of the positions from the nearest observer.
    near = np.linalg.norm(positions[:, None] - found.positions, axis=2).min(axis=1)
    assert np.isclose(found.mean, np.sqrt((weights * near**2).sum() / weights.sum()))
    assert abs(np.mean(near <= found.farthest) - 0.95) < 0.02
    again = thin(positions, weights, 3, seed=1)
    assert np.array_equal(again.positions, found.positions)


def test04_more_observers_are_nearer_and_fewer_places_than_observers_are_all_taken():
    positions = np.random.default_rng(2).uniform(0, 5, (2000, 3))
    errors = [thin(positions, np.ones(2000), n).mean for n in (4, 32, 256)]
    assert errors[0] > 1.5 * errors[1] > 2 * errors[2]
    few = thin(np.tile([[1.0, 2, 3], [4, 5, 6]], (50, 1)), np.ones(100), 10)
    assert len(few.weights) == 2 and few.mean == few.farthest == 0 and np.allclose(few.weights, 0.5)
