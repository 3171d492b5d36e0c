"""Tests of `nerg_mi.environment.scene_writer`."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from nerg_mi.environment.scene_loading import load_scene
from nerg_mi.environment.scene_writer import (
    BlankLine,
    Comment,
    GazeFiles,
    Lens,
    LookAt,
    SceneContent,
    SceneText,
    Verbatim,
    check_attribute,
    element,
    format_document,
    format_numbers,
    free_default_name,
    level_direction,
    matrix,
    project_to_pixel,
    prop,
    relative_path,
    transform,
)
from nerg_mi.errors import NergError
from tests.plugins.scenes import plugin

# ---- Projection ----


@pytest.fixture
def camera(rgb):
    return rgb.load_dict(
        plugin(
            "perspective",
            fov=60,
            fov_axis="x",
            to_world=rgb.ScalarTransform4f().look_at([1, -4, 2], [0, 0, 1], [0, 0, 1]),
            film={"type": "hdrfilm", "width": 30, "height": 20},
        )
    )


def test_points_project_to_pixels(rgb, camera):
    origin, ahead = np.array([1.0, -4, 2]), np.array([-1.0, 4, -1])
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    for point in ((0, 0, 1), (0.5, 0.2, 1.4), (-1, 1, 0.5)):
        x, y, z = (np.subtract(point, origin) @ v for v in (right, up, ahead))
        focal = 15 / np.tan(np.radians(30))
        wanted = 15 + focal * x / z - 0.5, 10 - focal * y / z - 0.5
        np.testing.assert_allclose(project_to_pixel(camera, rgb.Point3f(*point)), wanted, atol=1e-3)


def test_points_outside_the_image(rgb, camera):
    assert project_to_pixel(camera, rgb.Point3f(2, -8, 3)) is None  # behind
    assert project_to_pixel(camera, rgb.Point3f(20, 0, 1)) is None  # outside


# ---- Written scenes, loaded by Mitsuba ----

CUBE = SceneContent(scene_children=(element("shape", type="cube"),))
UP = np.array([0.0, 0, 1])


def write_scene(folder, **overrides):
    eye, camera = (
        LookAt(np.array([0, 0, 5.0]), np.array([0, 0, 0.0])),
        LookAt(np.array([4, 1, 2.0]), np.array([0, 0, 0.5])),
    )
    values = {
        "content": CUBE,
        "gaze_files": GazeFiles(),
        "camera": camera,
        "observer": eye,
        "up": UP,
        "width": 24,
    } | overrides
    scene = SceneText(**values)
    (folder / "scene.xml").write_text(scene.to_xml(folder))
    return scene


def axis(sensor):
    return np.array(sensor.world_transform().matrix, float).reshape(4, 4)[:3, 2]


def test_poses_of_sensors(rgb, tmp_path):
    scene = write_scene(tmp_path, observer=LookAt(np.array([0.0, -3, 1]), np.array([1.0, -2, 0])))
    camera, observer_view, sphere = load_scene(tmp_path / "scene.xml").sensors()
    to = lambda eye: (eye.target - eye.origin) / np.linalg.norm(eye.target - eye.origin)
    np.testing.assert_allclose(axis(camera), to(scene.camera), atol=1e-6)
    np.testing.assert_allclose(axis(observer_view), to(scene.observer), atol=1e-6)
    # Level, and towards where the observer looks.
    np.testing.assert_allclose(axis(sphere), np.array([1, 1, 0]) / np.sqrt(2), atol=1e-6)
    assert [tuple(s.film().crop_size()) for s in (camera, observer_view, sphere)] == [(24, 16), (24, 16), (20, 10)]
    for sensor in (observer_view, sphere):
        np.testing.assert_allclose(np.array(sensor.world_transform().matrix)[:3, 3].ravel(), [0, -3, 1], atol=1e-6)


def test_defaults_set_poses(rgb, tmp_path):
    write_scene(tmp_path, observer=LookAt(np.array([0.0, -3, 1]), np.array([1.0, -2, 0])))
    scene = load_scene(tmp_path / "scene.xml", {"eye": "1, 2, 3", "width": "12", "fov": "40", "spp": "3"})
    camera, observer_view, sphere = scene.sensors()
    for sensor in (observer_view, sphere):
        np.testing.assert_allclose(np.array(sensor.world_transform().matrix)[:3, 3].ravel(), [1, 2, 3], atol=1e-6)
    assert tuple(camera.film().crop_size()) == (12, 16) and camera.sampler().sample_count() == 3
    assert float(np.array(rgb.traverse(camera)["x_fov"]).ravel()[0]) == pytest.approx(40)


def test_camera_is_the_default_observer(rgb, tmp_path):
    write_scene(tmp_path, observer=None)
    scene = load_scene(tmp_path / "scene.xml")
    assert scene.integrator().observer is None and len(scene.sensors()) == 3
    for sensor in scene.sensors():
        np.testing.assert_allclose(np.array(sensor.world_transform().matrix)[:3, 3].ravel(), [4, 1, 2], atol=1e-6)


def test_reserved_names_are_avoided(rgb, tmp_path):
    place = SceneContent(
        preamble=(element("default", name="eye", value="9"),),
        scene_children=CUBE.scene_children,
        reserved_names=frozenset({"eye", "camera"}),
    )
    write_scene(tmp_path, content=place, lens=Lens(50, 2.0))
    text = (tmp_path / "scene.xml").read_text()
    assert '<default name="nerg_eye"' in text and 'origin="$nerg_eye"' in text and 'id="nerg_camera"' in text
    scene = load_scene(tmp_path / "scene.xml", {"nerg_eye": "1, 2, 3"})
    assert tuple(scene.sensors()[0].film().crop_size()) == (24, 12)
    assert (
        free_default_name("eye", place.reserved_names) == "nerg_eye"
        and free_default_name("ahead", place.reserved_names) == "ahead"
    )


def test_direction_is_horizontal():
    for target, level in (((2, 0, 7), (1, 0, 0)), ((0, -3, 0), (0, -1, 0))):
        np.testing.assert_allclose(
            level_direction(LookAt(np.zeros(3), np.array(target, float)), 2 * UP), level, atol=1e-12
        )
    straight = level_direction(LookAt(np.zeros(3), UP), UP)
    assert straight @ UP == pytest.approx(0) and np.linalg.norm(straight) == pytest.approx(1)


def test_relative_paths(tmp_path):
    assert relative_path(tmp_path / "a" / "x.ply", tmp_path / "b") == "../a/x.ply"
    assert relative_path(tmp_path / "x.ply", tmp_path) == "x.ply" and relative_path(tmp_path, tmp_path) == "."
    assert relative_path(Path("/one/x.ply"), Path("/two")) == "/one/x.ply"


# ---- XML formatting ----

NASTY = "a<b>&\"c\"'d' \n\té"


def test_document_round_trip():
    nodes = [
        prop("string", "filename", NASTY),
        BlankLine(),
        element("shape", Comment("one\ntwo"), prop("float", "x", 1.5), type="cube", id="a"),
    ]
    root = ElementTree.fromstring(format_document(nodes, "Head of the file"))
    assert root.tag == "scene" and root.get("version") == "3.0.0"
    assert root[0].attrib == {"name": "filename", "value": NASTY}
    assert root[1].attrib == {"type": "cube", "id": "a"} and root[1][0].get("value") == "1.5"


def test_comments_are_escaped():
    text = format_document([Comment("a -- b --> c ---")], "x--y -")
    assert text.count("-->") == 2 and "--" not in text.replace("<!--", "").replace("-->", "")
    ElementTree.fromstring(text)


def test_line_length_and_indentation():
    text = format_document(
        [element("sensor", Comment("word " * 100), prop("float", "fov", 70), type="perspective")], "w " * 200
    )
    assert max(map(len, text.splitlines())) <= 120
    assert '\n        <float name="fov" value="70"/>\n    </sensor>\n' in text
    assert format_document([Verbatim("<a>\n  <b/>\n</a>")], "h").endswith("    <a>\n      <b/>\n    </a>\n</scene>\n")


@pytest.mark.parametrize("name", ["a$b.ply", "a\x01.ply", "a\udc80.ply"])
def test_invalid_file_names_are_refused(name):
    with pytest.raises(NergError, match="rename the file"):
        check_attribute(name)
    with (
        pytest.raises(NergError, match="not valid text")
        if "$" not in name
        else pytest.raises(NergError, match="rename")
    ):
        format_document([prop("string", "a", name if "$" not in name else check_attribute(name))], "h")


def test_numbers_and_matrices():
    assert format_numbers([np.float32(0.1), 5_600_000.25, np.float32(16777217)]) == "0.1, 5600000.25, 16777216"
    assert format_numbers([1, -0.0, 0.1, 1e-7, 123456.789]) == "1, 0, 0.1, 1e-07, 123456.789"
    values = np.arange(16).reshape(4, 4) / 3
    parsed = ElementTree.fromstring(format_document([transform(matrix(values))], "h"))[0][0].get("value")
    np.testing.assert_allclose(np.array(parsed.split(), float).reshape(4, 4), values, rtol=1e-14)
