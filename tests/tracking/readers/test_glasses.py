"""Glasses with a scene camera, and Pupil Core."""

import gzip
import json
import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.tracking.readers.scene_glasses import FrameNames
from tests.photos.test_colmap import write_colmap, write_transforms
from tests.refusals import mentions
from tests.tracking.readers.examples import (
    CALIBRATION_G3,
    EXAMPLES,
    LENS,
    MATRIX,
    START,
    camera_angles,
    dropped,
    frame_ns,
    gaze_in_camera,
    opencv_xml,
    project,
    rays_at,
    read,
    sample_g3,
    table,
    video,
)

# ---- Pupil Labs Neon, with the poses of real photos and of small models ----

NEON_HEAD = (
    "section id,recording id,timestamp [ns],gaze x [px],gaze y [px],worn,fixation id,blink id,"
    "azimuth [deg],elevation [deg]"
)


def opened(tmp_path, name):
    """The folder of a reader's example, named like a person, and its options."""
    folder = tmp_path / "2026-ann"
    folder.mkdir()
    EXAMPLES[name].make(folder)
    return folder, EXAMPLES[name].options_in(folder)


@pytest.fixture
def neon(tmp_path):
    return opened(tmp_path, "neon")


@pytest.fixture
def tobii(tmp_path):
    return opened(tmp_path, "tobii3")


@pytest.fixture
def glasses(tmp_path):
    return opened(tmp_path, "glassestools")


def frame_poses(options):
    """OpenGL poses (F, 4, 4) of the frames in the example's model, whose first image is a photo."""
    return np.array([f["transform_matrix"] for f in json.loads(options["poses"].read_text())["frames"][1:]])


def write_neon(folder, ns, gaze, worn=None, blink=None, turned=0.0):
    """Write ``gaze`` (n, 3) in the camera; ``turned``: error of the azimuths in degrees."""
    pixels, angles = project(gaze, MATRIX, **LENS), camera_angles(gaze) + [turned, 0]
    rows = [
        ["s", "r", t, *p, 1.0 if worn is None else worn[k], "", "" if blink is None else blink[k], *a]
        for k, (t, p, a) in enumerate(zip(ns, pixels.tolist(), angles.tolist()))
    ]
    (folder / "gaze.csv").write_text(table(NEON_HEAD, rows))


@pytest.mark.parametrize("kind", ["transforms", "colmap"])
@pytest.mark.parametrize("what", ["angles", "pixels"])
def test_on_the_poses_of_real_photos(tmp_path, recorded, kind, what):
    """The fox's photos as frames of a scene video at 30 Hz: each ray to 1e-5, at frames and in between."""
    listed = json.loads((recorded("fox") / "transforms.json").read_text())["frames"]
    poses = {f["file_path"]: np.array(f["transform_matrix"]) for f in listed}
    for pose in poses.values():  # accurate to the digits in the file
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
    gaze = gaze_in_camera(len(ns), 5)
    write_neon(folder, ns, gaze)
    if what == "pixels":
        text = (folder / "gaze.csv").read_text().replace("azimuth [deg],elevation [deg]", "a,e")
        (folder / "gaze.csv").write_text(text)
    model = (
        write_transforms(tmp_path / "transforms.json", poses)
        if kind == "transforms"
        else write_colmap(tmp_path / "sparse" / "0", poses)
    )
    rays = read("neon", folder, poses=model, frames=FrameNames("images/{frame1}"), scale=0.25)
    origin, direction = rays_at((ns - START) * 1e-9, times, stack, gaze)
    assert len(rays) == len(ns) and rays.metadata["scene_camera"][0]["posed_frames"] == len(poses)
    assert np.abs(rays.origin - 0.25 * origin).max() < 1e-5 and np.abs(rays.direction - direction).max() < 1e-5
    if what == "angles":
        assert rays.metadata["scene_camera"][0]["p95_degrees"] < 1e-3


def test_dropped_rows(neon):
    folder, options = neon
    ns = np.array(frame_ns(7)) + 1_000_000
    gaze = gaze_in_camera(7)
    late = ns.copy()
    late[6] += 10**9  # after the last frame with a pose
    write_neon(folder, late, gaze, worn=[1, 0.0, "False", 1, 1, 1, 1], blink=["", "", "", 4, "", "", ""])
    rays = read("neon", folder, **options)
    assert dropped(rays) == {
        "the glasses were not worn": [[3, 4]],
        "a blink": [[5, 5]],
        "no frame of the scene camera near that time has a pose (option gap)": [[8, 8]],
    }
    assert rays.persons == ("ann",) and np.allclose(rays.t, (ns[[0, 4, 5]] - START) * 1e-9, atol=1e-6)
    assert [s["file"] for s in rays.metadata["sources"]][-1] == "ann/gaze.csv"
    assert rays.metadata["unused_columns"] == ["section id", "recording id", "fixation id"]


