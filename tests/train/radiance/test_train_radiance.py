"""Radiance fields: poses of photos, trainings and scores, and exchange with other programs."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import drjit.llvm.ad as ns
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from nerg_mi.environment.conversion import (
    ImportedFields,
    export_mesh,
    export_points,
    export_splats,
    export_volume,
    import_checkpoint,
)
from nerg_mi.environment.environment import Environment
from nerg_mi.environment.radiance import RadianceField
from nerg_mi.errors import NergError
from nerg_mi.evaluation.photos import evaluate_radiance
from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid
from nerg_mi.fields.radiance import RadianceNetwork
from nerg_mi.files.atomic import file_sha256
from nerg_mi.formats.checkpoint import read_checkpoint
from nerg_mi.formats.fields import load_radiance, matches_checksum, save_radiance
from nerg_mi.formats.splats import read_splats
from nerg_mi.interruption import TrainingInterrupted
from nerg_mi.photos.colmap import UpEstimate
from nerg_mi.photos.dataset import open_dataset
from nerg_mi.photos.structure import Reconstruction
from nerg_mi.train import compile as compilation
from nerg_mi.train import poses as job
from nerg_mi.train import radiance as training
from nerg_mi.train.compile import compile_field, refine_field
from nerg_mi.train.poses import STAGES, find_poses
from nerg_mi.train.radiance import train_radiance
from nerg_mi.train.radiance_run import train_field
from nerg_mi.train.radiance_settings import RadianceSettings
from tests.formats.test_torch_ngp import save_nerg as save
from tests.formats.test_torch_ngp import small_gaze, small_state
from tests.photos import rendered
from tests.plugins import fields
from tests.plugins.fields import radiance
from tests.recorder import Recorder
from tests.train.radiance.ball import BOX, TINY, ball_dataset, settings

# ---- Radiance fields by jobs: results and messages ----


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """A density grid of 32 cells per edge instead of 128, whose extraction at the end of a training takes long."""

    @dataclass(frozen=True)
    class Coarse(RadianceSettings):
        resolution: int = 32

    monkeypatch.setattr(training, "RadianceSettings", Coarse)


class Impatient(Recorder):
    """A reporter that raises ``KeyboardInterrupt`` at the first step."""

    def progress(self, share, text=""):
        if "step" in text:
            raise KeyboardInterrupt


def test_training_without_an_output_returns_a_result(cube):
    before, recorder = set(cube.iterdir()), Recorder()
    result = train_radiance(cube, steps=3, holdout=3, progress=recorder)
    assert set(cube.iterdir()) == before and result.path is None
    assert result.provenance["steps"] == 3 and 0 < result.provenance["psnr_held_out"]["mean"]
    assert result.network.box.lower == pytest.approx((-1.025,) * 3) and result.network.occupancy is not None
    assert "2 training views, 1 held out, 16 x 14 pixels" in recorder.messages
    assert recorder.warnings == result.provenance["complaints"] and recorder.warnings
    texts = [text for _, text in recorder.steps]
    assert texts[1].endswith("step 1") and "training" in texts[1] and "scoring" in texts[-1]
    shares = [share for share, _ in recorder.steps]
    assert shares == sorted(shares) and shares[0] == 0 and 0.9 < shares[-1] <= 1


def test_a_deferred_field_is_trained_and_evaluated(cube, tmp_path):
    """As trained, as written, and as evaluated by the integrator."""
    out = tmp_path / "f.safetensors"
    result = train_radiance(cube, steps=3, holdout=3, deferred=True, output=out)
    assert result.network.config.deferred
    scores = evaluate_radiance(out, cube, holdout=3, spp=4)
    assert np.isfinite(scores.psnr_mean)
    in_memory = evaluate_radiance(replace(result, path=None), cube, holdout=3, spp=4)
    assert in_memory.psnr == pytest.approx(scores.psnr, abs=1e-3)


def test_an_interrupted_training_without_an_output_has_a_result(cube):
    with pytest.raises(TrainingInterrupted, match="1 steps") as end:
        train_radiance(cube, steps=10**6, holdout=0, progress=Impatient())
    assert end.value.provenance["steps"] == 1 and end.value.field.network.occupancy is not None


def test_an_interrupted_training_with_an_output_can_be_resumed(cube):
    out = cube / "a.safetensors"
    with pytest.raises(KeyboardInterrupt, match="resume"):
        train_radiance(cube, steps=2, holdout=3, output=out, progress=Impatient())
    assert out.is_file() and out.with_suffix(".run").is_file()
    result = train_radiance(cube, steps=2, holdout=3, resume=True, output=out)
    assert result.provenance["steps"] == 2 and not out.with_suffix(".run").exists()
    assert read_checkpoint(out, "radiance")[1]["provenance"]["steps"] == 2


def test_resuming_without_an_output_is_refused(cube):
    with pytest.raises(NergError, match="does not exist; leave out resume=True to start"):
        train_radiance(cube, steps=2, resume=True)


def test_evaluation_without_an_output_returns_scores(cube):
    before, recorder = set(cube.iterdir()), Recorder()
    scores = evaluate_radiance(cube / "cube.safetensors", cube, holdout=2, spp=4, progress=recorder)
    assert set(cube.iterdir()) == before
    assert scores.psnr_mean == pytest.approx(np.mean(scores.psnr)) and scores.depth is None and scores.spp == 4
    assert len(recorder.messages) == len(scores.views) + 3 and recorder.messages[-2].startswith("mean")
    assert recorder.messages[-1].endswith(f"{np.mean(scores.psnr_fitted):.2f} dB")


def test_views_that_chose_the_state_are_scored_apart(cube, tmp_path):
    """Of two held-out views the first chooses the state; checkpoints of earlier versions name it in another key."""
    recorder, table = Recorder(), tmp_path / "s.json"
    field = train_radiance(cube, steps=2, holdout=2, progress=recorder)
    first, second = field.provenance["held_out"]["frames"]
    assert field.provenance["validation_views"] == field.provenance["psnr_watched"]["views"] == [first]
    stated = field.provenance["psnr_held_out"]
    assert stated["mean"] == stated["views"][second] and stated["validation"]["mean"] == stated["views"][first]
    lines = [line for line in recorder.messages if line.startswith("PSNR of 1 ")]
    assert f"PSNR of 1 held-out views: {stated['mean']:.2f} dB" in lines[0]
    assert f"which chose the state: {stated['validation']['mean']:.2f} dB" in lines[1]
    earlier = {key: value for key, value in field.provenance.items() if key != "validation_views"}
    for provenance in (field.provenance, earlier):
        recorder = Recorder()
        scores = evaluate_radiance(
            replace(field, provenance=provenance), cube, holdout=2, spp=1, json=table, progress=recorder
        )
        assert scores.views == [first, second] and scores.validation == [first]
        assert (scores.psnr_mean, scores.ssim_mean) == (scores.psnr[1], scores.ssim[1])
        assert scores.psnr_fitted_mean == scores.psnr_fitted[1]
        assert scores.validation_means == {n: getattr(scores, n)[0] for n in ("psnr", "ssim", "psnr_fitted")}
        assert [row["chose_state"] for row in scores.rows] == [True, False]
        assert json.loads(table.read_text())["validation_means"]["psnr"] == scores.psnr[0]
        assert any(line.startswith("1 of the 2 views chose the state") for line in recorder.messages)
        first_fitted, second_fitted = scores.psnr_fitted
        fitted = f"{second_fitted:.2f} dB; of validation views {first_fitted:.2f} dB"
        assert any(line.endswith(fitted) for line in recorder.messages)
        few = evaluate_radiance(replace(field, provenance=provenance), cube, holdout=2, spp=1, views=2)
        assert few.views == [second] and few.validation == []
    # Before states were chosen, the same views were evaluated, and the last state was the result.
    watched = {key: value for key, value in earlier["psnr_watched"].items() if key != "result"}
    plain = replace(field, provenance={**earlier, "psnr_watched": watched})
    scores = evaluate_radiance(plain, cube, holdout=2, spp=1)
    assert scores.validation == [] and scores.psnr_mean == pytest.approx(np.mean(scores.psnr))


def test_small_views_have_no_scores(cube, tmp_path):
    """A single pixel has no right half for fitted colours, and no window for SSIM."""
    recorder, out, table = Recorder(), tmp_path / "f.safetensors", tmp_path / "s.json"
    result = train_radiance(cube, steps=2, holdout=3, width=1, output=out, progress=recorder)
    assert result.provenance["psnr_held_out"]["mean_fitted"] is None and np.isfinite(
        result.provenance["psnr_held_out"]["mean"]
    )
    evaluate_radiance(out, cube, holdout=3, width=1, spp=1, json=table, progress=recorder)
    scores = json.loads(table.read_text())
    assert scores["ssim"] == scores["psnr_fitted"] == [None] and scores["psnr_mean"] > 0
    assert "ssim" in scores["notes"][0] and "psnr_fitted" in scores["notes"][0]
    assert not any("nan" in text for text in recorder.messages) and "11 x 11" in recorder.warnings[-1]


def test_training_views_are_refused_as_held_out_views(cube):
    out = cube / "a.safetensors"
    train_radiance(cube, steps=2, holdout=3, output=out)
    with pytest.raises(NergError, match="was trained on"):
        evaluate_radiance(out, cube, holdout=2)
    assert evaluate_radiance(out, cube, holdout=2, train=True, spp=1).views


# ---- Imported checkpoints of other programs, with and without files ----


def test_imported_fields_are_saved_by_kind(torch, tmp_path):
    path, recorder = save(tmp_path / "nerg.pth", small_gaze(), nerf=small_state()), Recorder()
    field, gaze = result = import_checkpoint(path, half=True, progress=recorder)
    assert field.kind == "radiance" and gaze.kind == "gaze" and gaze.network.config.variant == "emit_capture"
    assert [p.name for p in tmp_path.iterdir()] == ["nerg.pth"] and len(recorder.messages) == 2
    result.save(tmp_path / "f.safetensors", tmp_path / "g.safetensors")
    assert RadianceField.load(tmp_path / "f.safetensors").half and (tmp_path / "g.safetensors").is_file()
    assert field.provenance == RadianceField.load(tmp_path / "f.safetensors").provenance
    for only in (ImportedFields(field, None), ImportedFields(None, gaze)):
        with pytest.raises(NergError) as error:
            only.save(tmp_path / "a.safetensors", tmp_path / "b.safetensors")
        assert "gaze" in error.value.parameters
    assert not (tmp_path / "a.safetensors").exists() and not (tmp_path / "b.safetensors").exists()


# ---- Exports from a file and from a loaded field ----


@pytest.fixture
def field(tmp_path):
    fields.radiance(tmp_path / "f.safetensors")
    return tmp_path / "f.safetensors"


def test_a_field_and_its_file_give_equal_exports(field, tmp_path):
    options, recorder = {"resolution": 16, "density_threshold": 3.0, "max_points": 50}, Recorder()
    first = export_points(field, **options, progress=recorder)
    second = export_points(RadianceField.load(field), **options)
    assert len(first.vertices) == 50 and recorder.messages[0].startswith("50 points")
    first.save(tmp_path / "a.ply")
    second.save(tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_exported_splats_are_on_the_surface(field, tmp_path):
    splats = export_splats(field, resolution=16, density_threshold=3.0)
    splats.save(tmp_path / "a.ply")
    assert len(read_splats(tmp_path / "a.ply")) == len(splats) and (np.abs(splats.centers) < 1.3).all()


def test_a_volume_is_exported_with_its_colour(field, tmp_path):
    files = tmp_path / "d.vol", tmp_path / "c.vol"
    export_volume(field, resolution=8, color=True).save(*files)
    assert all(path.is_file() for path in files)
    with pytest.raises(NergError):
        export_volume(field, resolution=8).save(*files)


def test_a_wrong_axis_is_refused(field):
    with pytest.raises(NergError) as error:
        export_points(field, up="x")
    assert "up" in error.value.parameters


# ---- Checkpoints with a finer bound: the same field, compatible with the checksum of the old file ----


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("refined")
    bits = np.random.default_rng(0).random((6, 6, 6)) < 0.4
    radiance(folder / "old.safetensors", density_scale=8e-3, occupancy=OccupancyGrid(bits, ns, 0.05))
    result = refine_field(folder / "old.safetensors")
    result.save(folder / "new.safetensors")
    return folder / "old.safetensors", folder / "new.safetensors", result.network.occupancy


def test_refinement_changes_only_the_bound(files):
    old, new, grid = files
    (tensors, meta), (again, refined_meta) = (read_checkpoint(p, "radiance") for p in (old, new))
    assert set(again) - set(tensors) == {"occupancy.parts"}
    assert all(
        np.array_equal(again[name], tensors[name]) and again[name].dtype == tensors[name].dtype for name in tensors
    )
    assert {k: v for k, v in refined_meta.items() if k not in ("occupancy", "refined_from")} == {
        k: v for k, v in meta.items() if k != "occupancy"
    }
    # Readers without refinement see the original cells.
    assert {k: v for k, v in refined_meta["occupancy"].items() if k != "refined"} == meta["occupancy"]
    loaded = load_radiance(new, ns)[0].occupancy
    assert np.array_equal(loaded.masks, grid.masks) and loaded.missed_optical_depth == grid.missed_optical_depth
    assert 0 < loaded.occupied_fraction < loaded.coarse.occupied_fraction


def test_a_gaze_field_accepts_the_refined_checkpoint(files, tmp_path):
    old, new, _ = files
    checksum = file_sha256(old)
    assert matches_checksum(old, checksum) and matches_checksum(new, checksum)
    assert not matches_checksum(new, "0" * 64) and not matches_checksum(new, None)
    refine_field(new).save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == new.read_bytes()


def test_refinement_keeps_the_object_and_half_precision(files, tmp_path):
    field = RadianceField.load(files[0])
    field.save(tmp_path / "half.safetensors", half=True)
    half = RadianceField.load(tmp_path / "half.safetensors")
    refine_field(half).save(tmp_path / "new.safetensors")
    assert isinstance(half.network.occupancy, OccupancyGrid)
    new, old = (read_checkpoint(path, "radiance")[0] for path in (tmp_path / "new.safetensors", half.path))
    assert all(np.array_equal(new[name], old[name]) and new[name].dtype == old[name].dtype for name in old)


def test_new_weights_discard_the_refinement(files):
    field, _ = load_radiance(files[1], ns)
    refined = field.occupancy
    field.set_parameters({"density_net.0": field.parameters()["density_net.0"]})
    assert isinstance(field.occupancy, OccupancyGrid) and np.array_equal(field.occupancy.bits, refined.coarse_bits)


@pytest.mark.parametrize(
    "occupancy, what",
    [(None, "no occupancy grid to refine"), (CascadeGrid(np.ones((2, 4, 4, 4), bool), 2.0, ns, 0.1), "nested cubes")],
)
def test_fields_without_an_occupancy_grid_are_refused(tmp_path, occupancy, what):
    radiance(tmp_path / "f.safetensors", occupancy=occupancy)
    with pytest.raises(NergError, match=what):
        refine_field(tmp_path / "f.safetensors")


# ---- Poses of photos ----


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
    up = UpEstimate(np.array([0, 0, 1.0]), 0.5, 0.4, 0.7)
    parts = [names[:keep]] + ([names[keep:]] if len(names) - keep >= 3 else [])
    colors = np.full((400, 3), 99, np.uint8)
    return Reconstruction(parts, 0.4, 400, up, [{"model": "OPENCV"}], to_world, points, colors)


@pytest.fixture
def finds(monkeypatch):
    """`finds(keep)` poses ``keep`` pictures; returns a list of the requested settings."""

    def choose(keep: int, change=lambda made: made) -> list:
        calls = []

        def stand_in(pictures, work, settings, progress):
            calls.append(settings)
            for stage in ("features", "matching", "mapping"):
                progress(stage, 1, 2)
            return change(written(pictures, Path(work), keep)) if keep else None

        monkeypatch.setattr(job, "reconstruct", stand_in)
        return calls

    monkeypatch.setattr(job, "check_installed", lambda: None)
    return choose


def test_the_written_capture_is_readable(photos, finds, tmp_path):
    calls = finds(COUNT)
    recorder = Recorder()
    options = dict(camera_model="radial", threads=1, seed=3, single_camera=False)
    result = find_poses(photos, tmp_path / "new" / "capture", **options, progress=recorder)
    (settings,) = calls
    assert (settings.lens, settings.threads, settings.seed, settings.share_cameras) == ("radial", 1, 3, False)
    assert sorted(os.listdir(result.output)) == ["images", "poses.json", "poses.png", "sparse"]
    assert os.listdir(tmp_path / "new") == ["capture"]
    data = open_dataset(result.output)
    assert [v.name for v in data.held_out] == ["0.png", "8.png"] and len(data.train) == 7
    poses = {v.name: v.camera.to_world for v in (*data.train, *data.held_out)}
    assert np.allclose([poses[f"{k}.png"] for k in range(COUNT)], rendered.poses(COUNT), atol=1e-9)
    assert "surface points" in data.box_source and not data.unused
    for k in range(COUNT):
        assert (result.output / "images" / f"{k}.png").read_bytes() == (photos / f"{k}.png").read_bytes()
    assert result.unregistered == [] and result.points == 400 and not recorder.warnings
    text = "\n".join(recorder.messages)
    assert "9 of 9 images have a pose, 400 points; mean reprojection error 0.40 pixels" in text
    assert "up is +z: the cameras are held level to 0.5 degrees" in text and "nerg train radiance" in text


def test_progress_increases_through_all_stages(photos, finds, tmp_path):
    finds(COUNT)
    recorder = Recorder()
    find_poses(photos, tmp_path / "capture", progress=recorder)
    shares = [share for share, _ in recorder.steps]
    assert shares == sorted(shares) and 0 < shares[0] < STAGES["features"] and shares[-1] == STAGES["writing"]
    words = " ".join(text for _, text in recorder.steps)
    for said in ("copying images, 9 of 9", "extracting features", "matching images", "registering images, 1 of 2"):
        assert said in words


def test_photos_without_a_pose_are_reported_and_skipped(photos, finds, tmp_path):
    finds(7)
    recorder = Recorder()
    (photos / "bad.jpg").write_bytes(b"\xff\xd8 no photo")
    result = find_poses(photos, tmp_path / "capture", progress=recorder)
    assert result.unregistered == ["7.png", "8.png"] and [u.name for u in result.skipped] == ["bad.jpg"]
    assert sorted(os.listdir(result.output / "images")) == [f"{k}.png" for k in range(7)]
    text = "\n".join(recorder.messages)
    assert "7.png" in text and 'not used: "bad.jpg"' in text and not recorder.warnings
    report = json.loads((result.output / "poses.json").read_text())
    assert report == result.report and report["unregistered"] == ["7.png", "8.png"] and "bad.jpg" in report["skipped"]


def test_few_poses_and_separate_models_cause_warnings(photos, finds, tmp_path):
    finds(4)
    recorder = Recorder()
    find_poses(photos, tmp_path / "capture", progress=recorder)
    parts, few = recorder.warnings
    assert "unconnected models" in parts and "another has 5 images (4.png, 5.png" in parts
    assert "less than half" in few and "take more images" in few


def test_an_uncertain_or_disabled_up_direction_is_reported(photos, finds, tmp_path):
    from dataclasses import replace

    recorder = Recorder()
    finds(COUNT, lambda made: replace(made, up=UpEstimate(np.array([0, 0, 1.0]), 40.0)))
    find_poses(photos, tmp_path / "a", progress=recorder)
    assert "disagree on the up direction" in recorder.warnings[0] and "orient=False" in recorder.warnings[0]
    finds(COUNT, lambda made: replace(made, up=None))
    result = find_poses(photos, tmp_path / "b", orient=False, progress=recorder)
    assert "the up direction was not estimated" in recorder.messages and result.report["up"] is None


def test_a_failed_reconstruction_is_refused_and_leaves_no_file(photos, finds, tmp_path):
    finds(0)
    with pytest.raises(NergError, match="show the same scene; take more images, each"):
        find_poses(photos, tmp_path / "capture")
    assert os.listdir(tmp_path) == ["photos"]


def test_a_truncated_model_is_refused(photos, finds, tmp_path):
    """COLMAP does not report a full disk."""

    def cut(made):
        (work,) = (tmp_path).glob(".capture*.part/.work-*")
        (work / "sparse" / "0" / "images.txt").write_text("1 0.5 0.5\n")
        return made

    finds(COUNT, cut)
    with pytest.raises(NergError, match=r"images.txt"):
        find_poses(photos, tmp_path / "capture")
    assert os.listdir(tmp_path) == ["photos"]


@pytest.mark.parametrize("stage", ["copying", "extracting", "matching", "registering", "writing"])
def test_ctrl_c_leaves_no_file(stage, photos, finds, tmp_path):
    class Interrupts(Recorder):
        def progress(self, share, text=""):
            if text.startswith(stage):
                raise KeyboardInterrupt

    finds(COUNT)
    with pytest.raises(KeyboardInterrupt):
        find_poses(photos, tmp_path / "capture", progress=Interrupts())
    assert os.listdir(tmp_path) == ["photos"]


def test_too_few_photos_are_refused(photos, finds, tmp_path):
    finds(COUNT)
    for k in range(2, COUNT):
        (photos / f"{k}.png").unlink()
    with pytest.raises(NergError, match="usable images, and pose estimation needs at"):
        find_poses(photos, tmp_path / "capture")
    for k in range(2, 6):
        (photos / f"{k}.png").write_bytes((photos / "0.png").read_bytes())
    with pytest.raises(NergError, match='"2.png".*"0.png"'):
        find_poses(photos, tmp_path / "capture")
    assert os.listdir(tmp_path) == ["photos"]


def test_frames_of_a_video_are_extracted(finds, tmp_path):
    av = pytest.importorskip("av", reason='PyAV is not installed (pip install "nerg-mi[poses]")')
    with av.open(str(tmp_path / "film.mp4"), "w") as out:
        stream = out.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 32, 24, "yuv420p"
        for k in range(12):
            pixels = np.random.default_rng(k).integers(0, 255, (24, 32, 3)).astype(np.uint8)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        out.mux(stream.encode())
    finds(4)
    result = find_poses(tmp_path / "film.mp4", tmp_path / "capture", num_frames=4)
    seconds = list(result.report["seconds"].values())
    assert result.registered == [f"frame_{round(10 * s) + 1:06d}.jpg" for s in seconds]
    assert len(seconds) == 4 and seconds == sorted(seconds) and seconds[-1] >= 0.8


# ---- Fields that are hardly trained ----


@pytest.fixture
def empty_field(tmp_path, rgb):
    """A field without an occupied cell, as a training of a few steps leaves it, and its file."""
    field = RadianceNetwork.random(TINY, BOX, ns, 0, march_step=1 / 64)
    field.occupancy = OccupancyGrid(np.zeros((8, 8, 8), bool), ns, 0.1)
    save_radiance(field, tmp_path / "empty.safetensors", {})
    return field, tmp_path / "empty.safetensors"


def test_an_empty_field_is_refused_by_name(empty_field):
    field, path = empty_field
    for use in (
        lambda: compile_field(RadianceField(field)),
        lambda: compile_field(path),
        lambda: export_mesh(path),
        lambda: export_splats(RadianceField(field)),
        lambda: Environment.open(path),
    ):
        with pytest.raises(NergError, match="empty.*train it longer"):
            use()


def test_compiled_fields_are_compared_by_absolute_differences():
    reference = np.full((4, 5), 0.5)
    reference[:, 3:] = 1, 2
    compiled = reference.copy()
    compiled[:, :3] += 0.1
    compiled[:, 4] += [0.5, -0.5, 0.5, -0.5]
    error = compilation._compare(reference, compiled, SimpleNamespace(resolution=8, size=64), 2.0)
    assert (error.depth_median, error.depth_99, error.psnr) == pytest.approx((0.5, 0.5, 20))


def test_a_field_without_matter_is_not_compiled(rgb):
    """Its density is too small in all cells of its occupancy."""
    field = RadianceNetwork.random(replace(TINY, density_scale=1e-6), BOX, ns, 0, march_step=1 / 64)
    field.occupancy = OccupancyGrid(np.ones((8, 8, 8), bool), ns, 0.1)
    with pytest.raises(NergError, match="no matter"):
        compile_field(RadianceField(field), resolution=64)


def test_a_training_reports_that_its_field_is_empty():
    thin = replace(TINY, density_scale=1e-9)
    _, provenance = train_field(ball_dataset(), thin, settings(steps=2), ns)
    assert any("is empty" in line for line in provenance["complaints"])
