"""Tests of `nerg_mi.tracking.readers.scene_glasses`."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.formats.checkpoint import write_checkpoint
from nerg_mi.photos.colmap import read_named_poses
from nerg_mi.photos.images import read_split
from nerg_mi.tracking.quality import summarise
from nerg_mi.tracking.readers.registry import read_rays
from nerg_mi.tracking.readers.scene_glasses import (
    FrameNames,
    GazeBlock,
    Recording,
    SceneCamera,
    SceneCameraOptions,
    SceneCoordinates,
    SceneReader,
    angles_between,
    directions_from_angles,
    is_timed_pose_file,
    read_timed_poses,
)
from tests.photos.test_colmap import write_transforms
from tests.refusals import mentions
from tests.tracking.readers.examples import EXAMPLES, LENS, MATRIX, camera_angles, gaze_in_camera, model, project, read

# ---- Names of frames and their times ----

FRAMES = np.array([0.5, 0.54, 0.57, 0.61])


@pytest.mark.parametrize(
    "pattern, name, seconds",
    [
        ("frame_{frame1}", "images/frame_00002.jpg", 0.54),
        ("frame_{frame0}", "frame_2.png", 0.57),
        ("{frame0}", "a/b/c/0003", 0.61),
        ("scene/*_{frame1}", "x/scene/neon_take2_0001.jpeg", 0.5),
        ("{recording}/{frame1}", "images/ann (2)/4.jpg", 0.61),
        ("t{s}", "t12.25.jpg", 12.75),
        ("t{s}", "t3.jpg", 3.5),
        ("{ns}", "1700000000250000000.png", 0.25),
        ("frame_{frame1}", "images/photo_00002.jpg", None),
        ("frame_{frame1}", "images/myframe_00002.jpg", None),
        ("f.{frame1}", "fx2.jpg", None),
    ],
)
def test_times(pattern, name, seconds):
    names = FrameNames.parse(pattern)
    assert str(names) == pattern and names.has_recording == ("recording" in pattern)
    if seconds is None:
        with pytest.raises(NergError, match="image of the model"):
            names.compute_times([name], "ann (2)", FRAMES, None, 1.7e18)
        return
    result = names.compute_times([name, "IMG_77x.JPG"], "ann (2)", FRAMES, None, 1.7e18)
    assert np.allclose(result, [seconds, np.nan], equal_nan=True)


@pytest.mark.parametrize(
    "fps, shown",
    [
        # Result of FFmpeg's filter fps for frames numbered from 0 at 24.95 Hz.
        (5.0, [2, 7, 12, 17, 22, 27, 32, 37, 42, 47, 52, 57]),
        (10.0, [1, 3, 6, 8, 11, 13, 16, 18, 21, 23, 26, 28]),
        (40.0, [0, 0, 1, 2, 2, 3, 4, 4, 5, 5, 6, 7]),
    ],
)
def test_constant_rate(fps, shown):
    frames = 0.5 + np.arange(60) / 24.95
    result = FrameNames("{frame0}").compute_times([str(k) for k in range(12)], "", frames, fps, 0)
    assert np.allclose(result, frames[shown])
    assert np.allclose(FrameNames("{frame0}").compute_times(["1", "6"], "", None, 2.0, 0), [0.5, 3.0])


@pytest.mark.parametrize(
    "pattern, name, frames, fps, message",
    [
        ("{frame1}", "0", FRAMES, None, "frame -1 of the video"),
        ("{frame1}", "0", FRAMES, 5.0, "frame -1 of the video"),
        ("{frame1}", "0", None, 5.0, "frame -1 of the video"),
        ("{frame1}", "5", FRAMES, None, "frame 4 of the video, counted from 0, which has 4"),
        ("{frame0}", "2", FRAMES, 5.0, r"frame 2 .* which has 4 \(at 5 per second\)"),
        ("{frame0}", "5", None, None, "scene video.*fps"),
    ],
)
def test_missing_frames_are_refused(pattern, name, frames, fps, message):
    with pytest.raises(NergError, match=message):
        FrameNames(pattern).compute_times([name], "", frames, fps, 0)


@pytest.mark.parametrize("pattern", ["", "frame_*", "{frame0}_{s}", "{frame1}{frame1}", "{number}"])
def test_patterns_without_a_time(pattern):
    with pytest.raises(NergError, check=mentions("frames")):
        FrameNames.parse(pattern)


# ---- Coordinates of a trained scene ----


def write_place(path, **provenance):
    write_checkpoint(path, "radiance", {"a": np.zeros(1, np.float32)}, {"provenance": provenance})
    return path


def test_scene_coordinates_follow_the_training(tmp_path):
    to_place = np.eye(4)
    to_place[:3, :3] = 0.3 * Rotation.from_euler("xyz", [1, 2, 3]).as_matrix()
    to_place[:3, 3] = 1, 2, 3
    path = write_place(tmp_path / "p.safetensors", to_file=np.linalg.inv(to_place).tolist(), up=[0, 1, 0], sha256="ab")
    result, points = SceneCoordinates.from_checkpoint(path), np.random.default_rng(0).normal(size=(9, 3))
    assert np.allclose(result.transform_points(points), points @ to_place[:3, :3].T + to_place[:3, 3])
    assert np.isclose(result.scale, 0.3) and np.allclose(result.rotation, to_place[:3, :3] / 0.3)
    assert result.up is not None and result.up.tolist() == [0, 1, 0] and result.sha256 == "ab"
    assert np.allclose(SceneCoordinates.from_scale(2.0).transform_points(points), 2 * points)


@pytest.mark.parametrize(
    "provenance, message",
    [
        ({}, "does not contain the coordinates"),
        ({"to_file": [1, 2]}, "to_file.*shape"),
        ({"to_file": np.diag([1.0, 2, 1, 1]).tolist()}, "to_file.*not a rotation"),
        ({"to_file": np.diag([1.0, -1, 1, 1]).tolist()}, "to_file.*mirrored"),
        ({"to_file": (np.eye(4) + np.eye(4, k=-3)).tolist()}, "to_file.*transposed"),
        ({"to_file": np.zeros((4, 4)).tolist()}, "to_file.*last row"),
    ],
)
def test_checkpoints_without_coordinates_are_refused(tmp_path, provenance, message):
    with pytest.raises(NergError, match=message):
        SceneCoordinates.from_checkpoint(write_place(tmp_path / "p.safetensors", **provenance))


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, 1e12])
def test_invalid_scales_are_refused(scale):
    with pytest.raises(NergError, check=mentions("scale")):
        SceneCoordinates.from_scale(scale)


# ---- Pixels and angles of a scene camera ----

SIZE = (1600, 1200)


def test_pixels_and_directions_are_inverse():
    gaze = gaze_in_camera(500)
    camera = SceneCamera.from_opencv(MATRIX, list(LENS.values()), SIZE)
    assert np.abs(camera.compute_directions(project(gaze, MATRIX, **LENS)) - gaze).max() < 1e-10
    plain = SceneCamera.from_opencv(MATRIX, None)
    assert np.allclose(plain.compute_directions(np.array([[810.0, 605.0]])), [[0, 0, 1]])
    # Some files have four zeros for thin prisms.
    padded = SceneCamera.from_opencv(np.ravel(MATRIX), [list(LENS.values()) + [0] * 4], SIZE)
    assert padded == camera


def test_pixels_outside_of_the_image_have_no_direction():
    camera = SceneCamera.from_opencv(MATRIX, list(LENS.values()), SIZE)
    pixels = np.array([[-1.0, 600], [800, 1200.2], [np.nan, 3], [-0.4, 0], [1599.4, 1199]])
    assert np.isnan(camera.compute_directions(pixels)).any(axis=1).tolist() == [True, True, True, False, False]
    folding = SceneCamera.from_opencv(MATRIX, [-0.4], None)
    far = folding.compute_directions(np.array([[811.0, 605.0], [3000.0, 605.0]]))
    assert np.isfinite(far[0]).all() and np.isnan(far[1]).all()


def test_angles():
    gaze = gaze_in_camera(50, 3)
    assert np.abs(directions_from_angles(camera_angles(gaze)) - gaze).max() < 1e-12
    assert np.allclose(directions_from_angles(np.array([[90.0, 0], [0, 90]])), [[1, 0, 0], [0, -1, 0]])
    assert np.allclose(
        angles_between(np.eye(3), np.array([[1, 1e-9, 0], [0, 2, 2], [0, 0, -1]])), [np.degrees(1e-9), 45, 180]
    )


@pytest.mark.parametrize(
    "matrix, coefficients, message",
    [
        *((matrix, None, "3 x 3") for matrix in (None, [[1, 2]], "abc")),
        *((matrix, None, "no positive focal") for matrix in (np.full((3, 3), np.nan), np.eye(3) * -1, np.eye(3) * 1e9)),
        ([[900.0, 3.0, 800.0], [0, 900.0, 600.0], [0, 0, 1]], None, "skew"),
        (MATRIX, [0.0] * 11 + [1.0], "rational model"),
    ],
)
def test_invalid_cameras_are_refused(matrix, coefficients, message):
    with pytest.raises(NergError, match=f"the calibration .*{message}"):
        SceneCamera.from_opencv(matrix, coefficients)


# ---- Gaze of a scene camera in the coordinates of the trained scene ----


@pytest.fixture
def neon(tmp_path):
    EXAMPLES["neon"].make(tmp_path)
    return tmp_path, EXAMPLES["neon"].options_in(tmp_path)


def turn_model(path, rotation, scale=1.0):
    """The model of ``path`` in other coordinates."""
    frames = json.loads(path.read_text())["frames"]
    move = np.eye(4)
    move[:3, :3] = rotation.as_matrix()
    poses = {f["file_path"]: move @ f["transform_matrix"] for f in frames}
    for pose in poses.values():
        pose[:3, 3] *= scale
    write_transforms(path, poses)


def test_rays_are_in_the_coordinates_of_an_upright_training(neon):
    """The model is tilted and twice as large; training rotated it upright and set its scale."""
    folder, options = neon
    straight = read("neon", folder, **options)
    turn_model(options["poses"], Rotation.from_euler("x", 70, degrees=True), 2.0)
    for f in json.loads(options["poses"].read_text())["frames"]:
        (folder / f["file_path"]).parent.mkdir(exist_ok=True)
        (folder / f["file_path"]).write_bytes(b"")
    split = read_split(options["poses"], 0, "upright", 0.5)
    place = write_place(
        folder / "place.safetensors", to_file=split.posed.to_file.tolist(), sha256=split.posed.sha256, up=[0, 0, 1]
    )
    rays = read("neon", folder, **options, place=place)
    assert np.allclose(rays.origin, straight.origin, atol=1e-9) and "complaints" not in rays.metadata
    assert np.allclose(rays.direction, straight.direction, atol=1e-9)
    # The poses used by the training itself.
    frames = [f for f in split.posed.frames if f.name.startswith("scene")]
    assert np.allclose(rays.origin[0], frames[0].to_world[:3, 3], atol=0.01)
    assert read_named_poses(options["poses"]).sha256 == split.posed.sha256
    with pytest.raises(NergError, match="leave out scale"):
        read("neon", folder, **options, place=place, scale=2.0)


def test_scene_of_another_file_gives_a_warning(neon):
    folder, options = neon
    place = write_place(folder / "place.safetensors", to_file=np.eye(4).tolist(), sha256="00")
    rays = read("neon", folder, **options, place=place)
    assert any("another file" in c for c in rays.metadata["complaints"])
    assert any("another file" in w for w in summarise(rays).warnings)


@pytest.mark.parametrize("has_up", [False, True])
def test_tilted_scene_gives_a_warning(neon, has_up):
    """By the orientation of its cameras, or by the training; as declared, the rays are z up."""
    folder, options = neon
    straight = read("neon", folder, **options)
    turn_model(options["poses"], Rotation.from_euler("x", 90, degrees=True))
    if has_up:
        options["place"] = write_place(folder / "p.safetensors", to_file=np.eye(4).tolist(), up=[0, -1, 0])
    rays = read("neon", folder, **options)
    (complaint,) = rays.metadata["complaints"]
    assert "90 degrees from z" in complaint and "up=-y" in complaint and "align_output" in complaint
    rays = read("neon", folder, **options, up="-y")
    assert "complaints" not in rays.metadata
    assert np.allclose(rays.origin, straight.origin) and np.allclose(rays.direction, straight.direction)


def test_single_frame_is_refused(neon):
    folder, options = neon
    model = json.loads(options["poses"].read_text())
    options["poses"].write_text(json.dumps({"frames": model["frames"][:2]}))
    with pytest.raises(NergError, match="at least two"):
        read("neon", folder, **options)


# ---- A minimal reader of glasses with two methods ----


class Centre(SceneReader[Recording]):
    """Times in seconds, one per line, at which the wearer looked along the scene camera's axis."""

    name, files, evidence = "centre", "folders with gaze.txt", "nothing"
    gaze_file = "gaze.txt"

    def open_recording(self, folder, builder):
        return Recording(name=folder.name, person=f"wearer of {folder.name}", frames=np.arange(8) / 10)

    def iterate_gaze(self, gaze, recording, builder):
        t = np.loadtxt(gaze, ndmin=1)
        builder.count_lines(len(t))
        ahead = np.tile([0.0, 0.0, 1.0], (len(t), 1))
        yield GazeBlock(t, ahead, np.arange(len(t)) + 1, {"nobody wore them": t == 0.3})  # noqa: RUF069 (stored)


