"""A written scene, loaded by Mitsuba: its sensors look where they should, and its defaults can be set."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nerg_mi.rendering.scene import load_scene
from nerg_mi.rendering.scene_writer import (
    Attention,
    Eye,
    Lens,
    Place,
    SceneText,
    ahead_level,
    default_name,
    element,
    relative_name,
)

CUBE = Place(beside=(element("shape", type="cube"),))
UP = np.array([0.0, 0, 1])


def written(folder, **more):
    eye, camera = Eye(np.array([0, 0, 5.0]), np.array([0, 0, 0.0])), Eye(np.array([4, 1, 2.0]), np.array([0, 0, 0.5]))
    given = {"place": CUBE, "attention": Attention(), "camera": camera, "observer": eye, "up": UP, "width": 24} | more
    scene = SceneText(**given)
    (folder / "scene.xml").write_text(scene.xml())
    return scene


def axis(sensor):
    return np.array(sensor.world_transform().matrix, float).reshape(4, 4)[:3, 2]


def test_sensors_stand_and_look_where_they_should(rgb, tmp_path):
    scene = written(tmp_path, observer=Eye(np.array([0.0, -3, 1]), np.array([1.0, -2, 0])))
    camera, own, sphere = load_scene(tmp_path / "scene.xml").sensors()
    to = lambda eye: (eye.target - eye.origin) / np.linalg.norm(eye.target - eye.origin)
    np.testing.assert_allclose(axis(camera), to(scene.camera), atol=1e-6)
    np.testing.assert_allclose(axis(own), to(scene.observer), atol=1e-6)
    # Level, and towards where the observer looks.
    np.testing.assert_allclose(axis(sphere), np.array([1, 1, 0]) / np.sqrt(2), atol=1e-6)
    assert [tuple(s.film().crop_size()) for s in (camera, own, sphere)] == [(24, 16), (24, 16), (20, 10)]
    for sensor in (own, sphere):
        np.testing.assert_allclose(np.array(sensor.world_transform().matrix)[:3, 3].ravel(), [0, -3, 1], atol=1e-6)


def test_defaults_move_them(rgb, tmp_path):
    written(tmp_path, observer=Eye(np.array([0.0, -3, 1]), np.array([1.0, -2, 0])))
    scene = load_scene(tmp_path / "scene.xml", {"eye": "1, 2, 3", "width": "12", "fov": "40", "spp": "3"})
    camera, own, sphere = scene.sensors()
    for sensor in (own, sphere):
        np.testing.assert_allclose(np.array(sensor.world_transform().matrix)[:3, 3].ravel(), [1, 2, 3], atol=1e-6)
    assert tuple(camera.film().crop_size()) == (12, 16) and camera.sampler().sample_count() == 3
    assert float(np.array(rgb.traverse(camera)["x_fov"]).ravel()[0]) == pytest.approx(40)


def test_without_an_observer_the_camera_is_it(rgb, tmp_path):
    written(tmp_path, observer=None)
    scene = load_scene(tmp_path / "scene.xml")
    assert scene.integrator().observer is None and len(scene.sensors()) == 3
    for sensor in scene.sensors():
        np.testing.assert_allclose(np.array(sensor.world_transform().matrix)[:3, 3].ravel(), [4, 1, 2], atol=1e-6)


def test_names_that_others_have_taken(rgb, tmp_path):
    place = Place(
        first=(element("default", name="eye", value="9"),), beside=CUBE.beside, taken=frozenset({"eye", "camera"})
    )
    written(tmp_path, place=place, lens=Lens(50, 2.0))
    text = (tmp_path / "scene.xml").read_text()
    assert '<default name="nerg_eye"' in text and 'origin="$nerg_eye"' in text and 'id="nerg_camera"' in text
    scene = load_scene(tmp_path / "scene.xml", {"nerg_eye": "1, 2, 3"})
    assert tuple(scene.sensors()[0].film().crop_size()) == (24, 12)
    assert default_name("eye", place.taken) == "nerg_eye" and default_name("ahead", place.taken) == "ahead"


def test_a_level_direction():
    for target, level in (((2, 0, 7), (1, 0, 0)), ((0, -3, 0), (0, -1, 0))):
        np.testing.assert_allclose(ahead_level(Eye(np.zeros(3), np.array(target, float)), 2 * UP), level, atol=1e-12)
    straight = ahead_level(Eye(np.zeros(3), UP), UP)
    assert straight @ UP == pytest.approx(0) and np.linalg.norm(straight) == pytest.approx(1)


def test_names_are_relative_below_a_common_folder(tmp_path):
    assert relative_name(tmp_path / "a" / "x.ply", tmp_path / "b") == "../a/x.ply"
    assert relative_name(tmp_path / "x.ply", tmp_path) == "x.ply" and relative_name(tmp_path, tmp_path) == "."
    assert relative_name(Path("/one/x.ply"), Path("/two")) == "/one/x.ply"
