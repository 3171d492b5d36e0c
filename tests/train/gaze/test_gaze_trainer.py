"""Tests of `nerg_mi.train.gaze_trainer`."""

from __future__ import annotations

import json
from dataclasses import replace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.kde import SphericalKde
from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.tracking.probes import place_probes
from nerg_mi.tracking.rays import Rays
from nerg_mi.train.gaze_data import Supervision, make_targets_from_probes, make_targets_from_rays
from nerg_mi.train.gaze_product import ProductTrainer
from nerg_mi.train.gaze_run import GazeRunFile, fit_with_validation, make_targets, refit
from nerg_mi.train.gaze_settings import GazeSettings
from nerg_mi.train.gaze_trainer import GazeTrainer, Scores
from nerg_mi.train.prior import compute_elevation_density, make_elevation_prior
from nerg_mi.train.trainer import check_same_run
from tests.kernels import list_kernels_each
from tests.refusals import mentions

from .looks import (
    BOX,
    LIKELIHOOD,
    LOG,
    NOWHERE,
    PROBES,
    PRODUCT,
    RAYS,
    SMALL,
    around,
    looking_at,
    planned,
    stopping,
    train,
)

# ---- Fits: selected weights, early stopping, and the length of the refit ----

NO_FILE = GazeRunFile(None, {})


@pytest.fixture(scope="module")
def targets_fit():
    return make_targets_from_rays(looking_at((1.5, 0.4, 1.2)), NOWHERE, PROBES)


@pytest.mark.parametrize("patience, looks", [(3, 4), (1, 2), (0, 10)])
def test_early_stopping(wall, patience, looks):
    """With a rate of almost zero nothing is learned: the first validation is the best, and ``patience`` more follow."""
    settings = GazeSettings(
        steps=20,
        num_validations=10,
        patience=patience,
        validation_zones=2,
        validation_probes=6,
        probes=4,
        directions=32,
        learning_rate=1e-30,
        refit=False,
    )
    _, provenance = train(wall, settings, SMALL)
    v = provenance["validation"]
    assert [h["steps"] for h in v["history"]] == [2 * k for k in range(1, looks + 1)]
    assert v["best_step"] == 2 and provenance["steps"] == 2 * looks


@pytest.mark.parametrize("settings, config", [(PRODUCT, SMALL), (LIKELIHOOD, LOG)], ids=["product", "likelihood"])
@pytest.mark.parametrize("losses", [(3, 1, 2, 1.5), (1, 2, 3, 4), (4, 3, 2, 1), (2, np.nan, 1, 3), (np.nan, 5, 4, 6)])
def test_the_state_of_the_smallest_loss_is_the_result(targets_fit, monkeypatch, settings, config, losses):
    """Not the last one; its weights, step and scores."""
    plan, states = planned(config, replace(settings, num_validations=4)), []

    def evaluate(trainer, targets, weights=None):
        states.append((trainer.steps, {k: np.array(v) for k, v in trainer.averaged.items()}))
        return Scores(losses[len(states) - 1], *range(4))

    monkeypatch.setattr(plan.trainer, "evaluate", evaluate)
    fit = fit_with_validation(targets_fit, targets_fit, BOX, plan, ns, 1.0, NO_FILE, lambda progress: None)
    best = int(np.nanargmin(losses))
    assert [row["steps"] for row in fit.history] == [4, 8, 12, 16] and fit.best_step == states[best][0]
    assert fit.scores is not None and fit.scores.loss == losses[best]
    for name, value in fit.weights.items():
        np.testing.assert_array_equal(value.numpy(), states[best][1][name], err_msg=name)
    assert any(np.any(states[0][1][name] != states[3][1][name]) for name in fit.weights)


def test_a_fit_without_validation_ends_with_its_schedule(targets_fit):
    messages = []
    fit = fit_with_validation(
        targets_fit, None, BOX, planned(SMALL, replace(PRODUCT, validation_zones=0)), ns, 1.0, NO_FILE, messages.append
    )
    assert (fit.best_step, fit.schedule, fit.scores, fit.history, fit.interrupted) == (16, 16, None, [], False)
    assert (
        [p.steps for p in messages] == list(range(1, 17))
        and messages[-1].fraction == 1
        and {p.stage for p in messages} == {"fit"}
    )


