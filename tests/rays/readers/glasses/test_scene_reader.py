"""A reader of glasses that is two methods: its gaze becomes rays where the model's frames stand."""

import json

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.registry import read_rays
from nerg_mi.rays.readers.scene_glasses import FrameNames, GazeBlock, Recording, SceneOptions, SceneReader
from tests.rays.readers.scene_examples import model


class Centre(SceneReader[Recording]):
    """Seconds, a line each, at which the wearer looked along the scene camera's axis."""

    name, files, checked_on = "centre", "folders with gaze.txt", "nothing"
    gaze_file = "gaze.txt"

    def open(self, folder, builder):
        return Recording(name=folder.name, person=f"wearer of {folder.name}", frames=np.arange(8) / 10)

    def blocks(self, gaze, recording, builder):
        t = np.loadtxt(gaze, ndmin=1)
        builder.count_lines(len(t))
        ahead = np.tile([0.0, 0.0, 1.0], (len(t), 1))
        yield GazeBlock(t, ahead, np.arange(len(t)) + 1, {"nobody wore them": t == 0.3})


@pytest.fixture
def recording(tmp_path):
    (tmp_path / "transforms.json").write_text(model())
    for name in ("ann", "bo"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "gaze.txt").write_text("0\n0.1\n0.3\n0.55\n9\n")
    return tmp_path


def options(folder, names="scene/frame_{frame1}.jpg", **more):
    return SceneOptions(poses=folder / "transforms.json", frames=FrameNames.parse(names), **more)


def test_gaze_starts_where_the_camera_was(recording):
    """The folder and its file are the same; a row that is dropped, and one after the last frame, are counted."""
    frames = json.loads((recording / "transforms.json").read_text())["frames"][1:]  # the first is a photo
    poses = np.array([f["transform_matrix"] for f in frames])
    for given in (recording / "ann", recording / "ann" / "gaze.txt"):
        rays = read_rays(Centre(), given, options(recording))
        assert set(rays.persons) == {"wearer of ann"}
        assert np.allclose(rays.t, [0, 0.1, 0.55])
        assert np.allclose(rays.origin[:2], poses[:2, :3, 3])
        assert np.allclose(rays.origin[2], (poses[5, :3, 3] + poses[6, :3, 3]) / 2, atol=1e-3)
        assert np.allclose(rays.direction[:2], -poses[:2, :3, 2])
    with pytest.raises(NergError, match="gaze.txt"):
        read_rays(Centre(), recording / "cem", options(recording))


def test_recordings_have_to_be_told_apart(recording):
    with pytest.raises(NergError, match="told apart by {recording}"):
        read_rays(Centre(), [recording / "ann", recording / "bo"], options(recording))
