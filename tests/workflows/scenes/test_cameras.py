"""What is looked around with before a camera is chosen: directions, depths and bounds of a known room."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overview import Frame, Seen
from nerg_mi.maths.geometry import box_interval
from nerg_mi.rendering.scene import load_scene
from nerg_mi.rendering.scene_writer import Attention, Eye, Lens, Place, SceneText, element
from nerg_mi.workflows.scene_cameras import (
    Probe,
    best_camera,
    best_photo,
    given_point,
    probe_values,
    turned_ahead,
    upright,
)
from nerg_mi.workflows.scene_places import PhotoCamera

EYE = Eye(np.array([0.3, -0.2, 0.1]), np.array([1.0, 0.6, 0.4]))


@pytest.fixture
def probe(rgb, tmp_path):
    """A cube of ±1, whose up is +y."""
    up = np.array([0.0, 1, 0])
    place = Place(beside=(element("shape", type="cube"),))
    (tmp_path / "a.xml").write_text(SceneText(place, Attention(), EYE, EYE, up).xml())
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
    seen = Seen(EYE.origin, directions, depth, np.ones(4, bool), np.array([9.0, 0, 0, 0]), np.ones(4))
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
    place = Place(beside=(element("shape", element("boolean", name="flip_normals", value=str(room)), type="cube"),))
    up = np.array([0.0, 0, 1])
    (tmp_path / "a.xml").write_text(SceneText(place, Attention(), EYE, EYE, up).xml())
    probe = Probe(load_scene(tmp_path / "a.xml", probe_values()), None, up)
    assert probe.within(np.array([[0, 0, 0], [0.9, -0.5, 0.3], [3, 0, 0], [0, 0, -1.1]])).tolist() == [
        not room,
        not room,
        False,
        False,
    ]
    shot = best_camera(probe, None, Frame(70, 1.5, up), None)
    assert (np.abs(shot.origin).max() < 1) == room and shot.opaque > 0.2