def test_gaps_between_frames_are_not_interpolated(neon):
    folder, options = neon
    model = json.loads(options["poses"].read_text())
    model["frames"] = [f for f in model["frames"] if not f["file_path"].endswith(("3.jpg", "4.jpg", "5.jpg"))]
    options["poses"].write_text(json.dumps(model))
    # Frames 2 and 6 at 30 Hz are 0.133 s apart.
    assert len(read("neon", folder, **options)) == 7
    rays = read("neon", folder, **options, gap=0.1)
    assert dropped(rays) == {"no frame of the scene camera near that time has a pose (option gap)": [[3, 6]]}


def test_differing_gaze_representations_give_a_warning(neon):
    folder, options = neon
    write_neon(folder, np.array(frame_ns(7)) + 1_000_000, gaze_in_camera(7), turned=4.0)
    rays = read("neon", folder, **options)
    (content,) = rays.metadata["scene_camera"]
    assert 3 < content["median_degrees"] < 4.01 and any("pixels and angles" in c for c in rays.metadata["complaints"])


def test_without_calibration_or_angles(neon):
    """Pixels are converted with a nominal lens, with a warning; Neon Player has another name for the calibration."""
    folder, options = neon
    ns, gaze = np.array(frame_ns(7)) + 1_000_000, gaze_in_camera(7)
    write_neon(folder, ns, gaze)
    complete = read("neon", folder, **options)
    (folder / "scene_camera.json").unlink()
    rays = read("neon", folder, **options)
    assert np.allclose(rays.direction, complete.direction) and "complaints" not in rays.metadata
    text = (folder / "gaze.csv").read_text().replace("azimuth [deg]", "a")
    (folder / "gaze.csv").write_text(text)
    rays = read("neon", folder, **options)
    assert "nominal lens" in rays.metadata["complaints"][0]
    off = np.degrees(np.arccos(np.sum(rays.direction * complete.direction, axis=1)))
    assert 0.3 < off.max() < 2
    (folder / "calibration.json").write_text(
        json.dumps({"scene_camera_matrix": MATRIX, "scene_distortion_coefficients": list(LENS.values())})
    )
    rays = read("neon", folder, **options)
    assert np.abs(rays.direction - complete.direction).max() < 1e-6 and "complaints" not in rays.metadata


def test_exports_of_neon_player(neon):
    """Without info.json the clock is that of the scene video, and the participant the folder, with a warning."""
    folder, options = neon
    ns = np.array(frame_ns(7)) + 1_000_000
    gaze = gaze_in_camera(7)
    # Fractions of a sensor's 255 steps.
    write_neon(folder, ns, gaze, worn=[1.0, 0.996, 0.502, 0.498, 0.004, 0.0, 1.0])
    complete = read("neon", folder, **options)
    assert dropped(complete) == {"the glasses were not worn": [[5, 7]]}
    (folder / "info.json").unlink()
    rays = read("neon", folder, **options)
    assert np.allclose(rays.origin, complete.origin) and np.allclose(rays.direction, complete.direction)
    assert np.allclose(rays.t, (ns[[0, 1, 2, 6]] - frame_ns(1)[0]) * 1e-9, atol=1e-6) and rays.persons == ("2026-ann",)
    (complaint,) = rays.metadata["complaints"]
    assert 'no info.json next to the gaze of "2026-ann"' in complaint
    (folder / "aligned_poses.csv").write_text("start_timestamp\n")
    with pytest.raises(NergError, match="put its info.json next to"):
        read("neon", folder, poses=folder / "aligned_poses.csv")
    (folder / "world_timestamps.csv").unlink()
    with pytest.raises(NergError, match="neither info.json nor world_timestamps.csv"):
        read("neon", folder, **options)


