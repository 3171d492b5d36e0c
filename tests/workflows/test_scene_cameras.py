"""Tests of `nerg_mi.workflows.scene_cameras`."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overview import PinholeFrame, SeenSurfaces
from nerg_mi.maths.geometry import Similarity, box_interval
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.scene import load_scene
from nerg_mi.rendering.scene_writer import Eye, GazeFiles, Lens, SceneContent, SceneText, element
from nerg_mi.workflows.scene_cameras import (
    Probe,
    best_camera,
    best_photo,
    eye_of_person,
    given_point,
    probe_values,
    support_of_rays,
    to_place,
    turned_ahead,
    upright,
    walk_of_person,
)
from nerg_mi.workflows.scene_places import PhotoCamera

# ---- What is looked around with before a camera is chosen: directions, depths and bounds of a known room ----


EYE = Eye(np.array([0.3, -0.2, 0.1]), np.array([1.0, 0.6, 0.4]))


@pytest.fixture
def probe(rgb, tmp_path):
    """A cube of ±1, whose up is +y."""
    up = np.array([0.0, 1, 0])
    place = SceneContent(beside=(element("shape", type="cube"),))
    (tmp_path / "a.xml").write_text(SceneText(place, GazeFiles(), EYE, EYE, up).xml())
    return Probe(load_scene(tmp_path / "a.xml", probe_values()), None, up)


def test_what_is_met_around(probe):
    seen = probe.around(EYE)
    _, far = box_interval(np.broadcast_to(EYE.origin, seen.directions.shape), seen.directions, -np.ones(3), np.ones(3))
    assert seen.met.all() and np.sum(seen.weight) == pytest.approx(4 * np.pi)
    # Pixels are sampled anywhere in them: a few degrees.
    assert np.quantile(np.abs(seen.depth - far) / far, 0.95) < 0.08
    depth, opacity = probe.trace(EYE.origin[None], np.array([[1.0, 0, 0]]))
    assert depth[0] == pytest.approx(0.7) and opacity[0] == 1
    np.testing.assert_allclose(np.array(probe.bounds()), [[-1] * 3, [1] * 3], atol=1e-6)
    turned = turned_ahead(EYE, seen)
    np.testing.assert_allclose(turned.origin, EYE.origin)
    assert np.abs(turned.target).max() == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("depths, length", [((0, 0), 1), ((0, 4), 4), ((3, 5), 3)], ids=["within", "beside", "before"])
def test_observers_within_matter_are_turned_ahead(depths, length):
    """They meet it at once; what they are turned to still lies before them, at a distance of what is met elsewhere."""
    directions = np.array([[0.6, 0.8, 0], *[[0, 0, 1.0]] * 3])
    depth = np.array([depths[0], *[depths[1]] * 3], float)
    seen = SeenSurfaces(EYE.origin, directions, depth, np.ones(4, bool), np.array([9.0, 0, 0, 0]), np.ones(4))
    np.testing.assert_allclose(turned_ahead(EYE, seen).target, EYE.origin + length * directions[0])


def test_points_and_ups():
    assert given_point(None, "--to") is None and given_point((1, 2, 3), "--to").tolist() == [1, 2, 3]
    with pytest.raises(NergError, match="--to is three numbers"):
        given_point((1.0, 2.0), "--to")
    up = np.array([0.0, 0, 1])
    assert upright(EYE, up) is EYE
    down = upright(Eye(np.zeros(3), np.array([0, 0, -2.0])), up)
    assert abs(down.up @ up) < 1e-9
    far = upright(Eye(np.array([-1e7, 0, 1e7]), np.array([-1e7, 1.0, 1e7])), up)
    assert np.allclose(np.float32(far.target) - np.float32(far.origin), [0, 1000, 0])
    with pytest.raises(NergError, match="cannot look at the point"):
        upright(Eye(np.ones(3), np.ones(3)), up)


def test_the_best_photo(probe):
    # Of three cameras in the cube one has the whole of it before it, one a wall, and one looks out of it.
    looks = [((0.9, 0, 0), (1, 0, 0)), ((-0.9, 0.1, 0.1), (0, 0.1, 0.1)), ((3, 0, 0), (4, 0, 0))]
    eyes = [Eye(np.array(o, float), np.array(t, float)) for o, t in looks]
    cameras = [PhotoCamera(str(k), eye, Lens(), False) for k, eye in enumerate(eyes)]
    assert best_photo(probe, None, cameras).name == "1"


@pytest.mark.parametrize("room", [False, True], ids=["a thing", "a room"])
def test_a_thing_is_seen_from_outside_and_a_room_from_within(rgb, tmp_path, room):
    """A cube whose faces look outwards is a thing, one whose faces look inwards a room."""
    place = SceneContent(
        beside=(element("shape", element("boolean", name="flip_normals", value=str(room)), type="cube"),)
    )
    up = np.array([0.0, 0, 1])
    (tmp_path / "a.xml").write_text(SceneText(place, GazeFiles(), EYE, EYE, up).xml())
    probe = Probe(load_scene(tmp_path / "a.xml", probe_values()), None, up)
    assert probe.within(np.array([[0, 0, 0], [0.9, -0.5, 0.3], [3, 0, 0], [0, 0, -1.1]])).tolist() == [
        not room,
        not room,
        False,
        False,
    ]
    shot = best_camera(probe, None, PinholeFrame(70, 1.5, up), None)
    assert (np.abs(shot.origin).max() < 1) == room and shot.opaque > 0.2


# ---- Who looks: people at a time, walks, and where most rays are ----


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
