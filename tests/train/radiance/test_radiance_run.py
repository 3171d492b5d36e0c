"""Tests of `nerg_mi.train.radiance_run`."""

import csv
from dataclasses import replace
from itertools import count
from types import SimpleNamespace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.fields import load_radiance, save_radiance
from nerg_mi.maths.color import color_corrected_psnr, psnr
from nerg_mi.maths.geometry import Box, ContractedBox
from nerg_mi.photos.cameras import Intrinsics, PosedCamera, pixel_directions
from nerg_mi.photos.images import PhotoView
from nerg_mi.train import radiance_run
from nerg_mi.train.radiance_run import (
    Pace,
    WatchedViews,
    compute_outside_fraction,
    evaluate_views,
    train_field,
    warm_up,
)
from nerg_mi.train.radiance_trainer import Preview, RadianceTrainer
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import trace_depth
from tests.tiny import ball_pose

from .ball import BOX, LENS, RADIUS, TINY, ball, settings, state, trainer

# ---- The share of pixels beyond a box, where depths are known in closed form ----

WIDE = Intrinsics(40, 20, 40.0, 40.0, 20.0, 10.0)


def made(x, opacity=1.0):
    """A camera at (x, 0, 0) that looks along -z at the plane z = -4, and its picture."""
    pose = np.eye(4)
    pose[0, 3] = x
    depth = 4 / -pixel_directions(WIDE)[..., 2]
    view = PhotoView("plane", PosedCamera(WIDE, pose), np.zeros((20, 40, 3), np.float32))
    return view, Preview(np.zeros((20, 40, 3)), np.full((20, 40), opacity), depth)


