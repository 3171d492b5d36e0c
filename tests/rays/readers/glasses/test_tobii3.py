"""Tobii Pro Glasses 3."""

import gzip
import json

import numpy as np
import pytest

from nerg_mi.errors import NergError
from tests.rays.readers import own_camera
from tests.rays.readers.examples import EXAMPLES
from tests.rays.readers.reading import dropped, read
from tests.rays.readers.scene_examples import CALIBRATION_G3, sample_g3, video

MATRIX = [[920.0, 0, 955.0], [0, 921.0, 540.0], [0, 0, 1]]
LENS = {"k1": -0.05, "k2": 0.06, "k3": -0.02, "p1": 0.0003, "p2": 0.0001}
ROTATION, POSITION = np.array(CALIBRATION_G3["rotation"], float), np.array(CALIBRATION_G3["position"])


@pytest.fixture
def tobii(tmp_path):
    folder = tmp_path / "ann"
    folder.mkdir()
    EXAMPLES["tobii3"].make(folder)
    return folder, EXAMPLES["tobii3"].options_in(folder)


def write_gaze(folder, t, gaze, points=None):
    gaze2d = own_camera.project(gaze, MATRIX, **LENS) / [1920, 1080]
    points = (gaze * 1500 - POSITION) @ ROTATION if points is None else points
    text = "\n".join(sample_g3(*row) for row in zip(t, gaze2d.tolist(), points.tolist()))
    (folder / "gazedata.gz").write_bytes(gzip.compress(text.encode()))


def poses_of(options):
    return np.array([f["transform_matrix"] for f in json.loads(options["poses"].read_text())["frames"][1:]])


@pytest.mark.parametrize("of_the_camera", [False, True])
def test_rays_are_those_of_the_pixels(tobii, of_the_camera):
    """gaze3d agrees whichever of the two the position is."""
    folder, options = tobii
    t, gaze = np.linspace(0.01, 0.27, 40), own_camera.gaze_in_camera(40, 2)
    points = gaze * 1500 @ ROTATION + POSITION if of_the_camera else None
    write_gaze(folder, t, gaze, points)
    rays = read("tobii3", folder, **options)
    origin, direction = own_camera.rays_at(t, np.arange(8) / 24.95, poses_of(options), gaze)
    assert np.abs(rays.origin - origin).max() < 1e-5 and np.abs(rays.direction - direction).max() < 1e-5
    (about,) = rays.metadata["scene_camera"]
    assert about["p95_degrees"] < 1e-3 and "complaints" not in rays.metadata and rays.persons == ("ann",)


@pytest.mark.parametrize(
    "times",
    [
        0.2 + np.arange(8) / 24.95,
        np.cumsum([0.0, 0.04, 0.05, 0.04, 0.12, 0.04, 0.03, 0.05]),
        [0.3, 0.34, 0.38, 0.46, 0.5, 0.54, 0.58, 0.62],
    ],
)
def test_frames_have_the_times_of_the_video(tobii, times):
    """One that starts late, one whose rate varies, one that lost a frame."""
    folder, options = tobii
    folder.joinpath("scenevideo.mp4").rename(folder / "film.mp4")
    video(times)(folder / "film.mp4")
    about = {"scenecamera": {"file": "film.mp4", "camera-calibration": CALIBRATION_G3}}
    (folder / "recording.g3").write_text(json.dumps(about))
    t, gaze = np.linspace(times[0] + 1e-4, times[-1] - 1e-4, 30), own_camera.gaze_in_camera(30, 2)
    write_gaze(folder, t, gaze)
    rays = read("tobii3", folder, **options)
    origin, direction = own_camera.rays_at(t, np.array(times), poses_of(options), gaze)
    # A tick of the video's clock is 40 microseconds.
    assert np.abs(rays.origin - origin).max() < 2e-4 and np.abs(rays.direction - direction).max() < 1e-3
    assert "film.mp4" in [s["file"] for s in rays.metadata["sources"]]


def test_without_the_video_no_rate_is_guessed(tobii):
    folder, options = tobii
    (folder / "scenevideo.mp4").unlink()
    with pytest.raises(NergError, match="times of its video's"):
        read("tobii3", folder, **options)
    t, gaze = np.linspace(0.01, 0.27, 40), own_camera.gaze_in_camera(40, 2)
    write_gaze(folder, t, gaze)
    rays = read("tobii3", folder, **options, fps=10.0)
    assert np.allclose(rays.origin[:, 0], t, atol=1e-6)
    assert "10 a second exactly" in rays.metadata["complaints"][0]


def test_points_that_lie_elsewhere_are_told(tobii):
    folder, options = tobii
    gaze = own_camera.gaze_in_camera(20, 2)
    write_gaze(folder, np.linspace(0, 0.2, 20), gaze, gaze * [-1500, 1500, 1500] @ ROTATION)
    assert "gaze2d and gaze3d" in read("tobii3", folder, **options).metadata["complaints"][0]


def test_samples_without_gaze_and_lines_that_are_none(tobii):
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
    with pytest.raises(NergError, match="6.*--skip-bad-lines"):
        read("tobii3", folder, **options)
    rays = read("tobii3", folder, **options, skip_bad_lines=True)
    assert rays.metadata["unused_columns"] == ["lines of the type sync", "eyeleft"]
    assert len(rays) == 1 and dropped(rays) == {
        "there is no gaze": [[2, 2]],
        "gaze lies beyond the scene camera's picture": [[4, 4]],
        "the line is cut off, has cells too many, or holds one that is no number": [[6, 6]],
    }


@pytest.mark.parametrize(
    "change, message",
    [
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, "by no rotation"),
        ({"skew": 3.0}, "skew"),
        ({"focal-length": [0, 0]}, "positive focal"),
        ({"radial-distortion": [1]}, "no whole camera calibration"),
    ],
)
def test_calibrations_that_are_none(tobii, change, message):
    folder, options = tobii
    found = {"scenecamera": {"camera-calibration": {**CALIBRATION_G3, **change}}}
    (folder / "recording.g3").write_text(json.dumps(found))
    with pytest.raises(NergError, match=message):
        read("tobii3", folder, **options)
