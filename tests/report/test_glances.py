"""What people could look at, in a hall of four walls where depths are known in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_product import GazeConfig, GazeField
from nerg_mi.fields.mlp import namespace
from nerg_mi.formats.areas import Region
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.rays.rays import Rays
from nerg_mi.report.data import Onlooker, eyes_of, land_rays
from nerg_mi.statistics.visits import Box as Solid
from nerg_mi.train.geometry import GazePlace
from nerg_mi.transport.geometry import Place
from tests.evaluation.gaze.test_evaluation import crowd

LOW, HIGH = np.array([-2.0, -6.0, 0.0]), np.array([2.0, 6.0, 3.0])


@pytest.fixture
def hall(rgb):
    """An onlooker, and the place: the inside of a box in metres, with a random field."""
    to_world = rgb.ScalarTransform4f().translate((0.5 * (LOW + HIGH)).tolist()).scale((0.5 * (HIGH - LOW)).tolist())
    scene = rgb.load_dict({"type": "scene", "box": {"type": "cube", "to_world": to_world, "flip_normals": True}})
    box = Box(tuple(LOW), tuple(HIGH))
    config = GazeConfig(grid=HashGridConfig(levels=4, log2_rows=10, base=4, finest=16), width=16, normalized=True)
    field = GazeField.random(config, box, namespace(rgb.variant()), 3)
    place = GazePlace(Place(None, scene), box, "scene")
    return Onlooker(field, place), place


def things(boxes):
    return [Solid(box) for box in boxes], [(k,) for k in range(len(boxes))]


def to_wall(o, d):
    """Distance from ``o`` within the box to its walls along ``d``, axis by axis."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(d == 0, np.inf, np.where(d > 0, (HIGH - o) / d, (LOW - o) / d)).min(axis=-1)


def test_all_around_an_eye(hall):
    onlooker, _ = hall
    d = fibonacci_directions(512)
    for eye in np.array([[0.3, -2.0, 1.6], [-1.0, 4.0, 1.5]]):
        (gaze,), distance = onlooker.look_from(eye)(d)
        assert np.allclose(distance, to_wall(eye, d), atol=1e-4)
        assert np.allclose(gaze, onlooker.density(eye, d), rtol=1e-5) and np.ptp(gaze) > 0


def test_gaze_on_points_is_the_density_where_nothing_hides_them(hall):
    onlooker, _ = hall
    eye = np.array([0.3, -2.0, 1.6])
    on_wall, behind = np.array([2.0, 1.0, 1.0]), np.array([4.0, 4.0, 0.4])
    points = np.array([on_wall, behind])
    away = points - eye
    direction = away / np.linalg.norm(away, axis=1, keepdims=True)
    found = onlooker.on_points(eye, points, 0.02)
    assert found[0] == pytest.approx(onlooker.density(eye, direction)[0], rel=1e-5) and found[0] > 0
    assert found[1] == 0


def test_an_integral_of_few_directions_is_enough_for_a_picture(hall):
    onlooker, _ = hall
    d = fibonacci_directions(8192)
    assert 4 * np.pi * onlooker.density(np.array([0.3, -2.0, 1.6]), d).mean() == pytest.approx(1, abs=0.02)


def test_eyes_are_as_many_of_each_person(hall):
    _, place = hall
    rays = crowd(1000)
    eyes = eyes_of(rays, place, 12)
    assert np.bincount(eyes.person).tolist() == [3, 3, 3, 3]
    times = [np.flatnonzero((rays.origin == p).all(axis=1))[0] for p in eyes.positions[eyes.person == 0]]
    assert (np.diff(times) > 200).all()  # spread over the whole of the time
    few = eyes_of(rays, place, 2)
    assert len(few.positions) == 2 and len(set(few.person)) == 2


def test_eyes_are_spread_over_whole_visits(hall):
    """People walk from one end to the other: one eye of each must not be that in the middle of everybody's way."""
    _, place = hall
    people, each = 40, 50
    walked = np.tile(np.linspace(-5, 5, each), people)
    origin = np.stack([np.zeros_like(walked), walked, np.full_like(walked, 1.6)], axis=1)
    person, t = np.repeat(np.arange(people), each), np.tile(np.arange(each, dtype=float), people)
    names = tuple(f"p{k}" for k in range(people))
    rays = Rays(t, person, names, origin, np.tile([1.0, 0, 0], (len(t), 1)), np.ones(len(t)))
    for most in (people, 3 * people):
        along = np.sort(eyes_of(rays, place, most).positions[:, 1])
        assert len(along) == most and np.abs(along - np.linspace(-5, 5, most)).max() < 0.5


def test_rays_end_at_their_own_points_or_at_the_place(hall):
    onlooker, place = hall
    rays = crowd(300)
    rows = np.linspace(0, 299, 100).round().astype(int)
    boxes = [Region.of("left", (-9, -9, -9), (9, 0.1, 9)), Region.of("low", (-9, -9, -9), (9, 9, 1.2))]
    landed, person = land_rays(rays, place, onlooker, 100, *things(boxes), 0.0)
    assert landed.count == 100 and np.array_equal(person, rays.person[rows])
    expected = [np.flatnonzero(box.holds(rays.hit[rows])) for box in boxes]
    assert all(np.array_equal(a, b) and len(b) for a, b in zip(landed.rows, expected))
    landed, _ = land_rays(replace(rays, hit=None), place, onlooker, 300, *things(boxes), 0.0)
    inside = np.flatnonzero(((rays.origin > LOW) & (rays.origin < HIGH)).all(axis=1))
    met = rays.origin + to_wall(rays.origin, rays.direction)[:, None] * rays.direction
    for box, found in zip(boxes, landed.rows):
        assert np.array_equal(np.intersect1d(found, inside), inside[box.holds(met[inside])])


def test_rays_of_another_frame(hall, rgb):
    """Turned by 90 degrees about z, twice as large and moved."""
    onlooker, place = hall
    matrix = np.array([[0, -0.1, 0, 1], [0.1, 0, 0, 0], [0, 0, 0.1, 0.5], [0, 0, 0, 1.0]])
    turned = GazePlace(place.medium, place.box, "scene", align=Similarity(matrix))
    rays = crowd(50)
    eyes = eyes_of(rays, turned, 4)
    every = rays.origin @ matrix[:3, :3].T + matrix[:3, 3]
    assert all(np.isclose(every, e).all(axis=1).any() for e in eyes.positions)
    box = Region.of("some", (-9, -9, -9), (9, 9, 0.65))
    landed, _ = land_rays(rays, turned, onlooker, 50, *things([box]), 0.0)
    expected = np.flatnonzero(box.holds(rays.hit @ matrix[:3, :3].T + matrix[:3, 3]))
    assert np.array_equal(landed.rows[0], expected) and 0 < len(expected) < 50


def test_where_no_place_is_known_nothing_is_met(rgb):
    box = Box((-2.0,) * 3, (2.0,) * 3)
    grid = HashGridConfig(levels=2, log2_rows=8, base=4, finest=8)
    field = GazeField.random(GazeConfig(grid=grid, width=16), box, namespace(rgb.variant()), 1)
    onlooker = Onlooker(field, GazePlace(None, box, "none"))
    depth, met = onlooker.meet(np.zeros((3, 3)), np.eye(3))
    assert not met.any() and not depth.any()
