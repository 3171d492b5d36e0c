import numpy as np
import pytest

from nerg_mi.alignment.tracking import DECLARED, compare_flips

RNG = np.random.default_rng(3)
POINTS = RNG.uniform([0, 0, 0], [6, 4, 2.5], (400, 3))
TURN = np.array([[0, -2, 0, 5], [2, 0, 0, -1], [0, 0, 2, 3], [0, 0, 0, 1.0]])  # by 90 degrees, to twice the size


def gaze(count=200, off=0.002):
    """People who look at points, to about a tenth of a degree, by eyes 15 degrees or so from where the head points."""
    origin = RNG.uniform([1, 1, 1.4], [5, 3, 1.8], (count, 3))
    to = POINTS[RNG.integers(0, len(POINTS), count)] - origin
    direction = to / np.linalg.norm(to, axis=1, keepdims=True) + RNG.normal(0, off, (count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    head = direction + RNG.normal(0, 0.15, (count, 3))
    return origin, direction, head / np.linalg.norm(head, axis=1, keepdims=True)


def moved(points):
    return points @ TURN[:3, :3].T + TURN[:3, 3]


def test_angles_are_those_of_a_loop():
    origin, direction, _ = gaze(20, 0.05)
    found = compare_flips(moved(POINTS), TURN, origin, direction).degrees
    assert set(found) == {DECLARED, *(f"{a} of the directions negated" for a in "xyz")}
    for name, signs in ((DECLARED, (1, 1, 1)), ("y of the directions negated", (1, -1, 1))):
        expected = []
        for o, d in zip(origin, direction * signs):
            cosines = [(p - o) @ d / np.linalg.norm(p - o) for p in POINTS]
            expected.append(np.degrees(np.arccos(max(cosines))))
        # Rays are looked at in another order.
        assert np.allclose(np.sort(found[name]), np.sort(expected), atol=1e-5)


def test_gaze_at_points_says_nothing():
    assert compare_flips(moved(POINTS), TURN, *gaze()).warning() is None


@pytest.mark.parametrize("axis", range(3))
def test_a_negated_axis_is_named(axis):
    origin, direction, head = gaze()
    wrong = direction * np.where(np.arange(3) == axis, -1, 1)
    assert f"with {'xyz'[axis]} of the directions negated" in str(
        compare_flips(moved(POINTS), TURN, origin, wrong).warning()
    )


@pytest.mark.parametrize("name", ["left and right", "up and down"])
def test_exchanged_eyes_are_named(name):
    origin, direction, head = gaze()
    left = np.stack([-head[:, 1], head[:, 0], np.zeros(len(head))], axis=1)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    axis = left if name == "left and right" else np.cross(head, left)
    wrong = direction - 2 * np.sum(direction * axis, axis=1, keepdims=True) * axis
    assert f"with {name} of the eyes exchanged" in str(
        compare_flips(moved(POINTS), TURN, origin, wrong, head).warning()
    )


def test_few_rays_and_chance_are_no_evidence():
    origin, direction, head = gaze(20)
    assert compare_flips(POINTS, np.eye(4), origin, direction * (1, 1, -1), head).warning() is None
    origin, _, head = gaze()
    anywhere = RNG.normal(size=(200, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    assert compare_flips(POINTS, np.eye(4), origin, anywhere, head).warning() is None


def test_heads_that_nobody_knows_are_left_out():
    origin, direction, head = gaze()
    head[:, :] = np.nan
    found = compare_flips(POINTS, np.eye(4), origin, direction, head).degrees
    assert np.array_equal(found["up and down of the eyes exchanged"], found[DECLARED])
