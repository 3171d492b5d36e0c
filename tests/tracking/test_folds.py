"""Tests of `nerg_mi.tracking.folds`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.tracking.folds import Fold, iter_folds, sample_participants_equally
from nerg_mi.tracking.rays import Rays

RADIUS = 0.3


def walkers(count: int = 6, each: int = 400) -> Rays:
    """Participants at random positions on a floor of 3 x 3 m, who look along x."""
    n = count * each
    origin = np.column_stack([np.random.default_rng(0).uniform(-1.5, 1.5, (n, 2)), np.full(n, 1.6)])
    person = np.repeat(np.arange(count), each)
    return Rays(np.arange(n) * 0.2, person, tuple("abcdef"[:count]), origin, np.tile([1.0, 0, 0], (n, 1)), np.ones(n))


def is_far(fold: Fold) -> np.ndarray:
    """Whether each held-out ray is farther than R from every training ray."""
    distance = np.linalg.norm(fold.held_out.origin[:, None] - fold.train.origin[None], axis=2)
    return distance.min(axis=1) > RADIUS


def test_participants_and_positions_are_held_out():
    rays = walkers()
    folds = list(iter_folds(rays, RADIUS, 3))
    assert len(folds) == 3
    for fold in folds:
        assert not set(fold.train.person) & set(fold.held_out.person) and len(np.unique(fold.held_out.person)) == 2
        np.testing.assert_array_equal(fold.is_new_position, is_far(fold))
        # People are held out with all their rays, and of the others at most a quarter.
        assert len(fold.held_out) == 800 and 0.05 < fold.is_new_position.mean() < 0.5
        assert 0.7 * 1600 < len(fold.train) < 1600 and fold.train_fraction == len(fold.train) / len(rays)
    assert set(np.concatenate([np.unique(fold.held_out.person) for fold in folds])) == set(range(6))


def test_half_of_the_samples_are_at_new_positions():
    fold = next(iter_folds(walkers(), RADIUS, 3))
    origins = set(map(tuple, fold.held_out.origin[fold.is_new_position]))
    drawn = fold.sample(40)
    assert len(drawn) == 40 and sum(tuple(o) in origins for o in drawn.origin) == 20
    counts = np.bincount(drawn.person)
    assert counts[counts > 0].min() > 10
    # Without new positions, all are at recorded ones.
    recorded = next(iter_folds(walkers(), RADIUS, 3, positions=False))
    assert len(recorded._replace(is_new_position=np.zeros(800, bool)).sample(40)) == 40


def test_only_participants_or_only_positions():
    rays = walkers()
    for fold in iter_folds(rays, RADIUS, 3, positions=False):
        assert len(fold.train) + len(fold.held_out) == len(rays)
        assert not set(fold.train.person) & set(fold.held_out.person)
    for fold in iter_folds(rays, RADIUS, 2, participants=False):
        assert set(fold.train.person) == set(fold.held_out.person) == set(range(6))
        assert fold.is_new_position.all() and is_far(fold).all()


def test_seated_participants_and_a_single_one():
    """Where others sit, nothing can be held out; of one participant, positions are held out."""
    rays = walkers()
    seated = replace(rays, origin=np.column_stack([rays.person, 0 * rays.person, 1.2 + 0 * rays.person]))
    for fold in iter_folds(seated, RADIUS, 3):
        assert len(fold.train) == 1600 and fold.is_new_position.all()
    for fold in iter_folds(walkers(count=1), RADIUS, 3):
        assert 0 < len(fold.train) < 400 and 0 < len(fold.held_out) < 400


@pytest.mark.parametrize("count", [100, 10_000])
def test_samples_have_the_same_number_of_rays_of_each_participant(count):
    rays = walkers()
    few = rays.select(np.concatenate([np.arange(1200), np.arange(1200, 2400, 10)]))
    drawn = sample_participants_equally(few, count)
    counts = np.bincount(drawn.person)
    assert len(drawn) == min(count, len(few)) and (count > 100 or counts.max() < 2.5 * counts.min())


def test_a_single_fold_of_participants_has_no_training_rays():
    assert list(iter_folds(walkers(), RADIUS, 1)) == []
