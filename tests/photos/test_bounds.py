"""The scene box around an object, in a room and around points; and cameras that see what no other does."""

import numpy as np
import pytest

from nerg_mi.maths.geometry import Box
from nerg_mi.photos.cameras import Camera, Intrinsics
from nerg_mi.photos.dataset import place_extent, scene_box, unmatched

LENS = Intrinsics(10, 10, 10.0, 10.0, 5.0, 5.0)


def looking(center, at):
    z = np.subtract(center, at) / np.linalg.norm(np.subtract(center, at))
    x = np.cross([0, 0.3, 1.0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), center
    return Camera(LENS, pose)


def directions(count, seed=4):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


AROUND = [looking(np.array([1, 2, 3]) + 4 * d, [1, 2, 3]) for d in directions(20)]
INSIDE = [looking(c, c + d) for c, d in zip(np.random.default_rng(4).uniform(0, 4, (20, 3)), directions(20))]


def test_around_an_object():
    box, _ = scene_box(AROUND)
    assert np.allclose(box.center, [1, 2, 3], atol=1e-6) and box.side == pytest.approx(10)
    assert scene_box(AROUND, object_only=True)[0].side == pytest.approx(4)


def test_in_a_room():
    box, how = scene_box(INSIDE)
    assert "around the cameras" in how
    assert np.all(np.array(box.lower) < 0) and np.all(np.array(box.upper) > 4)


def test_at_one_point():
    with pytest.raises(ValueError, match="--aabb"):
        scene_box([looking(np.zeros(3), d) for d in directions(5)])


def walls(count=4000):
    """Points on the walls of a room of 6 x 5 x 3."""
    p = np.random.default_rng(5).uniform(0, 1, (count, 3))
    side = np.random.default_rng(6).integers(0, 3, count)
    p[np.arange(count), side] = np.round(p[np.arange(count), side])
    return p * [6, 5, 3] - 1


def test_points_on_the_walls_of_a_room_give_its_box():
    """Stray points behind mirrors and windows do not widen it; the walls lie inside by a few percent."""
    strays = np.random.default_rng(7).uniform(-60, 60, (12, 3))
    box, how = scene_box(INSIDE, points=np.concatenate([walls(), strays]))
    assert "points" in how
    assert np.all(np.array(box.lower) < -1) and np.all(np.array(box.lower) > -1.5)
    assert np.all(np.array(box.upper) > [5, 4, 2]) and np.all(np.array(box.upper) < [5.5, 4.5, 2.5])


def test_points_far_behind_an_object_do_not_count():
    far = 300 * directions(500, 8)
    near = np.array([1, 2, 3]) + directions(2000, 9)
    box, _ = scene_box(AROUND, points=np.concatenate([far, near]))
    assert box.side == pytest.approx(10)
    assert scene_box(AROUND, points=near)[0].side == pytest.approx(2.2, rel=0.02)


def test_few_points_are_no_evidence():
    assert "cameras" in scene_box(INSIDE, points=walls(50))[1]


def test_a_camera_that_sees_what_no_other_does_is_found():
    box = Box((-3, -3, -3), (5, 7, 9))
    assert unmatched(AROUND, box) == []
    away = looking(np.array([1, 2, 8.9]), [1, 2, 30])
    ring = [looking(np.array([1 + 4 * np.cos(a), 2 + 4 * np.sin(a), 3]), [1, 2, 3]) for a in np.arange(0, 6, 0.5)]
    assert unmatched([*ring[:4], away, *ring[4:]], Box((-3, -3, -3), (5, 7, 40))) == [4]
    outside = looking(np.array([100.0, 0, 0]), [200, 0, 0])
    assert unmatched([*AROUND, outside], box) == [20]


def test_an_object_before_nothing_ends_at_its_box():
    extent = place_extent(AROUND, object_only=True)
    assert extent.kind == "object" and not extent.box.contracted and extent.box == scene_box(AROUND, True)[0]


def test_a_room_ends_at_its_walls_in_spite_of_strays():
    strays = np.random.default_rng(7).uniform(-60, 60, (12, 3))
    extent = place_extent(INSIDE, points=np.concatenate([walls(), strays]))
    assert extent.kind == "room" and not extent.box.contracted and "0.3 % of the points" in extent.why


def test_a_place_whose_points_lie_beyond_its_box_has_no_end():
    near, far = (
        1 + np.random.default_rng(8).uniform(0, 2, (900, 3)),
        np.random.default_rng(9).uniform(-90, 90, (100, 3)),
    )
    extent = place_extent(AROUND, points=np.concatenate([near, far]))
    assert extent.kind == "unbounded" and extent.box.contracted and "% of the points on surfaces lie" in extent.why
    # Nine tenths of the points lie within the box that the cameras bound, whose longest edge is the core's.
    box = scene_box(AROUND, points=np.concatenate([near, far]))[0]
    assert extent.box.side == pytest.approx(box.side) and np.allclose(extent.box.center, box.center)


def test_the_core_holds_nine_tenths_of_the_points_within_reason():
    points = np.random.default_rng(9).uniform(-20, 20, (4000, 3)) + [1, 2, 3]
    extent = place_extent(AROUND, points=points)
    inside = np.all((points > extent.box.core.lower) & (points < extent.box.core.upper), axis=1)
    assert extent.kind == "unbounded" and inside.mean() == pytest.approx(0.9, abs=0.01)
    assert place_extent(AROUND, points=points * 100).box.side == pytest.approx(4 * 10)


def test_a_few_points_far_away_do_not_make_a_room_of_a_street():
    far = np.random.default_rng(10).uniform(-400, 400, (200, 3))
    extent = place_extent(INSIDE, points=np.concatenate([walls(3800), far]))
    assert extent.kind == "unbounded" and "nine tenths" in extent.how and extent.box.side < 12


def test_where_nothing_tells_a_place_ends_at_its_box():
    for cameras in (AROUND, INSIDE):
        extent = place_extent(cameras)
        assert extent.kind == "room" and extent.box == scene_box(cameras)[0] and "no points" in extent.why


def facing(distance):
    """Cameras side by side before a wall with points, in the plane y = 0."""
    cameras = [looking(np.array([x, -distance, 1.0]), np.array([x, 0.0, 1.0])) for x in np.linspace(-1, 1, 9)]
    points = np.random.default_rng(0).uniform([-2, -0.1, 0], [2, 0.1, 2], (2000, 3))
    return cameras, points


def test_what_stands_between_cameras_and_points_is_within_the_box():
    """It may have no points: a plain wall, a blurred frame at the border of a photo."""
    cameras, points = facing(2)
    centers = np.array([c.center for c in cameras])
    extent = place_extent(cameras, points=points)
    assert extent.kind == "room" and extent.how.endswith("and the cameras") and not extent.box.contracted
    for p in np.concatenate([centers, 0.5 * (centers + [0, 0, 1])]):
        assert np.all(p >= np.subtract(extent.box.lower, 1e-9)) and np.all(p <= extent.box.upper)
    # The wall itself ends where its points do.
    assert extent.box.upper[1] < 0.4


def test_cameras_far_outside_of_the_points_make_a_place_without_an_end():
    cameras, points = facing(30)
    extent = place_extent(cameras, points=points)
    assert extent.kind == "unbounded" and extent.box.contracted and "far outside" in extent.why
    assert extent.box.core.side < 6


def test_nothing_stands_before_what_depth_shows():
    cameras, points = facing(2)
    box = place_extent(cameras, points=points, complete=True).box
    assert box == scene_box(cameras, points=points)[0] and box.lower[1] > -1


def test_cameras_within_leave_a_box_as_it_is():
    centers = np.random.default_rng(4).uniform(0, 1.5, (20, 3))
    cameras = [looking(c, c + d) for c, d in zip(centers, directions(20))]
    extent = place_extent(cameras, points=walls())
    assert extent.box == scene_box(cameras, points=walls())[0] and "cameras" not in extent.how


def test_points_just_beyond_the_others_are_within_the_box_and_strays_are_not():
    """Plain parts of a place have few points, which are no strays for that."""
    few, strays = np.tile([[8.0, 2, 0.5]], (12, 1)), np.full((3, 3), 40.0)
    box, _ = scene_box(INSIDE, points=np.concatenate([walls(), few, strays]))
    assert 8 < box.upper[0] < 9 and box.upper[1] < 5 and box.upper[2] < 3