@pytest.fixture
def recording(tmp_path):
    (tmp_path / "transforms.json").write_text(model())
    (tmp_path / "ann").mkdir()
    (tmp_path / "ann" / "gaze.txt").write_text("0\n0.1\n0.3\n0.55\n9\n")
    return tmp_path


def test_gaze_starts_at_the_camera(recording):
    """The folder and its file give the same rays; a dropped row and one after the last frame are counted."""
    frames = json.loads((recording / "transforms.json").read_text())["frames"][1:]  # the first is a photo
    poses = np.array([f["transform_matrix"] for f in frames])
    options = SceneCameraOptions(poses=recording / "transforms.json", frames=FrameNames("scene/frame_{frame1}.jpg"))
    for cases in (recording / "ann", recording / "ann" / "gaze.txt"):
        rays = read_rays(Centre(), cases, options)
        assert rays.persons == ("wearer of ann",) and np.allclose(rays.t, [0, 0.1, 0.55])
        assert np.allclose(rays.origin[:2], poses[:2, :3, 3])
        assert np.allclose(rays.origin[2], (poses[5, :3, 3] + poses[6, :3, 3]) / 2, atol=1e-3)
        assert np.allclose(rays.direction[:2], -poses[:2, :3, 2])
    with pytest.raises(NergError, match="gaze.txt"):
        read_rays(Centre(), recording / "cem", options)


