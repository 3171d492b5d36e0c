"""Pupil Labs Neon, on the poses of real photos and on small models."""

import json
import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.scene_glasses import FrameNames
from tests.photos.test_colmap import write_colmap, write_transforms
from tests.rays.readers import own_camera
from tests.rays.readers.examples import EXAMPLES
from tests.rays.readers.reading import dropped, read
from tests.rays.readers.scene_examples import LENS, MATRIX, START, frame_ns, table

HEAD = (
    "section id,recording id,timestamp [ns],gaze x [px],gaze y [px],worn,fixation id,blink id,"
    "azimuth [deg],elevation [deg]"
)


def write_gaze(folder, ns, gaze, worn=None, blink=None, turned=0.0):
    """``gaze`` (n, 3) in the camera; ``turned``: degrees by which the azimuths are off."""
    pixels, angles = own_camera.project(gaze, MATRIX, **LENS), own_camera.angles(gaze) + [turned, 0]
    rows = [
        ["s", "r", t, *p, 1.0 if worn is None else worn[k], "", "" if blink is None else blink[k], *a]
        for k, (t, p, a) in enumerate(zip(ns, pixels.tolist(), angles.tolist()))
    ]
    (folder / "gaze.csv").write_text(table(HEAD, rows))


@pytest.fixture
def neon(tmp_path):
    """The example's folder, and its options."""
    folder = tmp_path / "2026-ann"
    folder.mkdir()
    EXAMPLES["neon"].make(folder)
    return folder, EXAMPLES["neon"].options_in(folder)


@pytest.mark.parametrize("kind", ["transforms", "colmap"])
@pytest.mark.parametrize("what", ["angles", "pixels"])
def test_on_the_poses_of_real_photos(tmp_path, recorded, kind, what):
    """The fox's photos as frames of a scene video, 30 a second: each ray to 1e-5, at frames and in between."""
    listed = json.loads((recorded("fox") / "transforms.json").read_text())["frames"]
    poses = {f["file_path"]: np.array(f["transform_matrix"]) for f in listed}
    for pose in poses.values():  # as near to rotations as a file has them
        u, _, v = np.linalg.svd(pose[:3, :3])
        pose[:3, :3] = u @ v
    numbers = np.array([int(name[7:11]) for name in poses])
    order = np.argsort(numbers)
    frames = np.array(frame_ns(200))
    times, stack = (frames[numbers - 1] - START)[order] * 1e-9, np.stack(list(poses.values()))[order]
    folder = tmp_path / "ann"
    folder.mkdir()
    for name in ("info.json", "scene_camera.json"):
        (folder / name).write_text(EXAMPLES["neon"].files[name])
    (folder / "world_timestamps.csv").write_text(table("timestamp [ns]", [[t] for t in frames]))
    rng = np.random.default_rng(4)
    between = np.diff(times) <= 0.2
    at = np.concatenate([times, *(times[:-1][between] + u * np.diff(times)[between] for u in rng.random(4))])
    ns = np.round(at * 1e9).astype(np.int64) + START
    gaze = own_camera.gaze_in_camera(len(ns), 5)
    write_gaze(folder, ns, gaze)
    if what == "pixels":
        text = (folder / "gaze.csv").read_text().replace("azimuth [deg],elevation [deg]", "a,e")
        (folder / "gaze.csv").write_text(text)
    model = (
        write_transforms(tmp_path / "transforms.json", poses)
        if kind == "transforms"
        else write_colmap(tmp_path / "sparse" / "0", poses)
    )
    rays = read("neon", folder, poses=model, frames=FrameNames("images/{frame1}"), scale=0.25)
    origin, direction = own_camera.rays_at((ns - START) * 1e-9, times, stack, gaze)
    assert len(rays) == len(ns) and rays.metadata["scene_camera"][0]["posed_frames"] == len(poses)
    assert np.abs(rays.origin - 0.25 * origin).max() < 1e-5 and np.abs(rays.direction - direction).max() < 1e-5
    if what == "angles":
        assert rays.metadata["scene_camera"][0]["p95_degrees"] < 1e-3