@pytest.mark.parametrize("how", ["csv", "json"])
def test_timed_poses(neon, how):
    """Files of tag-aligner and the Reference Image Mapper: intervals on the recording's clock, OpenCV's axes."""
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
    ns, gaze = np.array(frame_ns(7)) + 7_000_000, gaze_in_camera(7, 3)
    write_neon(folder, ns, gaze)
    rays = read("neon", folder, poses=path, scale=2.0)
    opengl = np.tile(np.eye(4), (8, 1, 1))
    opengl[:, :3, :3], opengl[:, :3, 3] = turn.as_matrix() @ np.diag([1, -1, -1]), 2 * place
    origin, direction = rays_at((ns - START) * 1e-9, times, opengl, gaze)
    assert np.abs(rays.origin - origin).max() < 1e-5 and np.abs(rays.direction - direction).max() < 1e-5


def test_several_recordings_need_distinct_frame_names(neon):
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


def test_required_options(neon):
    folder, options = neon
    with pytest.raises(NergError, check=mentions("poses")):
        read("neon", folder)
    with pytest.raises(NergError, match="first images: images/IMG_0001.jpg"):
        read("neon", folder, poses=options["poses"])
    with pytest.raises(NergError, match="does not exist; .*gaze.csv"):
        read("neon", folder / "gone", **options)
    for text in ("{}", '{"start_time": true}'):
        (folder / "info.json").write_text(text)
        with pytest.raises(NergError, match="start_time"):
            read("neon", folder, **options)


# ---- Tobii Pro Glasses 3 ----

TOBII_MATRIX = [[920.0, 0, 955.0], [0, 921.0, 540.0], [0, 0, 1]]
TOBII_LENS = {"k1": -0.05, "k2": 0.06, "k3": -0.02, "p1": 0.0003, "p2": 0.0001}
TOBII_ROTATION, TOBII_POSITION = np.array(CALIBRATION_G3["rotation"], float), np.array(CALIBRATION_G3["position"])


def write_tobii(folder, t, gaze, points=None):
    gaze2d = project(gaze, TOBII_MATRIX, **TOBII_LENS) / [1920, 1080]
    points = (gaze * 1500 - TOBII_POSITION) @ TOBII_ROTATION if points is None else points
    text = "\n".join(sample_g3(*row) for row in zip(t, gaze2d.tolist(), points.tolist()))
    (folder / "gazedata.gz").write_bytes(gzip.compress(text.encode()))


@pytest.mark.parametrize("of_the_camera", [False, True])
def test_tobii_rays_follow_the_pixels(tobii, of_the_camera):
    """gaze3d agrees for both interpretations of the position."""
    folder, options = tobii
    t, gaze = np.linspace(0.01, 0.27, 40), gaze_in_camera(40, 2)
    points = gaze * 1500 @ TOBII_ROTATION + TOBII_POSITION if of_the_camera else None
    write_tobii(folder, t, gaze, points)
    rays = read("tobii3", folder, **options)
    origin, direction = rays_at(t, np.arange(8) / 24.95, frame_poses(options), gaze)
    assert np.abs(rays.origin - origin).max() < 1e-5 and np.abs(rays.direction - direction).max() < 1e-5
    (content,) = rays.metadata["scene_camera"]
    assert content["p95_degrees"] < 1e-3 and "complaints" not in rays.metadata and rays.persons == ("2026-ann",)


@pytest.mark.parametrize(
    "times",
    [
        0.2 + np.arange(8) / 24.95,
        np.cumsum([0.0, 0.04, 0.05, 0.04, 0.12, 0.04, 0.03, 0.05]),
        [0.3, 0.34, 0.38, 0.46, 0.5, 0.54, 0.58, 0.62],
    ],
)
def test_frames_have_the_times_of_the_video(tobii, times):
    """Videos that start late, have a varying rate, or lost a frame."""
    folder, options = tobii
    folder.joinpath("scenevideo.mp4").rename(folder / "film.mp4")
    video(times)(folder / "film.mp4")
    content = {"scenecamera": {"file": "film.mp4", "camera-calibration": CALIBRATION_G3}}
    (folder / "recording.g3").write_text(json.dumps(content))
    t, gaze = np.linspace(times[0] + 1e-4, times[-1] - 1e-4, 30), gaze_in_camera(30, 2)
    write_tobii(folder, t, gaze)
    rays = read("tobii3", folder, **options)
    origin, direction = rays_at(t, np.array(times), frame_poses(options), gaze)
    # A tick of the video's clock is 40 microseconds.
    assert np.abs(rays.origin - origin).max() < 2e-4 and np.abs(rays.direction - direction).max() < 1e-3
    assert "film.mp4" in [s["file"] for s in rays.metadata["sources"]]