# ---- Timed poses ----

NAMES = "translation_x translation_y translation_z rotation_x rotation_y rotation_z rotation_w"

CSV = ",".join(["start_timestamp", "end_timestamp", *NAMES.split()]) + "\n"


def test_timed_pose_files(tmp_path):
    names = ("aligned_poses.csv", "camera_pose.json", "poses.p", "transforms.json", "sparse")
    assert [is_timed_pose_file(tmp_path / n) for n in names] == [True, True, True, False, False]


def test_quaternions_and_rotation_vectors_are_equal(tmp_path):
    half = np.sqrt(0.5)
    a, b = tmp_path / "aligned_poses.csv", tmp_path / "camera_pose.json"
    a.write_text(
        CSV + f"0,0.1,1,2,3,0,0,0,1\n0.1,0.2,4,5,6,0,0,{half},{half}\n0.2,0.3,4,5,6,0,0,0,0\n,,1,1,1,0,0,0,1\n"
    )
    keys = ["start_timestamp", *(f"translation_{k}" for k in "xyz"), *(f"rotation_{k}" for k in "xyz")]
    b.write_text(json.dumps([dict(zip(keys, row)) for row in ([0, 1, 2, 3, 0, 0, 0], [0.1, 4, 5, 6, 0, 0, np.pi / 2])]))
    (one, of_one), (two, of_two) = read_timed_poses(a), read_timed_poses(b)
    assert (of_one, of_two) == (4, 2) and np.array_equal(one.times, [0, 0.1])
    for field in ("times", "rotation_vectors", "positions"):
        assert np.allclose(getattr(one, field), getattr(two, field))


@pytest.mark.parametrize(
    "name, text, message",
    [
        ("aligned_poses.csv", CSV + "0,1,1,1,1,0,0,0,1\n", "has 1 poses"),
        ("aligned_poses.csv", "a,b\n1,2\n", "no column start_timestamp"),
        ("camera_pose.json", "{}", "not a list of camera poses"),
        ("camera_pose.json", '[{"start_timestamp": 0}]', "not a list of camera poses"),
        ("poses.p", "x", "pickle, which can execute"),
    ],
)
def test_files_without_poses_are_refused(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(NergError, match=message):
        read_timed_poses(tmp_path / name)