def test_what_is_dropped(neon):
    folder, options = neon
    ns = np.array(frame_ns(7)) + 1_000_000
    gaze = own_camera.gaze_in_camera(7)
    late = ns.copy()
    late[6] += 10**9  # after the last posed frame
    write_gaze(folder, late, gaze, worn=[1, 0.0, "False", 1, 1, 1, 1], blink=["", "", "", 4, "", "", ""])
    rays = read("neon", folder, **options)
    assert dropped(rays) == {
        "the glasses were not worn": [[3, 4]],
        "a blink": [[5, 5]],
        "no frame of the scene camera near that time has a pose": [[8, 8]],
    }
    assert rays.persons == ("ann",) and np.allclose(rays.t, (ns[[0, 4, 5]] - START) * 1e-9, atol=1e-6)
    assert [s["file"] for s in rays.metadata["sources"]][-1] == "ann/gaze.csv"
    assert rays.metadata["unused_columns"] == ["section id", "recording id", "fixation id"]


def test_frames_far_apart_are_not_bridged(neon):
    folder, options = neon
    model = json.loads(options["poses"].read_text())
    model["frames"] = [f for f in model["frames"] if not f["file_path"].endswith(("3.jpg", "4.jpg", "5.jpg"))]
    options["poses"].write_text(json.dumps(model))
    # Frames 2 and 6 of 30 a second are 0.133 s apart.
    assert len(read("neon", folder, **options)) == 7
    rays = read("neon", folder, **options, gap=0.1)
    assert dropped(rays) == {"no frame of the scene camera near that time has a pose": [[3, 6]]}


def test_accounts_that_differ_are_told(neon):
    folder, options = neon
    write_gaze(folder, np.array(frame_ns(7)) + 1_000_000, own_camera.gaze_in_camera(7), turned=4.0)
    rays = read("neon", folder, **options)
    (about,) = rays.metadata["scene_camera"]
    assert 3 < about["median_degrees"] < 4.01 and any("pixels and angles" in c for c in rays.metadata["complaints"])


def test_without_calibration_or_angles(neon):
    """Pixels go through a nominal lens, which is said; Neon Player calls the calibration otherwise."""
    folder, options = neon
    ns, gaze = np.array(frame_ns(7)) + 1_000_000, own_camera.gaze_in_camera(7)
    write_gaze(folder, ns, gaze)
    whole = read("neon", folder, **options)
    (folder / "scene_camera.json").unlink()
    rays = read("neon", folder, **options)
    assert np.allclose(rays.direction, whole.direction) and "complaints" not in rays.metadata
    text = (folder / "gaze.csv").read_text().replace("azimuth [deg]", "a")
    (folder / "gaze.csv").write_text(text)
    rays = read("neon", folder, **options)
    assert "nominal lens" in rays.metadata["complaints"][0]
    off = np.degrees(np.arccos(np.sum(rays.direction * whole.direction, axis=1)))
    assert 0.3 < off.max() < 2
    (folder / "calibration.json").write_text(
        json.dumps({"scene_camera_matrix": MATRIX, "scene_distortion_coefficients": list(LENS.values())})
    )
    rays = read("neon", folder, **options)
    assert np.abs(rays.direction - whole.direction).max() < 1e-6 and "complaints" not in rays.metadata


def test_exports_of_neon_player(neon):
    """Without info.json the clock is the scene video's, and the person the folder, which is said."""
    folder, options = neon
    ns = np.array(frame_ns(7)) + 1_000_000
    gaze = own_camera.gaze_in_camera(7)
    # Shares of a sensor's 255 steps.
    write_gaze(folder, ns, gaze, worn=[1.0, 0.996, 0.502, 0.498, 0.004, 0.0, 1.0])
    whole = read("neon", folder, **options)
    assert dropped(whole) == {"the glasses were not worn": [[5, 7]]}
    (folder / "info.json").unlink()
    rays = read("neon", folder, **options)
    assert np.allclose(rays.origin, whole.origin) and np.allclose(rays.direction, whole.direction)
    assert np.allclose(rays.t, (ns[[0, 1, 2, 6]] - frame_ns(1)[0]) * 1e-9, atol=1e-6) and rays.persons == ("2026-ann",)
    (complaint,) = rays.metadata["complaints"]
    assert 'no info.json beside the gaze of "2026-ann"' in complaint
    (folder / "aligned_poses.csv").write_text("start_timestamp\n")
    with pytest.raises(NergError, match="put its info.json beside"):
        read("neon", folder, poses=folder / "aligned_poses.csv")
    (folder / "world_timestamps.csv").unlink()
    with pytest.raises(NergError, match="neither info.json nor world_timestamps.csv"):
        read("neon", folder, **options)