def test_refit_uses_the_best_number_of_steps(targets_fit):
    plan, messages = planned(SMALL, PRODUCT), []
    first = fit_with_validation(targets_fit, targets_fit, BOX, plan, ns, 1.0, NO_FILE, lambda progress: None)
    first.best_step = 5
    second = refit(targets_fit, first, BOX, plan, ns, NO_FILE, messages.append)
    assert second.trainer.steps == second.best_step == 5 and second.scores is first.scores
    assert second.trainer.progress == pytest.approx(5 / 16) and [p.fraction for p in messages] == [
        0.2,
        0.4,
        0.6,
        0.8,
        1.0,
    ]
    # The same seed and targets as the first five steps of the first fit.
    plain = planned(SMALL, replace(PRODUCT, steps=16))
    trainer = plain.trainer(targets_fit, BOX, SMALL, plain.settings, ns)
    for _ in range(5):
        trainer.step()
    for name, value in trainer.copy_weights().items():
        np.testing.assert_allclose(second.weights[name].numpy(), value.numpy(), atol=1e-6, err_msg=name)


@pytest.mark.parametrize("stopped", [2, 99])
def test_a_schedule_in_minutes_is_converted_to_steps(targets_fit, monkeypatch, stopped):
    """Half a minute with steps of six seconds: five steps, even if the fit ends earlier."""
    monkeypatch.setattr(GazeTrainer, "seconds", property(lambda trainer: 6.0 * trainer.steps))

    def stop(progress):
        if progress.steps == stopped:
            raise KeyboardInterrupt

    plan = planned(SMALL, replace(PRODUCT, steps=None, minutes=1.0, validation_zones=0))
    fit = fit_with_validation(targets_fit, None, BOX, plan, ns, 0.5, NO_FILE, stop)
    assert fit.schedule == 5 and fit.best_step == min(stopped, 5)


# ---- Plans: settings that must match to resume a run ----

MOVED = replace(NOWHERE, align=Similarity(np.diag([2.0, 2, 2, 1])))


@pytest.mark.parametrize(
    "name, plan, supervision, place",
    [
        ("settings", planned(SMALL, replace(PRODUCT, seed=1)), None, NOWHERE),
        ("probes", planned(SMALL, PRODUCT, replace(PROBES, kappa=9.0)), None, NOWHERE),
        ("architecture", planned(replace(SMALL, variant="emit"), PRODUCT), None, NOWHERE),
        ("rays", None, Supervision(RAYS.select(np.arange(100))), NOWHERE),
        ("views", None, Supervision(RAYS, around(2)), NOWHERE),
        ("box", None, None, replace(NOWHERE, box=Box((0, 0, 0), (1, 1, 1)))),
        ("align", None, None, MOVED),
    ],
)
def test_run_identities_differ(name, plan, supervision, place):
    base = planned(SMALL, PRODUCT).make_identity(Supervision(RAYS), NOWHERE)
    other = (plan or planned(SMALL, PRODUCT)).make_identity(supervision or Supervision(RAYS), place)
    assert {k for k in other if other[k] != base.get(k)} == {name}


# ---- An interrupted and resumed gaze training equals an uninterrupted one ----


@pytest.mark.parametrize(
    "settings, config, probes, count",
    [
        (PRODUCT, SMALL, PROBES, 1),
        (LIKELIHOOD, LOG, replace(PROBES, resample_directions=True), 1),
        (LIKELIHOOD, LOG, PROBES, 2),
    ],
    ids=["product", "fresh", "two threads"],
)
def test_a_resumed_run_equals_an_uninterrupted_one(wall, settings, config, probes, count, threads, tmp_path):
    """Bit for bit with one thread, to 1e-5 with two; interrupted in both fits, after validations and epochs."""
    threads(count)
    expected, full = train(wall, settings, config, probes)
    path = tmp_path / "a.run"
    _, provenance = train(wall, settings, config, probes, path=path, on_progress=stopping("fit", 5))
    assert provenance["interrupted"] and provenance["steps"] <= 5 and path.is_file()
    assert full["validation"]["best_step"] > 3
    watch = stopping("refit", 3)
    _, provenance = train(wall, settings, config, probes, path=path, resume=True, on_progress=watch)
    assert provenance["interrupted"] and path.is_file() and ("fit", 5) not in watch.seen and ("fit", 6) in watch.seen
    watch = stopping("", 0)
    is_valid = []
    got, provenance = train(
        wall,
        settings,
        config,
        probes,
        path=path,
        resume=True,
        on_progress=watch,
        write=lambda *_: is_valid.append(path.is_file()),
    )
    assert not provenance["interrupted"] and is_valid == [True] and not path.exists()
    assert {s for s, _ in watch.seen} == {"probes", "refit"}
    assert ("refit", 3) not in watch.seen and ("refit", 4) in watch.seen
    for name, value in expected.parameters().items():
        compare = (
            np.testing.assert_array_equal
            if count == 1
            else lambda a, b, err_msg: np.testing.assert_allclose(a, b, atol=1e-5, err_msg=err_msg)
        )
        compare(np.array(got.parameters()[name]), np.array(value), err_msg=name)
    if count == 1:
        assert provenance["validation"] == full["validation"] and provenance["steps"] == full["steps"]


