"""Tests of `nerg_mi.tracking.folds`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.tracking.folds import iter_folds, sample_participants_equally
from nerg_mi.tracking.rays import Rays

RADIUS = 0.3


def walkers(count: int = 6, each: int = 400) -> Rays:
    """Participants at random positions on a floor of 3 x 3 m, who look along x."""
    n = count * each
    origin = np.column_stack([np.random.default_rng(0).uniform(-1.5, 1.5, (n, 2)), np.full(n, 1.6)])
    person = np.repeat(np.arange(count), each)
    return Rays(np.arange(n) * 0.2, person, tuple("abcdef"[:count]), origin, np.tile([1.0, 0, 0], (n, 1)), np.ones(n))


def smallest_distance(a: Rays, b: Rays) -> float:
    return float(np.linalg.norm(a.origin[:, None] - b.origin[None], axis=2).min())


def test_participants_and_positions_are_held_out():
    folds = list(iter_folds(walkers(), RADIUS, 3))
    assert len(folds) == 3
    for fold in folds:
        assert not set(fold.train.person) & set(fold.held_out.person) and len(np.unique(fold.held_out.person)) == 2
        # 2 R from the centres, within R of which the held-out rays are.
        assert smallest_distance(fold.train, fold.held_out) > RADIUS
    assert set(np.concatenate([np.unique(fold.held_out.person) for fold in folds])) == set(range(6))


def test_only_participants_or_only_positions():
    rays = walkers()
    for fold in iter_folds(rays, RADIUS, 3, positions=False):
        assert len(fold.train) + len(fold.held_out) == len(rays)
        assert not set(fold.train.person) & set(fold.held_out.person)
    for fold in iter_folds(rays, RADIUS, 2, participants=False):
        assert set(fold.train.person) == set(fold.held_out.person) == set(range(6))
        assert smallest_distance(fold.train, fold.held_out) > RADIUS


def test_seated_participants_and_a_single_one():
    """The zones contain all rays of seated participants; of one participant, positions are held out."""
    rays = walkers()
    seated = replace(rays, origin=np.column_stack([rays.person, 0 * rays.person, 1.2 + 0 * rays.person]))
    assert [len(fold.train) for fold in iter_folds(seated, RADIUS, 3)] == [1600] * 3
    for fold in iter_folds(walkers(count=1), RADIUS, 3):
        assert 0 < len(fold.train) < 400 and 0 < len(fold.held_out) < 400


@pytest.mark.parametrize("count", [100, 10_000])
def test_samples_have_the_same_number_of_rays_of_each_participant(count):
    rays = walkers()
    few = rays.select(np.concatenate([np.arange(1200), np.arange(1200, 2400, 10)]))
    drawn = sample_participants_equally(few, count)
    counts = np.bincount(drawn.person)
    assert len(drawn) == min(count, len(few)) and (count > 100 or counts.max() < 2.5 * counts.min())