@pytest.mark.parametrize("how", ["csv", "json"])
def test_timed_poses(neon, how):
    """What tag-aligner and the Reference Image Mapper write: intervals on the recording's clock, OpenCV's axes."""
    folder, options = neon
    times = (np.array(frame_ns(8)) - START) * 1e-9
    turn = Rotation.from_euler("xyz", np.c_[np.linspace(1.3, 1.6, 8), np.zeros(8), np.linspace(0, 0.5, 8)])
    place = np.c_[np.linspace(0, 2, 8), np.ones(8), np.full(8, 1.6)]
    spans = zip(times, np.r_[times[1:], times[-1] + 0.033])
    if how == "csv":
        names = [*(f"translation_{a}" for a in "xyz"), *(f"rotation_{a}" for a in "xyzw")]
        rows = [[*s, *p, *q] for s, p, q in zip(spans, place, turn.as_quat())]
        path = folder / "aligned_poses.csv"
        path.write_text(table(",".join(["start_timestamp", "end_timestamp", *names]), rows))
    else:
        path = folder / "camera_pose.json"
        keys = ["start_timestamp", "end_timestamp", *(f"{w}_{a}" for w in ("translation", "rotation") for a in "xyz")]
        poses = [dict(zip(keys, [*s, *p, *r])) for s, p, r in zip(spans, place.tolist(), turn.as_rotvec().tolist())]
        path.write_text(json.dumps({"result": poses}))
    ns, gaze = np.array(frame_ns(7)) + 7_000_000, own_camera.gaze_in_camera(7, 3)
    write_gaze(folder, ns, gaze)
    rays = read("neon", folder, poses=path, scale=2.0)
    opengl = np.tile(np.eye(4), (8, 1, 1))
    opengl[:, :3, :3], opengl[:, :3, 3] = turn.as_matrix() @ np.diag([1, -1, -1]), 2 * place
    origin, direction = own_camera.rays_at((ns - START) * 1e-9, times, opengl, gaze)
    assert np.abs(rays.origin - origin).max() < 1e-5 and np.abs(rays.direction - direction).max() < 1e-5
    shutil.copy(path, folder / "poses.p")
    with pytest.raises(NergError, match="pickle"):
        read("neon", folder, poses=folder / "poses.p")


def test_several_recordings_need_names_that_tell_them_apart(neon):
    folder, options = neon
    other = folder.with_name("bo")
    shutil.copytree(folder, other)
    with pytest.raises(NergError, match=r"\{recording\}"):
        read("neon", folder, other, **options)
    model = json.loads(options["poses"].read_text())["frames"][1:]
    both = [{**f, "file_path": f"{r.name}/{f['file_path'][6:]}"} for r in (folder, other) for f in model]
    options["poses"].write_text(json.dumps({"frames": both}))
    rays = read("neon", folder, other, **{**options, "frames": FrameNames("{recording}/frame_{frame1}")})
    assert len(rays) == 14 and len(rays.metadata["scene_camera"]) == 2


@pytest.mark.parametrize(
    "name, text, message",
    [
        ("info.json", "{}", "start_time"),
        ("info.json", '{"start_time": true}', "start_time"),
        ("scene_camera.json", "{}", "camera matrix of 3 x 3"),
        ("scene_camera.json", json.dumps({"camera_matrix": [[1, 0, 0], [0, 0, 0], [0, 0, 1]]}), "positive focal"),
        ("transforms.json", json.dumps({"frames": []}), "lists no images"),
    ],
)
def test_files_that_are_damaged(neon, name, text, message):
    folder, options = neon
    (folder / name).write_text(text)
    with pytest.raises(NergError, match=message):
        read("neon", folder, **options)


def test_what_has_to_be_said(neon):
    folder, options = neon
    with pytest.raises(NergError, match="--poses"):
        read("neon", folder)
    with pytest.raises(NergError, match="its first are images/IMG_0001.jpg"):
        read("neon", folder, poses=options["poses"])
    with pytest.raises(NergError, match="there is no .*gaze.csv"):
        read("neon", folder / "gone", **options)
