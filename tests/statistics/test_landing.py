"""Which things rays land on, against loops over rays and planes."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.formats.areas import Region
from nerg_mi.statistics.visits import Box, concatenate, cone, land, regroup, unite


def box(name, lower, upper, turn=None):
    return Box(Region.of(name, lower, upper, turn))


def brute(region, o, d):
    """Where a ray is inside of a box, by clipping it at six planes one after the other in the box's own frame."""
    turn = region.matrix.T
    o, d = turn @ (np.array(o, float) - region.middle), turn @ np.array(d, float)
    half = (region.corners[1] - region.corners[0]) / 2
    near, far = -np.inf, np.inf
    for axis in range(3):
        if d[axis] == 0:
            if abs(o[axis]) > half[axis]:
                return None
            continue
        a, b = (-half[axis] - o[axis]) / d[axis], (half[axis] - o[axis]) / d[axis]
        near, far = max(near, min(a, b)), min(far, max(a, b))
    return (near, far) if near < far and far > 0 else None


def some_rays(n=2000, seed=0):
    rng = np.random.default_rng(seed)
    o = rng.uniform(-3, 3, (n, 3))
    d = rng.normal(size=(n, 3))
    return o, d / np.linalg.norm(d, axis=1, keepdims=True), rng.uniform(0.2, 6, n)


def test01_surfaces_in_boxes():
    things = [
        box("a", [-1, -1, -1], [1, 0.5, 1]),
        box("b", [0, 0, 0], [2, 1, 1], 35),
        box("c", [1.5, -2, -1], [2, 2, 0]),
    ]
    o, d, depth = some_rays()
    found = land(things, o, d, depth, 0.03).matrix()
    expected = np.zeros_like(found)
    for i in range(len(o)):
        for k, thing in enumerate(things):
            span = brute(thing.region, o[i], d[i])
            if span is None:
                continue
            near, far = span
            expected[i, k] = near - 0.03 <= depth[i] < far + 0.03
    assert np.array_equal(found, expected) and 20 < expected.sum() and not expected.all(axis=1).all()
    inside = np.array([thing.region.holds(o) for thing in things]).T
    assert (inside & expected).any() and (inside & ~expected).any()


def test02_distances_are_those_of_the_entrance_or_from_within_of_the_surface():
    things = [box("a", [1, -1, -1], [2, 1, 1]), box("around", [-1, -1, -1], [3, 1, 1])]
    o, d = np.zeros((1, 3)), np.array([[1.0, 0, 0]])
    landed = land(things, o, d, np.array([1.7]))
    assert [v.tolist() for v in landed.distance] == [[1.0], [1.7]]
    # Beyond a box, or nowhere: they look through it, or out of that in which they stand.
    assert [len(v) for v in land(things, o, d, np.array([2.5])).rows] == [0, 1]
    assert [len(v) for v in land(things, o, d, np.array([3.5])).rows] == [0, 0]
    assert [len(v) for v in land(things, o, d, np.array([np.inf])).rows] == [0, 0]


def test03_without_surfaces_things_are_solid():
    front, behind, in_front = (
        box("f", [1, -1, -1], [2, 1, 1]),
        box("b", [3, -1, -1], [4, 1, 1]),
        box("i", [1.5, 0, 0], [2.5, 1, 1]),
    )
    o, d = np.array([[0, 0.5, 0.5], [0, -0.5, -0.5], [0, 5.0, 0]]), np.tile([1.0, 0, 0], (3, 1))
    found = land([front, behind, in_front], o, d, None).matrix()
    # Overlapping ones share a look, what begins behind the end of another is hidden.
    assert found.tolist() == [[True, False, True], [True, False, False], [False, False, False]]


def test04_a_box_that_is_grazed_or_behind_is_not_met():
    thing = box("a", [1, 0, 0], [2, 1, 1])
    o = np.array([[0.0, 1, 0.5], [3, 0.5, 0.5], [0, 0.5, 0.5]])
    d = np.array([[1.0, 0, 0], [1, 0, 0], [1, 0, 0]])
    assert land([thing], o, d, np.array([1.5, 0.5, 1.5])).matrix()[1:, 0].tolist() == [False, True]


def test05_groups_are_unions_at_their_least_distance():
    things = [box("a", [1, -1, -1], [2, 1, 1]), box("b", [1.5, 0, -1], [4, 1, 1])]
    o, d = np.array([[0, 0.5, 0.0], [0, -0.5, 0], [3, 0.5, -5]]), np.array([[1.0, 0, 0], [1, 0, 0], [0, 0, 1]])
    landed = regroup(land(things, o, d, np.array([1.6, 1.0, 5.0])), [(0,), (1,), (0, 1)])
    assert [rows.tolist() for rows in landed.rows] == [[0, 1], [0, 2], [0, 1, 2]]
    assert landed.distance[2].tolist() == [1.0, 1.0, 4.0]


def test06_parts_and_ways_are_put_together():
    things = [box("a", [1, -1, -1], [2, 1, 1])]
    o, d = np.zeros((2, 3)), np.array([[1.0, 0, 0], [0, 1, 0]])
    one, two = land(things, o, d, None), land(things, o, d[::-1], None)
    assert concatenate([one, two]).rows[0].tolist() == [0, 3]
    assert unite([one, two]).rows[0].tolist() == [0, 1]


@pytest.mark.parametrize("degrees", [0.5, 2.0, 10.0])
def test07_a_cone_leaves_no_hole_wider_than_half_of_it(degrees):
    d = np.array([[0, 0, 1.0], [0, 0, -1], [0.6, 0, 0.8], [0.36, -0.48, -0.8]])
    ways = np.stack(cone(d, degrees))
    assert len(ways) == 19 and np.allclose(np.linalg.norm(ways, axis=2), 1)
    angle = np.degrees(np.arccos(np.clip((ways * d).sum(axis=2), -1, 1)))
    assert np.allclose(angle[0], 0, atol=1e-5) and np.allclose(angle[1:7], degrees / 2, rtol=1e-3)
    assert np.allclose(angle[7:], degrees, rtol=1e-3)
    rng = np.random.default_rng(0)
    for k in range(len(d)):
        u = np.cross(d[k], [1, 0.3, 0.2])
        u /= np.linalg.norm(u)
        v = np.cross(d[k], u)
        r, turn = np.radians(degrees) * np.sqrt(rng.random(500)), 2 * np.pi * rng.random(500)
        within = np.cos(r)[:, None] * d[k] + np.sin(r)[:, None] * (
            np.cos(turn)[:, None] * u + np.sin(turn)[:, None] * v
        )
        nearest = np.degrees(np.arccos(np.clip(within @ ways[:, k].T, -1, 1)).min(axis=1))
        assert nearest.max() < 0.5 * degrees


def test08_samples_cover_a_box_evenly():
    thing = box("a", [0, 0, 0], [2, 1, 0.5], 20)
    points, normals = thing.samples(70)
    own = thing.region.to_own(points)
    lower, upper = thing.region.corners
    on_face = np.isclose(own, lower) | np.isclose(own, upper)
    assert (on_face.sum(axis=1) == 1).all() and ((own > lower - 1e-9) & (own < upper + 1e-9)).all()
    assert np.allclose(((points - thing.region.middle) * normals).sum(axis=1) > 0, True)
    assert 40 < len(points) < 110