@pytest.mark.parametrize("every", [1, 2])
def test_half_of_a_plane_is_outside(every):
    core = Box((0, -9, -9), (9, 9, 0))
    part = slice(every // 2, None, every)
    views = {view.camera.center[0]: (view, seen) for view, seen in (made(0.0), made(-50.0))}

    def render(view):
        seen = views[view.camera.center[0]][1]
        return Preview(seen.color[part, part], seen.opacity[part, part], seen.depth[part, part])

    ahead, aside = (views[x][0] for x in (0.0, -50.0))
    assert compute_outside_fraction([ahead], render, core, every) == pytest.approx(0.5)
    assert compute_outside_fraction([ahead, aside], render, core, every) == pytest.approx(0.75)


def test_transparent_pixels_count_as_outside():
    view, seen = made(0.0, opacity=0.3)
    assert compute_outside_fraction([view], lambda v: seen, Box((-9, -9, -9), (9, 9, 0))) == 1


# ---- The error on held-out views: evaluated pixels and colours ----


def test_masked_pixels_do_not_count(dataset):
    view = dataset.held_out[0]
    trainer = RadianceTrainer(dataset.train, BOX, TINY, settings(), ns, depth=False)
    mask = np.arange(24)[:, None] < np.full(24, 12)
    spoilt = view.pixels.copy()
    spoilt[~mask] = 1 - spoilt[~mask]
    full, other, masked, same = evaluate_views(
        trainer,
        [
            view,
            replace(view, pixels=spoilt),
            *(replace(view, pixels=pixels, mask=mask) for pixels in (view.pixels, spoilt)),
        ],
        2,
    ).psnr
    assert masked == same and full != other and masked != full


def test_both_errors_are_those_of_the_rendered_view(dataset):
    trainer, views = RadianceTrainer(dataset.train, BOX, TINY, settings(), ns, depth=False), dataset.held_out[:2]
    field = trainer.make_field(with_occupancy=False)
    error = evaluate_views(trainer, views, 2, field)
    for k, view in enumerate(views):
        seen, truth = trainer.render(view, 2, field).color, view.composite_over(0)[1::2, 1::2]
        assert error.psnr[k] == pytest.approx(psnr(seen, truth), rel=1e-6)
        alpha = view.color[1::2, 1::2, 3]
        assert error.psnr_fitted[k] == pytest.approx(color_corrected_psnr(seen, truth, alpha), rel=1e-6)


# ---- Whole radiance trainings: they converge, and report their progress ----


@pytest.mark.slow
def test_held_out_views_of_a_ball(dataset, tmp_path):
    """20 dB on held-out views after 300 small steps; the checkpoint documents the run."""
    seen = []
    field, provenance = train_field(dataset, TINY, settings(), ns, on_progress=seen.append)
    assert provenance["psnr_held_out"]["mean"] > 20
    assert provenance["depth_supervision"] and provenance["steps"] == 300
    save_radiance(field, tmp_path / "ball.safetensors", provenance, half=True)
    loaded, meta = load_radiance(tmp_path / "ball.safetensors", ns)
    assert meta["provenance"]["settings"]["seed"] == 1
    assert loaded.color_space == "srgb" and loaded.march_step == pytest.approx(2 / 64)


@pytest.mark.parametrize("limit", [{"steps": 12}, {"steps": None, "minutes": 0.05}])
def test_progress_counts_all_phases(dataset, monkeypatch, limit):
    """It never falls, and time remains until the field is written."""
    monkeypatch.setattr(radiance_run, "MIN_EVALUATION_INTERVAL", 1)
    seen = []
    train_field(dataset, TINY, settings(**limit), ns, on_progress=seen.append, write=lambda *_: None)
    phases = list(dict.fromkeys(now.phase for now in seen))
    assert phases == ["training", "extracting", "scoring", "writing"] and seen[-1].phase == "writing"
    # At the start, and after each part of the occupancy.
    extracting = [now.fraction for now in seen if now.phase == "extracting"]
    assert len(extracting) > 3
    fractions = [now.fraction for now in seen]
    assert fractions == sorted(fractions) and 0.9 < fractions[-1] < 1
    assert all(now.remaining > 0 and now.fraction < 1 for now in seen)


def test_an_observer_does_not_change_the_weights(dataset, one_thread):
    """An observer that renders a view after each step, compared with none, bit for bit."""
    steps = []

    class Renders:
        def on_start(self, trainer, data):
            assert trainer.steps == 0 and data is dataset

        def on_step(self, trainer, history):
            steps.append(trainer.steps)
            trainer.render(dataset.held_out[0], 2, stride=trainer.stride)

    plain, observed = (train_field(dataset, TINY, settings(steps=24), ns, observer=o)[0] for o in (None, Renders()))
    assert steps == list(range(1, 25))
    for name, value in plain.parameters().items():
        assert np.array_equal(value.numpy(), observed.parameters()[name].numpy()), name
    assert np.array_equal(plain.occupancy.masks, observed.occupancy.masks)


def test_outputs_are_updated_at_each_evaluation(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(radiance_run, "MIN_EVALUATION_INTERVAL", 1)
    curves, preview, lengths = tmp_path / "a.curves.csv", tmp_path / "a.preview.png", []

    class Reads:
        def on_start(self, trainer, data):
            assert not curves.exists()

        def on_step(self, trainer, history):
            if history:
                lengths.append(len(curves.read_text().splitlines()) - 1)
                assert lengths[-1] == len(history)

    files = {"curves": curves, "preview": preview}
    _, provenance = train_field(dataset, TINY, settings(steps=12), ns, observer=Reads(), **files)
    history = provenance["psnr_watched"]["history"]
    assert len(set(lengths)) > 3 and lengths[-1] == len(history) - 1
    with curves.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["steps"]) for row in rows] == [row["steps"] for row in history]
    assert [float(row["psnr"]) for row in rows] == [row["psnr"] for row in history]
    assert set(rows[0]) == {"steps", "seconds", "psnr", "psnr_train", "every_pixel", "note"}
    # The last evaluation has the time of the last step, and not that of the occupancy extraction after it.
    assert float(rows[-1]["seconds"]) == provenance["seconds"]  # noqa: RUF069 (stored)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.curves.csv", "a.curves.png", "a.preview.png"]


def test_there_are_no_outputs_without_held_out_views(dataset, tmp_path):
    files = {"curves": tmp_path / "a.csv", "preview": tmp_path / "a.png"}
    train_field(replace(dataset, held_out=[]), TINY, settings(steps=2), ns, **files)
    assert not list(tmp_path.iterdir())


def test_resuming_needs_a_state(dataset):
    with pytest.raises(NergError, match="cannot resume"):
        train_field(dataset, TINY, settings(steps=1), ns, resume=True)


# ---- Pace ----


