"""Cameras of written scenes: probes of a known room, overviews, photos and poses."""

from __future__ import annotations

import json

import numpy as np
import pytest

from nerg_mi.environment.overview import PinholeFrame, SeenSurfaces
from nerg_mi.environment.photo_cameras import PhotoCamera, load_photo_camera, load_photo_cameras
from nerg_mi.environment.scene_cameras import (
    SceneProbe,
    find_best_camera,
    find_best_photo,
    make_upright,
    probe_values,
    turn_to_attention,
)
from nerg_mi.environment.scene_loading import load_scene
from nerg_mi.environment.scene_writer import GazeFiles, Lens, LookAt, SceneContent, SceneText, element
from nerg_mi.errors import NergError
from nerg_mi.files.atomic import file_sha256
from nerg_mi.maths.geometry import intersect_box_numpy
from tests.refusals import mentions

# ---- Panoramas from which a camera is chosen: directions, depths and bounds of a known room ----

EYE = LookAt(np.array([0.3, -0.2, 0.1]), np.array([1.0, 0.6, 0.4]))


@pytest.fixture
def probe(rgb, tmp_path):
    """A cube of ±1, with +y up."""
    up = np.array([0.0, 1, 0])
    place = SceneContent(scene_children=(element("shape", type="cube"),))
    (tmp_path / "a.xml").write_text(SceneText(place, GazeFiles(), EYE, EYE, up).to_xml(tmp_path))
    return SceneProbe(load_scene(tmp_path / "a.xml", probe_values()), None, up)


def test_the_probe_measures_its_surroundings(probe):
    seen = probe.around(EYE)
    _, far = intersect_box_numpy(
        np.broadcast_to(EYE.origin, seen.directions.shape), seen.directions, -np.ones(3), np.ones(3)
    )
    assert seen.is_hit.all() and np.sum(seen.solid_angle) == pytest.approx(4 * np.pi)
    # Pixels are sampled at random positions, so directions vary by a few degrees.
    assert np.quantile(np.abs(seen.depth - far) / far, 0.95) < 0.08
    depth, opacity = probe.trace(EYE.origin[None], np.array([[1.0, 0, 0]]))
    assert depth[0] == pytest.approx(0.7) and opacity[0] == 1
    np.testing.assert_allclose(np.array(probe.bounds()), [[-1] * 3, [1] * 3], atol=1e-6)
    turned = turn_to_attention(EYE, seen)
    np.testing.assert_allclose(turned.origin, EYE.origin)
    assert np.abs(turned.target).max() == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("depths, length", [((0, 0), 1), ((0, 4), 4), ((3, 5), 3)], ids=["within", "next to", "before"])
def test_observers_inside_matter_face_a_positive_distance(depths, length):
    """Their rays hit at once; the target is still in front of them, at a distance of hits in other directions."""
    directions = np.array([[0.6, 0.8, 0], *[[0, 0, 1.0]] * 3])
    depth = np.array([depths[0], *[depths[1]] * 3], float)
    seen = SeenSurfaces(EYE.origin, directions, depth, np.ones(4, bool), np.array([9.0, 0, 0, 0]), np.ones(4))
    np.testing.assert_allclose(turn_to_attention(EYE, seen).target, EYE.origin + length * directions[0])


def test_cameras_have_an_up_direction_and_a_distance():
    up = np.array([0.0, 0, 1])
    assert make_upright(EYE, up) is EYE
    down = make_upright(LookAt(np.zeros(3), np.array([0, 0, -2.0])), up)
    assert abs(down.up @ up) < 1e-9
    far = make_upright(LookAt(np.array([-1e7, 0, 1e7]), np.array([-1e7, 1.0, 1e7])), up)
    assert np.allclose(np.float32(far.target) - np.float32(far.origin), [0, 1000, 0])
    with pytest.raises(NergError, check=mentions("target")):
        make_upright(LookAt(np.ones(3), np.ones(3)), up)


def test_the_best_photo_is_selected(probe):
    # Of three cameras in the cube, one sees all of it, one a wall, and one looks out of it.
    poses = [((0.9, 0, 0), (1, 0, 0)), ((-0.9, 0.1, 0.1), (0, 0.1, 0.1)), ((3, 0, 0), (4, 0, 0))]
    views = [LookAt(np.array(o, float), np.array(t, float)) for o, t in poses]
    cameras = [PhotoCamera(str(k), eye, Lens(), False) for k, eye in enumerate(views)]
    assert find_best_photo(probe, None, cameras).name == "1"