def test_another_run_is_not_resumed(wall, tmp_path):
    path = tmp_path / "a.run"
    train(wall, PRODUCT, SMALL, path=path, on_progress=stopping("fit", 1))
    with pytest.raises(NergError, match=r"different settings\.seed;"):
        train(wall, replace(PRODUCT, seed=3), SMALL, path=path, resume=True)
    with pytest.raises(NergError, match=r"different place, probes\.kappa;"):
        train(wall, PRODUCT, SMALL, replace(PROBES, kappa=9.0), path=path, resume=True, identity={"place": "elsewhere"})
    with pytest.raises(NergError, match="cannot resume"):
        train(wall, PRODUCT, SMALL, path=tmp_path / "b.run", resume=True)


def test_a_run_with_old_names_of_settings_is_the_same_run():
    """The identity as versions wrote it whose settings had other names than the options."""
    now = json.loads(json.dumps(planned(SMALL, PRODUCT).make_identity(Supervision(RAYS), NOWHERE)))
    old_names = {
        "settings": {
            "validation_zones": "zones",
            "integral_weight": "integral",
            "prior_folds": "mix_folds",
            "freeze": "frozen",
            "ema_decay": "average",
        },
        "probes": {
            "probes": "count",
            "max_rays": "cap",
            "resample_directions": "fresh",
            "ray_weights": "weights",
            "prior_kappa": "mix_kappa",
        },
    }
    then = {**now}
    for part, names in old_names.items():
        assert names.keys() <= now[part].keys()
        then[part] = {names.get(name, name): value for name, value in now[part].items()}
    check_same_run("a.run", then, now)
    then["probes"] |= {"cap": 1 + then["probes"]["cap"]}
    with pytest.raises(NergError, match=r"different probes\.max_rays;"):
        check_same_run("a.run", then, now)


