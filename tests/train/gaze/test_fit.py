"""Fits: what is kept of them, when they end, how long the second one is."""

from __future__ import annotations

import json
from dataclasses import replace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.train.gaze_data import targets_of_rays
from nerg_mi.train.gaze_settings import GazeSettings
from nerg_mi.train.gaze_trainer import Fit, GazeRunFile, GazeTrainer, Scores, fit_again, fit_watched, rounded

from .looks import BOX, NOWHERE, PROBES, PRODUCT, SMALL, looking_at, planned, train

NO_FILE = GazeRunFile(None, {})


@pytest.fixture(scope="module")
def targets():
    return targets_of_rays(looking_at((1.5, 0.4, 1.2)), NOWHERE, PROBES)


def test_what_was_found_is_kept_as_json():
    fit = Fit(None, {}, 4, 9, Scores(1.0, 2.0, 0.5, 0.1, 1.0), [{"steps": 4, "kld": 2.0}], False, 2, 3)
    assert Fit.of(json.loads(json.dumps(fit.found()))) == fit
    assert Fit.of(Fit(None).found()).scores is None
    assert rounded(Scores(1 / 3, 2, 0.5, 0.1, 1)) == {"loss": 0.33333, "kld": 2, "cc": 0.5, "mae": 0.1, "integral": 1}


@pytest.mark.parametrize("patience, looks", [(3, 4), (1, 2), (0, 10)])
def test_a_fit_ends_when_looking_has_been_in_vain_for_long_enough(wall, patience, looks):
    """Nothing is learnt at a rate of next to nothing: the first look is the best, and ``patience`` more are taken."""
    settings = GazeSettings(
        steps=20,
        looks=10,
        patience=patience,
        zones=2,
        watched=6,
        probes=4,
        directions=32,
        learning_rate=1e-30,
        refit=False,
    )
    _, about = train(wall, settings, SMALL)
    v = about["validation"]
    assert [h["steps"] for h in v["history"]] == [2 * k for k in range(1, looks + 1)]
    assert v["best_step"] == 2 and about["steps"] == 2 * looks


def test_a_fit_that_nobody_watches_ends_with_its_schedule(targets):
    told = []
    fit = fit_watched(targets, None, BOX, planned(SMALL, replace(PRODUCT, zones=0)), ns, 1.0, NO_FILE, told.append)
    assert (fit.best_step, fit.schedule, fit.scores, fit.history, fit.interrupted) == (16, 16, None, [], False)
    assert [p.steps for p in told] == list(range(1, 17)) and told[-1].done == 1 and {p.stage for p in told} == {"fit"}


def test_the_second_fit_has_as_many_steps_as_were_best_along_the_same_schedule(targets):
    plan, told = planned(SMALL, PRODUCT), []
    first = fit_watched(targets, targets, BOX, plan, ns, 1.0, NO_FILE, lambda progress: None)
    first.best_step = 5
    second = fit_again(targets, first, BOX, plan, ns, NO_FILE, told.append)
    assert second.trainer.steps == second.best_step == 5 and second.scores is first.scores
    assert second.trainer.progress == pytest.approx(5 / 16) and [p.done for p in told] == [0.2, 0.4, 0.6, 0.8, 1.0]
    # The same seed and targets: the first five steps of the first fit.
    plain = planned(SMALL, replace(PRODUCT, steps=16))
    trainer = plain.trainer(targets, BOX, SMALL, plain.settings, ns)
    for _ in range(5):
        trainer.step()
    for name, value in trainer.weights().items():
        np.testing.assert_allclose(second.weights[name].numpy(), value.numpy(), atol=1e-6, err_msg=name)


def test_an_interrupted_fit_ends_after_its_step(targets):
    def stop(progress):
        if progress.steps == 3:
            raise KeyboardInterrupt

    fit = fit_watched(targets, None, BOX, planned(SMALL, replace(PRODUCT, zones=0)), ns, 1.0, NO_FILE, stop)
    assert fit.interrupted and fit.trainer.steps == fit.best_step == 3 and fit.weights


@pytest.mark.parametrize("stopped", [2, 99])
def test_a_schedule_of_minutes_is_told_in_steps(targets, monkeypatch, stopped):
    """Half a minute of steps of six seconds: five, also where the fit ends before."""
    monkeypatch.setattr(GazeTrainer, "seconds", property(lambda trainer: 6.0 * trainer.steps))

    def stop(progress):
        if progress.steps == stopped:
            raise KeyboardInterrupt

    plan = planned(SMALL, replace(PRODUCT, steps=None, minutes=1.0, zones=0))
    fit = fit_watched(targets, None, BOX, plan, ns, 0.5, NO_FILE, stop)
    assert fit.schedule == 5 and fit.best_step == min(stopped, 5)


def test_minutes_are_those_of_both_fits(wall, monkeypatch):
    """The first fit has half of them; the second follows its schedule, in steps."""
    # A clock that goes on by six seconds a step.
    monkeypatch.setattr(GazeTrainer, "seconds", property(lambda trainer: 6.0 * trainer.steps))
    settings = replace(PRODUCT, steps=None, minutes=1.0, looks=5)
    _, about = train(wall, settings, SMALL)
    v = about["validation"]
    assert [h["steps"] for h in v["history"]] == [1, 2, 3, 4, 5] and about["refitted"]
    assert about["steps"] == v["best_step"] <= 5
