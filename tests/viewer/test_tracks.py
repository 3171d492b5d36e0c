"""Paths of people, and where they are at a moment."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.maths.geometry import Similarity
from nerg_mi.rays.rays import Rays
from nerg_mi.viewer.session import ALL, GAP, Tracks

SAME = Similarity(np.eye(4))


def walk(align=SAME, cohorts=True):
    """Ada walks along x for 10 s, with a gap of 3 s in it; Ben stands for 2 s. Rays are out of order."""
    t = np.concatenate([np.arange(0, 4, 0.1), np.arange(7, 10, 0.1), np.arange(0, 2, 0.1)])
    person = np.concatenate([np.zeros(70, int), np.ones(20, int)])
    origin = np.stack([np.where(person == 0, t, 5.0), np.zeros(90), np.full(90, 1.6)], axis=1)
    direction = np.tile([0.0, 1.0, 0.0], (90, 1))
    mixed = np.random.default_rng(3).permutation(90)
    more = dict(cohort=person[mixed], cohorts=("grown", "small")) if cohorts else {}
    rays = Rays(t[mixed], person[mixed], ("Ada", "Ben"), origin[mixed], direction[mixed], np.ones(90), **more)
    return Tracks(rays, align)


def test01_a_gap_ends_a_path():
    segments, person = walk().segments()
    assert len(segments) == 39 + 29 + 19 and segments.shape[1:] == (2, 3)
    ada = segments[person == 0]
    assert np.allclose(ada[:, 1, 0] - ada[:, 0, 0], 0.1, atol=1e-4)
    assert np.allclose(segments[person == 1][..., 0], 5)


def test02_a_moment():
    tracks = walk()
    assert tracks.times == (0.0, pytest.approx(9.9)) and tracks.people == ["Ada", "Ben"]
    poses = {p.person: p for p in tracks.at_time(1.0)}
    assert set(poses) == {"Ada", "Ben"} and np.allclose(poses["Ada"].at, [1, 0, 1.6], atol=1e-6)
    assert np.allclose(poses["Ada"].ahead, [0, 1, 0])
    assert [p.person for p in tracks.at_time(8.0)] == ["Ada"]
    assert tracks.at_time(5.45 + 0 * GAP) == [] and tracks.at_time(99.0) == []


def test03_cohorts():
    tracks = walk()
    assert tracks.groups == [ALL, "grown", "small"]
    assert [p.person for p in tracks.at_time(1.0, "small")] == ["Ben"]
    assert len(tracks.segments("small")[0]) == 19
    assert walk(cohorts=False).groups == [ALL]


def test04_in_the_place():
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2 * turn, [10, 0, 0]
    (ada,) = walk(Similarity(matrix)).at_time(8.0)
    assert np.allclose(ada.at, [10, 16, 3.2], atol=1e-6) and np.allclose(ada.ahead, [-1, 0, 0], atol=1e-6)