def test_without_the_video_no_rate_is_assumed(tobii):
    folder, options = tobii
    (folder / "scenevideo.mp4").unlink()
    with pytest.raises(NergError, match="times of the video's"):
        read("tobii3", folder, **options)
    t, gaze = np.linspace(0.01, 0.27, 40), gaze_in_camera(40, 2)
    write_tobii(folder, t, gaze)
    rays = read("tobii3", folder, **options, fps=10.0)
    assert np.allclose(rays.origin[:, 0], t, atol=1e-6)
    assert "exactly 10 per second" in rays.metadata["complaints"][0]


def test_samples_without_gaze_and_invalid_lines(tobii):
    folder, options = tobii
    lines = [
        sample_g3(0.0, [0.5, 0.5], None),
        sample_g3(0.01, None, None),
        json.dumps({"type": "sync", "timestamp": 0.02, "data": {}}),
        sample_g3(0.03, [1.5, 0.5], None).replace('"gaze3d"', '"eyeleft": {}, "gaze3d"'),
        "",
        sample_g3(0.05, [0.5, 0.4], [0, 0, 100])[:-3],
    ]
    (folder / "gazedata.gz").write_bytes(gzip.compress("\n".join(lines).encode()))
    with pytest.raises(NergError, match="6.*skip_bad_lines"):
        read("tobii3", folder, **options)
    rays = read("tobii3", folder, **options, skip_bad_lines=True)
    assert rays.metadata["unused_columns"] == ["lines of the type sync", "eyeleft"]
    assert len(rays) == 1 and dropped(rays) == {
        "there is no gaze": [[2, 2]],
        "gaze lies beyond the scene camera's picture": [[4, 4]],
        "the line is incomplete, has too many cells, or a cell that is not a number (option skip_bad_lines)": [[6, 6]],
    }


def test_invalid_tobii_calibrations_are_refused(tobii):
    folder, options = tobii
    for change, message in (
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, "rotation in the calibration"),
        ({"radial-distortion": [1]}, "no complete calibration"),
    ):
        content = {"scenecamera": {"camera-calibration": {**CALIBRATION_G3, **change}}}
        (folder / "recording.g3").write_text(json.dumps(content))
        with pytest.raises(NergError, match=message):
            read("tobii3", folder, **options)


# ---- The common format of glassesTools ----

TOOLS_HEAD = "timestamp\tframe_idx\tgaze_pos_vid_x\tgaze_pos_vid_y"


def test_rays_follow_the_pixels(glasses):
    folder, options = glasses
    t, gaze = np.linspace(0.0, 0.28, 30), gaze_in_camera(30, 8)
    pixels = project(gaze, MATRIX, **LENS)
    rows = [[1e3 * s, 0, *p] for s, p in zip(t, pixels.tolist())] + [[281, 7, "nan", "nan"], [300, 7, 1, 1]]
    (folder / "gazeData.tsv").write_text(table(TOOLS_HEAD, rows, "\t"))
    rays = read("glassestools", folder, **options)
    origin, direction = rays_at(t, np.arange(8) * 0.04, frame_poses(options), gaze)
    assert np.abs(rays.origin - origin).max() < 1e-5 and np.abs(rays.direction - direction).max() < 1e-5
    assert dropped(rays) == {
        "there is no gaze": [[32, 32]],
        "no frame of the scene camera near that time has a pose (option gap)": [[33, 33]],
    }
    assert rays.metadata["frames"] == "scene/frame_{frame1}"


def test_frame_numbers_from_0_and_1(glasses):
    folder, options = glasses
    rays = read("glassestools", folder, **options)
    with pytest.raises(NergError, match="8.*0.*8.*frames"):
        read("glassestools", folder, **{**options, "frames": FrameNames("scene/frame_{frame0}")})
    (folder / "frameTimestamps.tsv").write_text(table("frame_idx\ttimestamp", [[k, 40.0 * k] for k in range(9)], "\t"))
    later = read("glassestools", folder, **{**options, "frames": FrameNames("scene/frame_{frame0}")})
    assert np.allclose(later.origin[:, 0], rays.origin[1:, 0] - 0.1, atol=1e-9)


def test_invalid_calibrations_are_refused(glasses):
    folder, options = glasses
    for text, message in (
        ("<opencv_storage></opencv_storage>", "lacks the cameraMatrix or the distCoeff"),
        (opencv_xml(cameraMatrix=MATRIX, distCoeff=[0.0]).replace("891.0", "x"), "not a number"),
    ):
        (folder / "calibration.xml").write_text(text)
        with pytest.raises(NergError, match=message):
            read("glassestools", folder, **options)


