"""Photos made a capture: what is written, read again, told and warned of. COLMAP itself is tried in
tests/photos/structure/test_worker.py; here a model that is known stands for what it finds."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.photos.colmap import Up
from nerg_mi.photos.dataset import open_dataset
from nerg_mi.photos.structure import Reconstruction
from nerg_mi.workflows import poses as job
from nerg_mi.workflows.poses import STAGES, find_poses
from nerg_mi.workflows.radiance_commands import PoseOptions
from tests.photos.structure import rendered

from .recorder import Recorder

COUNT = 9


@pytest.fixture
def photos(tmp_path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for k in range(COUNT):
        pixels = np.random.default_rng(k).integers(0, 255, (24, 32, 3)).astype(np.uint8)
        Image.fromarray(pixels).save(folder / f"{k}.png")
    return folder


def written(pictures, work: Path, keep: int) -> Reconstruction:
    """A model of the first ``keep`` pictures, as text."""
    model = work / "sparse" / "0"
    model.mkdir(parents=True)
    to_world = rendered.poses(len(pictures))[:keep]
    (model / "cameras.txt").write_text("1 OPENCV 32 24 30 30 16 12 0.01 0 0 0\n")
    lines = []
    for k, (picture, pose) in enumerate(zip(pictures, to_world), 1):
        rotation = (pose[:3, :3] @ np.diag([1, -1, -1])).T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        t = -rotation @ pose[:3, 3]
        lines += [f"{k} {w} {x} {y} {z} {t[0]} {t[1]} {t[2]} 1 {picture.name}\n", "\n"]
    (model / "images.txt").write_text("".join(lines))
    points = np.random.default_rng(0).uniform(-1, 1, (400, 3)) * [1, 1, 0.2]
    rows = [f"{k} {p[0]} {p[1]} {p[2]} 9 9 9 0.3 1 0 2 0 3 0\n" for k, p in enumerate(points)]
    (model / "points3D.txt").write_text("".join(rows))
    names = [p.name for p in pictures]
    up = Up(np.array([0, 0, 1.0]), 0.5, 0.4, 0.7)
    parts = [names[:keep]] + ([names[keep:]] if len(names) - keep >= 3 else [])
    colors = np.full((400, 3), 99, np.uint8)
    return Reconstruction(parts, 0.4, 400, up, [{"model": "OPENCV"}], to_world, points, colors)


@pytest.fixture
def finds(monkeypatch):
    """`finds(keep)` lets so many pictures have a pose; gives a list of the settings that were asked for."""

    def choose(keep: int, change=lambda made: made) -> list:
        asked = []

        def stand_in(pictures, work, settings, progress):
            asked.append(settings)
            for stage in ("features", "matching", "mapping"):
                progress(stage, 1, 2)
            return change(written(pictures, Path(work), keep)) if keep else None

        monkeypatch.setattr(job, "reconstruct", stand_in)
        return asked

    monkeypatch.setattr(job, "check_installed", lambda: None)
    return choose


def test_the_capture_is_read_as_it_was_found(photos, finds, tmp_path):
    asked = finds(COUNT)
    told = Recorder()
    options = PoseOptions(lens="radial", threads=1, seed=3, single_camera=False)
    result = find_poses(photos, tmp_path / "new" / "capture", options, told)
    (settings,) = asked
    assert (settings.lens, settings.threads, settings.seed, settings.share) == ("radial", 1, 3, False)
    assert sorted(os.listdir(result.output)) == ["images", "poses.json", "poses.png", "sparse"]
    assert os.listdir(tmp_path / "new") == ["capture"]
    data = open_dataset(result.output)
    assert [v.name for v in data.held_out] == ["0.png", "8.png"] and len(data.train) == 7
    poses = {v.name: v.camera.to_world for v in (*data.train, *data.held_out)}
    assert np.allclose([poses[f"{k}.png"] for k in range(COUNT)], rendered.poses(COUNT), atol=1e-9)
    assert "points on surfaces" in data.box_from and not data.unused
    for k in range(COUNT):
        assert (result.output / "images" / f"{k}.png").read_bytes() == (photos / f"{k}.png").read_bytes()
    assert result.unregistered == [] and result.points == 400 and not told.warnings
    text = "\n".join(told.messages)
    assert "9 of 9 pictures have a pose, 400 points; mean reprojection error 0.40 pixels" in text
    assert "up is +z: the cameras are held level to 0.5 degrees" in text and "nerg train radiance" in text


def test_progress_grows_through_all_stages(photos, finds, tmp_path):
    finds(COUNT)
    told = Recorder()
    find_poses(photos, tmp_path / "capture", None, told)
    shares = [share for share, _ in told.steps]
    assert shares == sorted(shares) and 0 < shares[0] < STAGES["features"] and shares[-1] == STAGES["writing"]
    words = " ".join(text for _, text in told.steps)
    for said in ("copying pictures, 9 of 9", "finding features", "comparing pictures", "placing pictures, 1 of 2"):
        assert said in words


def test_pictures_without_a_pose_are_named_and_left_out(photos, finds, tmp_path):
    finds(7)
    told = Recorder()
    (photos / "bad.jpg").write_bytes(b"\xff\xd8 no photo")
    result = find_poses(photos, tmp_path / "capture", None, told)
    assert result.unregistered == ["7.png", "8.png"] and [u.name for u in result.skipped] == ["bad.jpg"]
    assert sorted(os.listdir(result.output / "images")) == [f"{k}.png" for k in range(7)]
    text = "\n".join(told.messages)
    assert "without a pose: 7.png, 8.png" in text and 'left out "bad.jpg"' in text and not told.warnings
    report = json.loads((result.output / "poses.json").read_text())
    assert report == result.report and report["unregistered"] == ["7.png", "8.png"] and "bad.jpg" in report["skipped"]


def test_too_few_and_parts_are_warned_of(photos, finds, tmp_path):
    finds(4)
    told = Recorder()
    find_poses(photos, tmp_path / "capture", None, told)
    parts, few = told.warnings
    assert "parts that nothing connects" in parts and "another has 5 (4.png, 5.png" in parts
    assert "less than half" in few and "take more of them" in few


def test_an_up_that_is_unsure_or_not_asked_for_is_told(photos, finds, tmp_path):
    from dataclasses import replace

    told = Recorder()
    finds(COUNT, lambda made: replace(made, up=Up(np.array([0, 0, 1.0]), 40.0)))
    find_poses(photos, tmp_path / "a", None, told)
    assert "do not agree on what is up" in told.warnings[0] and "--no-orient" in told.warnings[0]
    finds(COUNT, lambda made: replace(made, up=None))
    result = find_poses(photos, tmp_path / "b", PoseOptions(orient=False), told)
    assert "up was not looked for" in told.messages and result.report["up"] is None


def test_nothing_found_is_an_error_and_leaves_nothing(photos, finds, tmp_path):
    finds(0)
    with pytest.raises(NergError, match="no 3 of the 9 pictures .* show the same place; take more"):
        find_poses(photos, tmp_path / "capture")
    assert os.listdir(tmp_path) == ["photos"]


def test_a_model_that_was_cut_short_is_not_taken(photos, finds, tmp_path):
    """A disk that fills is not told of by COLMAP."""

    def cut(made):
        (work,) = (tmp_path).glob(".capture*.part/.work-*")
        (work / "sparse" / "0" / "images.txt").write_text("1 0.5 0.5\n")
        return made

    finds(COUNT, cut)
    with pytest.raises(NergError, match=r"images.txt"):
        find_poses(photos, tmp_path / "capture")
    assert os.listdir(tmp_path) == ["photos"]


@pytest.mark.parametrize("stage", ["copying", "finding", "comparing", "placing", "writing"])
def test_ctrl_c_leaves_nothing(stage, photos, finds, tmp_path):
    class Interrupts(Recorder):
        def progress(self, share, text=""):
            if text.startswith(stage):
                raise KeyboardInterrupt

    finds(COUNT)
    with pytest.raises(KeyboardInterrupt):
        find_poses(photos, tmp_path / "capture", None, Interrupts())
    assert os.listdir(tmp_path) == ["photos"]


def test_photos_that_are_too_few(photos, finds, tmp_path):
    finds(COUNT)
    for k in range(2, COUNT):
        (photos / f"{k}.png").unlink()
    with pytest.raises(NergError, match="has 2 pictures that can be used, and poses need 3 or more of the same place$"):
        find_poses(photos, tmp_path / "capture")
    for k in range(2, 6):
        (photos / f"{k}.png").write_bytes((photos / "0.png").read_bytes())
    with pytest.raises(NergError, match='"2.png".*"0.png"'):
        find_poses(photos, tmp_path / "capture")
    assert os.listdir(tmp_path) == ["photos"]


def test_frames_of_a_video(finds, tmp_path):
    av = pytest.importorskip("av", reason='PyAV is not installed (pip install "nerg-mi[poses]")')
    with av.open(str(tmp_path / "film.mp4"), "w") as out:
        stream = out.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 32, 24, "yuv420p"
        for k in range(12):
            pixels = np.random.default_rng(k).integers(0, 255, (24, 32, 3)).astype(np.uint8)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        out.mux(stream.encode())
    finds(4)
    result = find_poses(tmp_path / "film.mp4", tmp_path / "capture", PoseOptions(frames=4))
    seconds = list(result.report["seconds"].values())
    assert result.registered == [f"frame_{round(10 * s) + 1:06d}.jpg" for s in seconds]
    assert len(seconds) == 4 and seconds == sorted(seconds) and seconds[-1] >= 0.8
