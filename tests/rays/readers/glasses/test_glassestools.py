"""The common format of glassesTools."""

import json

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.scene_glasses import FrameNames
from tests.rays.readers import own_camera
from tests.rays.readers.examples import EXAMPLES
from tests.rays.readers.reading import dropped, read
from tests.rays.readers.scene_examples import LENS, MATRIX, opencv_xml, table

HEAD = "timestamp\tframe_idx\tgaze_pos_vid_x\tgaze_pos_vid_y"


@pytest.fixture
def glasses(tmp_path):
    folder = tmp_path / "ann"
    folder.mkdir()
    EXAMPLES["glassestools"].make(folder)
    return folder, EXAMPLES["glassestools"].options_in(folder)


def test_rays_are_those_of_the_pixels(glasses):
    folder, options = glasses
    t, gaze = np.linspace(0.0, 0.28, 30), own_camera.gaze_in_camera(30, 8)
    pixels = own_camera.project(gaze, MATRIX, **LENS)
    rows = [[1e3 * s, 0, *p] for s, p in zip(t, pixels.tolist())] + [[281, 7, "nan", "nan"], [300, 7, 1, 1]]
    (folder / "gazeData.tsv").write_text(table(HEAD, rows, "\t"))
    rays = read("glassestools", folder, **options)
    poses = np.array([f["transform_matrix"] for f in json.loads(options["poses"].read_text())["frames"][1:]])
    origin, direction = own_camera.rays_at(t, np.arange(8) * 0.04, poses, gaze)
    assert np.abs(rays.origin - origin).max() < 1e-5 and np.abs(rays.direction - direction).max() < 1e-5
    assert dropped(rays) == {
        "there is no gaze": [[32, 32]],
        "no frame of the scene camera near that time has a pose": [[33, 33]],
    }
    assert rays.metadata["frames"] == "scene/frame_{frame1}"


def test_numbers_from_0_are_a_frame_later(glasses):
    folder, options = glasses
    rays = read("glassestools", folder, **options)
    with pytest.raises(NergError, match="8.*0.*8.*--frames"):
        read("glassestools", folder, **{**options, "frames": FrameNames("scene/frame_{frame0}")})
    (folder / "frameTimestamps.tsv").write_text(table("frame_idx\ttimestamp", [[k, 40.0 * k] for k in range(9)], "\t"))
    later = read("glassestools", folder, **{**options, "frames": FrameNames("scene/frame_{frame0}")})
    assert np.allclose(later.origin[:, 0], rays.origin[1:, 0] - 0.1, atol=1e-9)


@pytest.mark.parametrize(
    "text, message",
    [
        ("<opencv_storage></opencv_storage>", "lacks the cameraMatrix or the distCoeff"),
        (opencv_xml(cameraMatrix=MATRIX, distCoeff=[0.0] * 11 + [1.0]), "rational model"),
        (opencv_xml(cameraMatrix=[[1.0, 2.0]], distCoeff=[0.0]), "3 x 3"),
        (opencv_xml(cameraMatrix=MATRIX, distCoeff=[0.0]).replace("891.0", "x"), "no number"),
    ],
)
def test_calibrations_that_are_none(glasses, text, message):
    folder, options = glasses
    (folder / "calibration.xml").write_text(text)
    with pytest.raises(NergError, match=message):
        read("glassestools", folder, **options)


def test_frames_that_are_not_counted(glasses):
    folder, options = glasses
    (folder / "frameTimestamps.tsv").write_text(table("frame_idx\ttimestamp", [[1, 0], [2, 40]], "\t"))
    with pytest.raises(NergError, match="does not count its frames"):
        read("glassestools", folder, **options)
    (folder / "frameTimestamps.tsv").unlink()
    with pytest.raises(NergError, match="--fps"):
        read("glassestools", folder, **options)
    assert len(read("glassestools", folder, **options, fps=25.0)) == 7
