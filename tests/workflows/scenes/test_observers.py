"""Who looks: people at a time, walks, and where most rays are."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.maths.geometry import Similarity
from nerg_mi.rays.rays import Rays
from nerg_mi.workflows.scene_cameras import eye_of_person, support_of_rays, to_place, walk_of_person

# Half as large, turned by 90 degrees about z, moved.
ALIGN = Similarity(np.array([[0, -0.5, 0, 1.0], [0.5, 0, 0, 2], [0, 0, 0.5, 3], [0, 0, 0, 1]]))


@pytest.fixture
def rays():
    t = np.array([0, 1, 2, 10, 11, 0.5])
    origin = np.array([[0, 0, 1], [1, 0, 1], [2, 0, 1], [5, 0, 1], [6, 0, 1], [9, 9, 9]], float)
    direction = np.array([[1, 0, 0], [0, 1, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 0], [0, 0, 1]], float)
    return Rays(t, [0, 0, 0, 0, 0, 1], ("Ada", "Bob", "Cy"), origin, direction, np.ones(6))


def test_the_nearest_ray_of_a_person(rays):
    eye, when = eye_of_person(rays, "Ada", 1.2, 0.5, ALIGN)
    assert when == 1
    np.testing.assert_allclose(eye.origin, [1, 2.5, 3.5])  # (1, 0, 1) turned is (0, 1, 1), half of it, moved
    np.testing.assert_allclose(eye.target - eye.origin, [-0.5, 0, 0])  # +y turned is -x, a metre is half a unit
    np.testing.assert_allclose(to_place([[1, 0, 1]], ALIGN)[0], eye.origin)


@pytest.mark.parametrize(
    "person, time, said",
    [("Eve", 0, '"Eve"'), ("Cy", 0, '"Cy" has no rays any more'), ("Ada", 5.0, "0.5.*5.*0.*11.*--gap")],
)
def test_nobody_then(rays, person, time, said):
    with pytest.raises(NergError, match=said):
        eye_of_person(rays, person, time, 0.5, Similarity())


def test_a_walk_is_interpolated(rays):
    walk = walk_of_person(rays, "Ada", 0, 2, 4, 1.0, Similarity())
    np.testing.assert_allclose(walk.times, np.arange(9) / 4)
    np.testing.assert_allclose([e.origin[0] for e in walk.eyes], np.arange(9) / 4)
    ahead = np.array([e.target - e.origin for e in walk.eyes])
    np.testing.assert_allclose(np.linalg.norm(ahead, axis=1), 1)
    np.testing.assert_allclose(ahead[2], np.array([1, 1, 0]) / np.sqrt(2))
    assert walk.missing == 0


def test_pauses_have_no_frames(rays):
    walk = walk_of_person(rays, "Ada", 1, 12, 1, 1.0, Similarity())
    assert walk.times.tolist() == [1, 2, 10, 11, 12] and walk.missing == 7
    # Opposite directions have no mean.
    turned = walk_of_person(rays, "Ada", 10, 11, 2, 1.0, Similarity())
    assert np.abs(turned.eyes[1].target - turned.eyes[1].origin).max() == 1
    with pytest.raises(NergError, match="within 1 s from 4 to 6 s"):
        walk_of_person(rays, "Ada", 4, 6, 1, 1.0, Similarity())
    with pytest.raises(NergError, match="the earlier first"):
        walk_of_person(rays, "Ada", 2, 1, 1, 1.0, Similarity())
    with pytest.raises(NergError, match="at most 100,000 frames"):
        walk_of_person(rays, "Ada", 0, 11, 1e5, 1.0, Similarity())


def test_where_most_rays_are():
    rng = np.random.default_rng(0)
    origin = np.concatenate([rng.normal((1, 2, 1.6), 0.1, (300, 3)), rng.normal((5, 5, 1.6), 0.1, (900, 3))])
    n = len(origin)
    rays = Rays(np.arange(n), np.zeros(n, int), ("a",), origin, np.tile([1.0, 0, 0], (n, 1)), np.ones(n))
    assert np.linalg.norm(support_of_rays(rays).densest() - (5, 5, 1.6)) < 0.15
