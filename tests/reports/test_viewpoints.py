"""Viewpoints of a report, and paths of participants."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.environment.environment import Environment
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.reports.data import MAX_PATH_POINTS
from nerg_mi.reports.viewpoints import collect_paths, count_participants_near, find_free_positions, panorama_positions
from nerg_mi.tracking.rays import Rays

BOX = Box((0.0, 0.0, 0.0), (8.0, 6.0, 3.0))
PLACE = Environment(None, BOX, "none")


class Walls:
    """A gaze sampler in a box with a block in its middle."""

    BLOCK = np.array([[3.0, 2.0, 0.0], [5.0, 4.0, 3.0]])

    def trace(self, o, d):
        low, high = np.array(BOX.lower), np.array(BOX.upper)
        with np.errstate(divide="ignore", invalid="ignore"):
            out = np.where(d == 0, np.inf, np.where(d > 0, (high - o) / d, (low - o) / d)).min(axis=1)
            a, b = ((c - o) / d for c in self.BLOCK)
            near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        within = (near < far) & (far > 0)
        return np.where(within, np.maximum(near, 0), out), np.ones(len(o), bool)


def walkers(count=4, n=400):
    """Participants who walk along x for n steps of 2 cm, ten per second."""
    t = np.tile(np.arange(n) * 0.1, count)
    person = np.repeat(np.arange(count), n)
    origin = np.stack([np.tile(np.arange(n) * 0.02, count), 1.0 + person, np.full(n * count, 1.6)], axis=1)
    ahead = np.tile([1.0, 0, 0], (n * count, 1))
    return Rays(t, person, tuple("abcdefgh"[:count]), origin, ahead, np.ones(n * count))


def test_free_positions_are_inside_the_room_and_outside_the_block():
    positions = find_free_positions(
        Walls(), (np.zeros(3), np.array([8.0, 6, 3])), np.array([0.0, 0, 1]), np.array([1.0, 1, 1.6])
    )
    assert len(positions) > 30 and np.allclose(positions[:, 2], 1.6)
    inside = ((positions[:, :2] > [2.9, 1.9]) & (positions[:, :2] < [5.1, 4.1])).all(axis=1)
    assert not inside.any() and (positions > 0.1).all() and (positions[:, 0] < 7.9).all()


def test_panoramas_start_at_the_observer():
    standing = np.stack([np.linspace(0, 8, 50), np.zeros(50), np.full(50, 1.6)], axis=1)
    positions = panorama_positions(standing, np.array([4.0, 0, 1.6]), 3)
    assert np.allclose(positions, [[4, 0, 1.6], [0, 0, 1.6], [8, 0, 1.6]]) or np.allclose(
        positions, [[4, 0, 1.6], [8, 0, 1.6], [0, 0, 1.6]]
    )
    assert len(panorama_positions(standing[:0], np.zeros(3))) == 1


def test_participants_nearby_are_counted_instead_of_rays():
    rays = walkers()
    positions = np.array([[2.0, 1.0, 1.6], [2.0, 1.5, 1.6], [2.0, 9.0, 1.6]])
    assert count_participants_near(rays, positions, PLACE, 0.55) == (1, 2, 0)
    # In a scene with another unit the radius is still in metres.
    scaled = replace(PLACE, align=Similarity(np.diag([0.1, 0.1, 0.1, 1.0])))
    assert count_participants_near(rays, 0.1 * positions, scaled, 0.55) == (1, 2, 0)


def test_paths_follow_participants_with_gaps():
    rays = walkers(2)
    gap = rays.select(~((rays.person == 0) & (rays.t > 10) & (rays.t < 14)))
    paths = collect_paths(gap, PLACE)
    assert len(paths) == 3
    for path in paths:
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        assert (steps < 0.2).all() and (steps[1:] > 0.1).all() and np.ptp(path[:, 1]) == 0
    assert max(path[:, 0].max() for path in paths) == pytest.approx(7.98, abs=0.16)


def test_a_standing_participant_has_no_path():
    rays = walkers(1)
    assert collect_paths(replace(rays, origin=np.tile([1.0, 1, 1.6], (len(rays), 1))), PLACE) == []


def test_paths_are_limited_in_size():
    rays = walkers(8, 40_000)
    paths = collect_paths(rays, PLACE)
    assert 0 < sum(map(len, paths)) <= MAX_PATH_POINTS and all(len(p) > 1 for p in paths)