@pytest.mark.parametrize("steps, warns", [(40, True), (60, False)])
def test_a_low_pace_is_reported_after_a_tenth(steps, warns):
    """A run of a minute that has made ``steps`` steps in its first six seconds."""
    t = SimpleNamespace(steps=0, seconds=0.0, progress=0.0, reserved_seconds=0.0, settings=SimpleNamespace(minutes=1.0))
    pace = Pace(t)
    t.steps, t.seconds, t.progress = steps - 1, 5.9, 5.9 / 60
    assert pace.judge() is None
    t.steps, t.seconds, t.progress = steps, 6.0, 0.1
    line = pace.judge()
    assert Pace(t).judge() is None  # It has just been resumed
    assert pace.judge() is None and 0 <= pace.waiting_fraction < 1
    assert (line is not None) == warns
    if warns:
        assert "6.7 per second" in line and "about 400 steps" in line and "at least 500" in line


def test_the_pace_counts_without_the_time_of_the_result():
    """600 steps in a minute are 350 if 25 seconds of it are for the result."""
    t = SimpleNamespace(
        steps=0, seconds=0.0, progress=0.0, reserved_seconds=25.0, settings=SimpleNamespace(minutes=1.0)
    )
    pace = Pace(t)
    t.steps, t.seconds, t.progress = 40, 4.0, 0.115
    line = pace.judge()
    assert line is not None and "about 350 steps" in line


# ---- The best state is the result ----


@pytest.mark.parametrize("falls", [True, False])
def test_the_best_state_is_the_result(dataset, tmp_path, monkeypatch, falls):
    """Held-out views of another scene are best at the start of a training; those of the scene are best at its end."""
    monkeypatch.setattr(radiance_run, "MIN_EVALUATION_INTERVAL", 1)
    evaluate, number = radiance_run._evaluate, count()
    monkeypatch.setattr(radiance_run, "_evaluate", lambda *a: {**evaluate(*a), "number": next(number)})
    rng, held_out = np.random.default_rng(0), dataset.held_out
    if falls:
        # Grey noise: the untrained field, which is fog, is nearer to it than a ball.
        grey = 0.3 + 0.1 * rng.random((24, 24, 3)).astype(np.float32)
        held_out = [replace(v, pixels=grey, depth=None) for v in held_out]
    plan = settings(steps=60, photo_colors=False)  # Fitted colours would turn a ball into grey
    field, provenance = train_field(replace(dataset, held_out=held_out), TINY, plan, ns)
    history, result = provenance["psnr_watched"]["history"], provenance["psnr_watched"]["result"]
    best = max(row["psnr"] for row in history)
    assert result["psnr"] > best - 0.3
    assert result in history  # The repeated evaluation of the best state replaces that during the training.
    assert (result["steps"] < 60) == falls and history[-1]["steps"] == 60
    assert history[-1]["psnr_train"] > history[0]["psnr_train"]
    # The written field is the one that was evaluated.
    save_radiance(field, tmp_path / "a.safetensors", provenance)
    loaded, _ = load_radiance(tmp_path / "a.safetensors", ns)
    # Two of the four held-out views, the first and the last, chose the state and are not in its score.
    stated = provenance["psnr_held_out"]
    again = evaluate_views(RadianceTrainer(dataset.train, BOX, TINY, settings(), ns), held_out, 1, loaded).psnr
    assert stated["mean"] == pytest.approx((again[1] + again[2]) / 2, abs=0.01)
    assert stated["validation"]["mean"] == pytest.approx((again[0] + again[3]) / 2, abs=0.01)
    assert list(stated["views"].values()) == pytest.approx(again, abs=0.01)


def test_a_single_held_out_view_does_not_choose_the_state(dataset, monkeypatch):
    """It is evaluated during the training, where it is best at the start, and scores the last state."""
    monkeypatch.setattr(radiance_run, "MIN_EVALUATION_INTERVAL", 1)
    grey = 0.3 + 0.1 * np.random.default_rng(0).random((24, 24, 3)).astype(np.float32)
    held_out = [replace(dataset.held_out[0], pixels=grey, depth=None)]
    plan = settings(steps=60, photo_colors=False)
    _, provenance = train_field(replace(dataset, held_out=held_out), TINY, plan, ns)
    watched = provenance["psnr_watched"]
    assert watched["history"][0]["psnr"] > watched["result"]["psnr"] + 1 and watched["result"]["steps"] == 60
    assert watched["views"] == ["ball 0"] and provenance["validation_views"] == []
    scores = provenance["psnr_held_out"]
    assert scores["mean"] == scores["views"]["ball 0"] and scores["validation"]["mean"] is None