@pytest.mark.parametrize("room", [False, True], ids=["a thing", "a room"])
def test_objects_are_viewed_from_outside_and_rooms_from_inside(rgb, tmp_path, room):
    """A cube with outward faces is an object, one with inward faces a room."""
    place = SceneContent(
        scene_children=(element("shape", element("boolean", name="flip_normals", value=str(room)), type="cube"),)
    )
    up = np.array([0.0, 0, 1])
    (tmp_path / "a.xml").write_text(SceneText(place, GazeFiles(), EYE, EYE, up).to_xml(tmp_path))
    probe = SceneProbe(load_scene(tmp_path / "a.xml", probe_values()), None, up)
    assert probe.within(np.array([[0, 0, 0], [0.9, -0.5, 0.3], [3, 0, 0], [0, 0, -1.1]])).tolist() == [
        not room,
        not room,
        False,
        False,
    ]
    shot = find_best_camera(probe, None, PinholeFrame(70, 1.5, up), None)
    assert (np.abs(shot.origin).max() < 1) == room and shot.surface_fraction > 0.2


# ---- The camera of a photo, against the pose in its file, in the coordinates in which a field was trained ----


POSE = np.array([[1, 0, 0, 0.5], [0, 0, -1, -3], [0, 1, 0, 1.2], [0, 0, 0, 1]], float)  # looks along +y, up is +z


@pytest.fixture
def photos(rgb, tmp_path):
    frames = []
    for k in range(3):
        rgb.Bitmap(np.full((20, 30, 3), 99, np.uint8)).write(str(tmp_path / f"p{k}.png"))
        pose = POSE.copy()
        pose[0, 3] += k
        frames.append({"file_path": f"p{k}.png", "transform_matrix": pose.tolist()})
    lens = {"w": 30, "h": 20, "fl_x": 25.0, "fl_y": 25.0, "cx": 12.0, "cy": 11.0}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return tmp_path


@pytest.mark.parametrize("photo", ["1", "p1", "p1.png"])
def test_pose_and_lens_of_a_photo_are_read(photos, photo):
    camera = load_photo_camera(photos, photo, {})
    assert camera.name == "p1.png" and not camera.has_distortion
    np.testing.assert_allclose(camera.eye.origin, [1.5, -3, 1.2])
    np.testing.assert_allclose(camera.eye.target - camera.eye.origin, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(camera.eye.up, [0, 0, 1], atol=1e-12)
    assert camera.lens.fov == pytest.approx(np.degrees(2 * np.arctan(15 / 25)))
    assert camera.lens.aspect == pytest.approx(1.5)
    assert camera.lens.offset == pytest.approx((0.1, -0.05))


def test_photo_cameras_are_in_training_coordinates(photos):
    # The field is twice as large as the file, and moved.
    to_file = np.diag([0.5, 0.5, 0.5, 1.0])
    to_file[:3, 3] = -1
    metadata = {"sha256": file_sha256(photos / "transforms.json"), "to_file": to_file.tolist()}
    camera = load_photo_camera(photos, "0", metadata)
    np.testing.assert_allclose(to_file[:3, :3] @ camera.eye.origin + to_file[:3, 3], POSE[:3, 3])
    np.testing.assert_allclose(camera.eye.target - camera.eye.origin, [0, 1, 0], atol=1e-12)


def test_photos_without_a_pose_are_refused(photos):
    with pytest.raises(NergError, match="give the photos of its training with photos"):
        load_photo_camera(photos, "0", {"sha256": "0" * 64})
    for photo in ("3", "p9", "-1"):
        with pytest.raises(NergError, match='photo.*0.*2.*"p0.png"'):
            load_photo_camera(photos, photo, {})


def test_all_photo_cameras_are_loaded(photos):
    assert [c.name for c in load_photo_cameras(photos, {})] == ["p0.png", "p1.png", "p2.png"]
    assert [c.name for c in load_photo_cameras(photos, {}, max_count=2)] == ["p0.png", "p2.png"]
    for k, camera in enumerate(load_photo_cameras(photos, {})):
        np.testing.assert_array_equal(camera.eye.origin, load_photo_camera(photos, str(k), {}).eye.origin)