def test_the_state_is_saved_at_intervals_and_on_request(monkeypatch, tmp_path):
    from nerg_mi.train import gaze_run as gaze_state

    clock, selected = [100.0], []
    monkeypatch.setattr(gaze_state.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(
        gaze_state, "write_checkpoint", lambda path, kind, tensors, meta: selected.append((clock[0], meta["spent"]))
    )
    file = gaze_state.GazeRunFile(tmp_path / "a.run", {}, 10.0, False)
    for clock[0] in (105.0, 109.0, 111.0, 112.0, 120.0, 122.5):
        file.save("fit", None, {}, {}, force=clock[0] == 112.0)  # noqa: RUF069 (stored)
    assert selected == [(111.0, 11.0), (112.0, 12.0), (122.5, 22.5)]
    gaze_state.GazeRunFile(None, {}, 10.0, False).save("fit", None, {}, {}, force=True)


def test_the_first_fit_is_saved_before_the_refit(wall, monkeypatch, tmp_path):
    """Probes and depths of all rays take long: a run interrupted there does not repeat the first fit."""
    from nerg_mi.train import gaze_run

    make_targets, calls = gaze_run.make_targets, []

    def killed(supervision, *rest):
        calls.append(len(supervision.rays))
        if len(calls) == 3:
            raise MemoryError("killed")
        return make_targets(supervision, *rest)

    path, how = tmp_path / "a.run", {"path": tmp_path / "a.run", "interval": 1e9}
    monkeypatch.setattr(gaze_run, "make_targets", killed)
    with pytest.raises(MemoryError):
        train(wall, PRODUCT, SMALL, **how)
    # For validation, for training without the validation data, and for all rays.
    assert calls[0] == calls[2] > calls[1] and path.is_file()
    watch = stopping("", 0)
    _, provenance = train(wall, PRODUCT, SMALL, resume=True, on_progress=watch, **how)
    assert {stage for stage, _ in watch.seen} == {"probes", "refit"} and provenance["refitted"]


@pytest.mark.parametrize("refit", [True, False])
def test_a_result_that_cannot_be_written_is_saved(wall, refit, threads, tmp_path):
    """A full disk at the end, once: nothing is trained again."""
    threads(1)
    path, written = tmp_path / "a.run", []

    def refuse(field, provenance):
        raise NergError("the disk is full.")

    settings = replace(PRODUCT, refit=refit)
    how = {"path": path, "interval": 1e9}
    with pytest.raises(NergError, check=mentions("resume")):
        train(wall, settings, SMALL, write=refuse, **how)
    assert path.is_file()
    watch = stopping("", 0)
    field, _ = train(
        wall, settings, SMALL, resume=True, on_progress=watch, write=lambda *options: written.append(options), **how
    )
    assert {s for s, _ in watch.seen} == {"probes"} and written[0][0] is field and not path.exists()
    expected = train(wall, settings, SMALL)[0].parameters()
    for name, value in field.parameters().items():
        np.testing.assert_array_equal(np.array(value), np.array(expected[name]), err_msg=name)


@pytest.mark.parametrize("zones", [0, 2])
def test_a_failed_write_of_an_interrupted_run_changes_nothing(wall, zones, threads, tmp_path):
    """The state is that of the step, and not the result, whose weights would otherwise count as the best ones."""
    threads(1)
    settings = replace(PRODUCT, validation_zones=zones, num_validations=2)

    def refuse(field, provenance):
        raise NergError("the disk is full.")

    path = tmp_path / "a.run"
    with pytest.raises(NergError, check=mentions("resume")):
        train(wall, settings, SMALL, path=path, interval=1e9, on_progress=stopping("fit", 5), write=refuse)
    field, provenance = train(wall, settings, SMALL, path=path, resume=True)
    expected, full = train(wall, settings, SMALL)
    assert provenance.get("validation") == full.get("validation") and provenance["steps"] == full["steps"]
    for name, value in field.parameters().items():
        np.testing.assert_array_equal(np.array(value), np.array(expected.parameters()[name]), err_msg=name)


# ---- Averaged weights ----


@pytest.fixture
def targets_trainer(rays, wall):
    """Targets of one probe in 64 directions."""
    probes = place_probes(rays, 0.5, queries=[[-0.6, 0, 1.6]], min_rays=8, kappa_rule="fixed", kappa=20.0)
    return make_targets_from_probes(probes, wall, 64)


@pytest.mark.parametrize("average", [0.0, 0.3, 0.999])
def test_the_result_is_the_average_of_the_weights(targets_trainer, average):
    """Exponential average with a short memory at first: (k + 1) / (k + 10) after k steps, at most ``average``."""
    settings = GazeSettings(steps=5, learning_rate=1e-2, validation_zones=0, ema_decay=average)
    trainer = ProductTrainer(targets_trainer, BOX, SMALL, settings, ns)
    expected = {k: v.numpy().astype(float) for k, v in trainer.optimiser.items()}
    for k in range(1, 6):
        trainer.step()
        memory = min(average, (k + 1) / (k + 10))
        for name, value in trainer.optimiser.items():
            expected[name] = memory * expected[name] + (1 - memory) * value.numpy()
    for name, value in trainer.copy_weights().items():
        np.testing.assert_allclose(value.numpy(), expected[name], atol=1e-6)
    assert average == 0 or np.abs(expected["emit_head.0"] - trainer.optimiser["emit_head.0"].numpy()).max() > 1e-4


def test_further_steps_need_no_new_kernels(targets_trainer):
    """With indices of some kilobytes, which NumPy places at any multiple of 16 bytes."""
    settings = GazeSettings(steps=60, learning_rate=1e-2, validation_zones=0)
    trainer = ProductTrainer(targets_trainer, BOX, SMALL, settings, ns)
    kernels = list_kernels_each(lambda _: trainer.step(), 60)
    assert set.union(*kernels[4:]) <= set.union(*kernels[:4])


# ---- The elevation prior for a scene without tracking, from other scenes ----


def looking(directions, person=None) -> Rays:
    d = np.asarray(directions, float)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    person = np.zeros(len(d), int) if person is None else np.asarray(person)
    names = tuple(f"p{k}" for k in range(person.max() + 1))
    return Rays(np.arange(len(d)), person, names, np.zeros((len(d), 3)), d, np.ones(len(d)))


def test_it_is_the_kernel_density_of_rays_that_are_turned_to_every_azimuth():
    rng = np.random.default_rng(0)
    rays = looking(rng.normal(size=(5, 3)))
    azimuth = np.arange(720) * np.pi / 360
    up = np.repeat(rays.direction[:, 2], len(azimuth))
    flat = np.sqrt(1 - up**2)
    turned = np.stack([flat * np.tile(np.cos(azimuth), 5), flat * np.tile(np.sin(azimuth), 5), up], axis=1)
    for kappa in (5.0, 30.0):
        sine = np.linspace(-1, 1, 41)
        at = np.stack([np.sqrt(1 - sine**2), 0 * sine, sine], axis=1)
        expected = SphericalKde(turned, np.array([0, len(turned)]), kappa, backend="llvm").evaluate(at)[0]
        # Bins of the sine are two degrees wide at the poles.
        assert compute_elevation_density([rays], sine, kappa) == pytest.approx(expected, rel=2e-2, abs=2e-4)


def test_environments_and_participants_have_equal_weight():
    """One environment has nine upward rays of one participant and one downward ray of another; the other has one upward
    ray.
    """
    first = looking(9 * [[0, 0, 1.0]] + [[0, 0, -1.0]], 9 * [0] + [1])
    down, up = compute_elevation_density([first, looking([[0, 0, 1.0]])], np.array([-1.0, 1.0]))
    assert up / down == pytest.approx(3, rel=1e-2)


def test_elevation_prior_does_not_depend_on_position():
    ns, d = namespace("llvm"), fibonacci_directions(20_000)
    rays = looking(np.random.default_rng(1).normal(size=(50, 3)) * [1, 1, 0.3] - [0, 0, 0.2])
    field = make_elevation_prior([rays], ns)
    sine = np.linspace(-1, 1, 201)
    expected = np.interp(d[:, 2], sine, compute_elevation_density([rays], sine))
    r = ns.Array3f(np.ascontiguousarray(d.T, np.float32))
    for place in ((0.0, 0.0, 0.0), (40.0, -7.0, 1.6)):
        gaze, _, _ = field.evaluate(r * 3 + ns.Array3f(*place), ns.Array3f(*place), r, integral=ns.Float(1.0))
        result = np.array(gaze)
        assert 4 * np.pi * result.mean() == pytest.approx(1, abs=1e-3)
        # A thousandth is uniform, and the table has rows of 2.8 degrees.
        assert np.abs(result - expected).max() < 0.01
    assert not field.config.needs_surfaces


# ---- Whole runs: resampled directions, the position-independent prior ----


def test_directions_are_fresh_in_every_epoch(wall, monkeypatch):
    """16 probes, 4 per step: an epoch has four steps. Otherwise there is one set of directions."""
    from nerg_mi.train import gaze_data

    drawn, sets = [], gaze_data.make_rotated_directions
    monkeypatch.setattr(
        gaze_data, "make_rotated_directions", lambda *options: drawn.append(sets(*options)) or drawn[-1]
    )
    settings = replace(PRODUCT, validation_zones=0, steps=9)
    train(wall, settings, SMALL, replace(PROBES, resample_directions=True))
    assert len(drawn) == 3 and np.abs(drawn[0] - drawn[1]).max() > 0.1 and np.abs(drawn[1] - drawn[2]).max() > 0.1
    drawn.clear()
    train(wall, settings, SMALL)
    assert len(drawn) == 1


def test_prior_of_rays_and_views_is_that_of_the_rays():
    plan, views = planned(LOG, LIKELIHOOD), around(4)
    rays = make_targets(Supervision(RAYS), NOWHERE, plan, 3)
    both = make_targets(Supervision(RAYS, views), NOWHERE, plan, 3)
    alone = make_targets(Supervision(None, views), NOWHERE, plan, 3)
    np.testing.assert_array_equal(both.prior_table, rays.prior_table)
    assert np.abs(alone.prior_table - rays.prior_table).max() > 0.1 and len(both.truth) == len(rays.truth) + 4