@pytest.mark.parametrize(
    "held_out, validation",
    [(0, []), (1, []), (2, [0]), (3, [0]), (5, [0, 4]), (8, [0, 2, 5, 7]), (30, [0, 10, 19, 29])],
)
def test_at_most_half_of_the_held_out_views_choose_the_state(dataset, held_out, validation):
    views = [replace(dataset.held_out[0], name=str(k)) for k in range(held_out)]
    watched = WatchedViews.choose(replace(dataset, held_out=views))
    assert watched.validation_names == [str(k) for k in validation]
    assert [view.name for view in watched.training] == ["ball 4", "ball 23"]


def test_all_evaluations_of_a_run_cover_the_same_pixels(dataset, monkeypatch):
    monkeypatch.setattr(radiance_run, "MIN_EVALUATION_INTERVAL", 1)
    strides = iter(range(1, 100))
    monkeypatch.setattr(RadianceTrainer, "choose_pixel_stride", lambda *_: next(strides))
    _, provenance = train_field(dataset, TINY, settings(steps=20), ns)
    history = provenance["psnr_watched"]["history"]
    assert len(history) > 2 and {row["every_pixel"] for row in history} == {1}


@pytest.mark.parametrize("photo_colors", [True, pytest.param(False, marks=pytest.mark.nightly)])
def test_the_exposure_of_held_out_photos_does_not_choose_the_state(dataset, monkeypatch, photo_colors):
    monkeypatch.setattr(radiance_run, "MIN_EVALUATION_INTERVAL", 1)
    dark = [replace(v, pixels=0.4 * v.color, depth=None) for v in dataset.held_out]
    watched = []
    for views in (dataset.held_out, dark):
        plan = settings(steps=60, photo_colors=photo_colors)
        _, provenance = train_field(replace(dataset, held_out=views), TINY, plan, ns)
        watched.append(provenance["psnr_watched"]["result"]["psnr"])
    # Fitted colours of darker photos have an error that is smaller in proportion.
    assert watched[1] > watched[0] + 3 if photo_colors else watched[1] < watched[0]


# ---- Compiling before a run's clock starts changes nothing of the run, and leaves nothing to be compiled in it ----


def kernels_of_a_run(t) -> list[tuple[int, int, int]]:
    """Step, size and operations of each kernel that the rest of a run compiles, or loads from the disk cache."""
    result = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        while t.progress < 1:
            t.step()
            result += [
                (t.steps, k["size"], k["operation_count"])
                for k in dr.kernel_history([dr.KernelType.JIT])
                if not k["cache_hit"] or k["cache_disk"]
            ]
    return [k for k in result if k[2] > 20]  # Kernels of a few operations take no longer than a step


@pytest.mark.parametrize("depth", [True, False])
def test_a_run_is_the_same_bit_for_bit(dataset, one_thread, depth):
    plain, warm = (trainer(dataset, steps=24, depth=depth) for _ in range(2))
    warm_up(warm)
    assert warm.steps == warm.extraction.pieces_done == 0 and not warm.clock.durations
    for t in (plain, warm):
        while t.progress < 1:
            t.step()
    expected, got = state(plain), state(warm)
    for name, value in expected.items():
        assert np.array_equal(value, got[name]), name


@pytest.mark.parametrize("depth", [True, False])
def test_nothing_is_compiled_in_a_run(dataset, depth):
    """Through all strides, grid updates, hard pixels, the end of damping and of empty space near cameras, and
    occupancy extraction.
    """
    data = dataset if depth else replace(dataset, train=[replace(v, depth=None) for v in dataset.train])
    t = trainer(data, steps=120, depth=depth, extraction_start=0.4)
    space_ends = t._late_free_space is not None
    # Other trainings in this process have compiled most kernels.
    dr.flush_kernel_cache()
    warm_up(t)
    assert not kernels_of_a_run(t)
    assert t.stride == 1 and t.extraction.is_done
    assert space_ends != depth and t._late_free_space is None