def test_unnumbered_frames_are_refused(glasses):
    folder, options = glasses
    (folder / "frameTimestamps.tsv").write_text(table("frame_idx\ttimestamp", [[1, 0], [2, 40]], "\t"))
    with pytest.raises(NergError, match="are not numbered"):
        read("glassestools", folder, **options)
    (folder / "frameTimestamps.tsv").unlink()
    with pytest.raises(NergError, check=mentions("fps")):
        read("glassestools", folder, **options)
    assert len(read("glassestools", folder, **options, fps=25.0)) == 7


# ---- Exports of Pupil Core ----

PUPIL_NAMES = [f"{n}_{a}" for n in ("eye_center0_3d", "gaze_normal0", "eye_center1_3d", "gaze_normal1") for a in "xyz"]


def test_pupil(tmp_path):
    folder = tmp_path / "anna" / "000" / "exports" / "001"
    folder.mkdir(parents=True)
    # The camera turns by 90 degrees about the markers' z in a second and moves one edge of a marker (0.05 m) along x.
    steps = np.linspace(0, 1, 21)
    (folder / "head_pose_tracker_poses.csv").write_text(
        "timestamp,rotation_x,rotation_y,rotation_z,translation_x,translation_y,translation_z,pitch,yaw,roll\n"
        + "".join(f"{10 + s},0,0,{s * np.pi / 2},{s},20,30,0,0,0\n" for s in steps)
    )
    both, one = "20,10,-20,0.1,0,1,-40,10,-20,-0.1,0,1", ",,,,,,-40,10,-20,0,0,1"
    (folder / "gaze_positions.csv").write_text(
        "gaze_timestamp,world_index,confidence," + ",".join(PUPIL_NAMES) + "\n"
        f"10.51,0,0.9,{both}\n10.52,0,0.3,{both}\n10.53,0,0.9,{one}\n11.5,0,0.9,{both}\n"
    )
    rays = read("pupil", folder, marker=0.05, up="z")
    assert rays.persons == ("anna",) and np.allclose(rays.t, [10.51, 10.53]) and rays.metadata["marker"] == 0.05  # noqa: RUF069 (stored)
    turn = Rotation.from_rotvec([[0, 0, 0.51 * np.pi / 2], [0, 0, 0.53 * np.pi / 2]])
    assert np.allclose(rays.direction, [0, 0, 1]) and np.allclose(rays.head, [0, 0, 1])
    assert rays.metadata["floor"] == "unknown"
    want = 0.05 * np.array([[0.51, 20, 30], [0.53, 20, 30]]) + turn.apply(
        1e-3 * np.array([[-10, 10, -20], [-40, 10, -20]])
    )
    assert np.allclose(rays.origin, want)
    assert dropped(rays) == {
        "confidence below 0.6 (option min_confidence)": [[3, 3]],
        "there is no head pose at that time": [[5, 5]],
    }
    with pytest.raises(NergError, match="length in metres"):
        read("pupil", folder)
    (folder / "head_pose_tracker_poses.csv").unlink()
    with pytest.raises(NergError, match="run the head pose tracker"):
        read("pupil", folder / "gaze_positions.csv", marker=0.05)


def test_gaze_in_gaps_of_head_poses_is_dropped(tmp_path):
    folder = tmp_path / "anna"
    folder.mkdir()
    head = "timestamp,rotation_x,rotation_y,rotation_z,translation_x,translation_y,translation_z\n"
    poses = "".join(f"{t},0,0,0,{t},0,0\n" for t in (10, 10.05, 11, 11.05))
    (folder / "head_pose_tracker_poses.csv").write_text(head + poses)
    rows = "".join(f"{t},0.9,0,0,0,0,0,1,0,0,0,0,0,1\n" for t in (10.01, 10.06, 10.5, 10.92, 11.04))
    (folder / "gaze_positions.csv").write_text(f"gaze_timestamp,confidence,{','.join(PUPIL_NAMES)}\n{rows}")
    rays = read("pupil", folder, marker=1.0, up="z")
    assert np.allclose(rays.t, [10.01, 10.06, 10.92, 11.04]) and np.allclose(rays.origin[:, 0], rays.t)
    assert dropped(rays) == {"there is no head pose at that time": [[4, 4]]}
    # Both files are recorded with the participant, since file names are equal in all recordings.
    names = ["anna/head_pose_tracker_poses.csv", "anna/gaze_positions.csv"]
    assert [s["file"] for s in rays.metadata["sources"]] == names
