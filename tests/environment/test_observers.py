"""Observers of written scenes: participants at a time, walks, and the position with most rays."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.environment.observers import find_eye, interpolate_walk, support_of_rays, to_scene_frame
from nerg_mi.errors import NergError
from nerg_mi.maths.geometry import Similarity
from nerg_mi.tracking.rays import Rays

# Half as large, turned by 90 degrees about z, moved.
ALIGN = Similarity(np.array([[0, -0.5, 0, 1.0], [0.5, 0, 0, 2], [0, 0, 0.5, 3], [0, 0, 0, 1]]))


@pytest.fixture
def rays():
    t = np.array([0, 1, 2, 10, 11, 0.5])
    origin = np.array([[0, 0, 1], [1, 0, 1], [2, 0, 1], [5, 0, 1], [6, 0, 1], [9, 9, 9]], float)
    direction = np.array([[1, 0, 0], [0, 1, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 0], [0, 0, 1]], float)
    return Rays(t, [0, 0, 0, 0, 0, 1], ("Ada", "Bob", "Cy"), origin, direction, np.ones(6))


def test_the_nearest_ray_of_a_person(rays):
    eye, when = find_eye(rays, "Ada", 1.2, ALIGN)
    assert when == 1
    np.testing.assert_allclose(eye.origin, [1, 2.5, 3.5])  # (1, 0, 1) turned is (0, 1, 1), half of it, moved
    np.testing.assert_allclose(eye.target - eye.origin, [-0.5, 0, 0])  # +y turned is -x, a metre is half a unit
    np.testing.assert_allclose(to_scene_frame([[1, 0, 1]], ALIGN)[0], eye.origin)


@pytest.mark.parametrize(
    "person, time, said",
    [
        ("Eve", 0, "Eve"),
        ("Cy", 0, "has no rays; choose another person"),
        ("Ada", 5.0, "within 2 s at 5 s; its rays are from 0 to 11 s"),
    ],
)
def test_a_time_without_participants_is_refused(rays, person, time, said):
    with pytest.raises(NergError, match=said):
        find_eye(rays, person, time, Similarity())


def test_a_walk_is_interpolated(rays):
    walk = interpolate_walk(rays, "Ada", 0, 2, 4, Similarity())
    np.testing.assert_allclose(walk.times, np.arange(9) / 4)
    np.testing.assert_allclose([e.origin[0] for e in walk.eyes], np.arange(9) / 4)
    ahead = np.array([e.target - e.origin for e in walk.eyes])
    np.testing.assert_allclose(np.linalg.norm(ahead, axis=1), 1)
    np.testing.assert_allclose(ahead[2], np.array([1, 1, 0]) / np.sqrt(2))
    assert walk.missing == 0


def test_pauses_have_no_frames(rays):
    walk = interpolate_walk(rays, "Ada", 1, 12, 1, Similarity())
    assert walk.times.tolist() == [1, 2, 10, 11, 12] and walk.missing == 7
    # Opposite directions have no mean.
    turned = interpolate_walk(rays, "Ada", 10, 11, 2, Similarity())
    assert np.abs(turned.eyes[1].target - turned.eyes[1].origin).max() == 1
    with pytest.raises(NergError, match="within 2 s from 5 to 6 s"):
        interpolate_walk(rays, "Ada", 5, 6, 1, Similarity())
    with pytest.raises(NergError, match="the earlier first"):
        interpolate_walk(rays, "Ada", 2, 1, 1, Similarity())
    with pytest.raises(NergError, match="at most 100,000 frames"):
        interpolate_walk(rays, "Ada", 0, 11, 1e5, Similarity())


def test_the_densest_viewpoint_is_selected():
    rng = np.random.default_rng(0)
    origin = np.concatenate([rng.normal((1, 2, 1.6), 0.1, (300, 3)), rng.normal((5, 5, 1.6), 0.1, (900, 3))])
    n = len(origin)
    rays = Rays(np.arange(n), np.zeros(n, int), ("a",), origin, np.tile([1.0, 0, 0], (n, 1)), np.ones(n))
    assert np.linalg.norm(support_of_rays(rays).find_densest_position() - (5, 5, 1.6)) < 0.15