def test_nothing_is_compiled_once_fog_has_cleared(dataset):
    """If everything is fog at first, no cell is empty and the occupancy is empty."""
    t = trainer(dataset, steps=60, depth=False, extraction_start=0.4)
    value = type(t.grid.value)(t.grid.value)
    t.grid.value, t.grid.dilate_cells = (
        dr.full(type(value), 1, len(value)),
        lambda result: np.zeros((t.grid.resolution,) * 3, bool),
    )
    dr.eval(t.grid.value)
    dr.flush_kernel_cache()
    warm_up(t)
    t.grid.value = value
    del t.grid.dilate_cells
    assert not kernels_of_a_run(t)


# ---- An unbounded scene: a ball in front of a far wall ----

FAR = 6.0


def before_a_wall(pose):
    """The ball, and behind it a sphere of radius FAR with coloured waves."""
    view = ball(pose)
    d = pixel_directions(LENS) @ pose[:3, :3].T
    o = pose[:3, 3]
    b = d @ o
    away = -b + np.sqrt(b * b - o @ o + FAR**2)
    p = o + d * away[..., None]
    wall = 0.5 + 0.4 * np.sin(8 * p / FAR)
    seen = np.where(view.pixels[..., 3:] > 0, view.pixels[..., :3], wall)
    depth = np.where(view.depth > 0, view.depth, away)
    return PhotoView("ball", view.camera, seen.astype(np.float32), depth.astype(np.float32))


def poses(count):
    """Cameras at distance 2 from the ball, all on one side, so that each part of the wall is in many pictures."""
    rng = np.random.default_rng(0)
    for a, e in rng.uniform([-0.7, -0.5], [0.7, 0.5], (count, 2)):
        yield ball_pose(2 * np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)]))


@pytest.fixture(scope="module")
def trained():
    views = [before_a_wall(pose) for pose in poses(44)]
    trainer = RadianceTrainer(views[4:], ContractedBox(BOX, 32), TINY, settings(steps=300, photo_colors=False), ns)
    while trainer.progress < 1:
        trainer.step()
    field = trainer.make_field()
    return field, evaluate_views(trainer, views[:4], 1, field).mean, trainer


@pytest.mark.nightly
@pytest.mark.slow
def test_distant_surfaces_are_learned(trained):
    assert trained[1] > 17


@pytest.mark.slow
def test_depths_are_those_of_the_scene(trained):
    field, _, _ = trained
    eye = np.array([[0.0, -2.0, 0.3]])
    at = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.2]])
    d = at - eye
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    near = trace_depth(FieldMedium(field), np.repeat(eye, 2, axis=0), d)[0]
    b = d @ eye[0]
    np.testing.assert_allclose(near, -b - np.sqrt(b * b - eye[0] @ eye[0] + RADIUS**2), atol=0.4)
    away = np.array([[0.3, 1.0, 0.2], [-0.3, 1.0, 0.1]])
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    far = trace_depth(FieldMedium(field), np.repeat(eye, 2, axis=0), away)[0]
    b = away @ eye[0]
    np.testing.assert_allclose(far, -b + np.sqrt(b * b - eye[0] @ eye[0] + FAR**2), rtol=0.35)


@pytest.mark.slow
def test_occupancy_contains_all_visible_surfaces(trained):
    """The renderer, which skips by cascades, compared with the trainer, which samples the cells of its own grid.

    The renderer may absorb more: after so few steps, fog is left in cells that the trainer does not sample.
    """
    field, _, trainer = trained
    view = before_a_wall(next(poses(1)))
    d = (pixel_directions(LENS) @ view.camera.to_world[:3, :3].T).reshape(-1, 3)
    depth, opacity = trace_depth(FieldMedium(field), np.tile(view.camera.center, (len(d), 1)), d, kind="expected")
    trained_in = trainer.render(view)
    excess = opacity - trained_in.opacity.ravel()
    assert excess.min() > -0.01 and excess.mean() < 0.1
    np.testing.assert_allclose(np.median(depth / trained_in.depth.ravel()), 1, atol=0.02)
    assert field.march_growth == trainer.settings.step_growth and field.occupancy.bound == 32
    assert field.occupancy.bits.mean() < 0.6
