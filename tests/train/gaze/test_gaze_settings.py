"""Tests of `nerg_mi.train.gaze_settings`."""

from __future__ import annotations

import json
from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.evaluation import metrics
from nerg_mi.fields.gaze_product import GazeConfig, GazeField
from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.sphere import latlong_grid
from nerg_mi.train.gaze_product import sized_gaze_config
from nerg_mi.train.gaze_settings import CODE, KLD_EPS, PAPER, GazeSettings, ProbeSettings, gaze_loss

from .looks import BOX

# ---- Losses ----


P, D = 5, 128


W = latlong_grid(16, 8)[1]


@pytest.fixture
def densities():
    rng = np.random.default_rng(0)
    truth, guess = rng.gamma(0.5, size=(P, D)), rng.gamma(0.5, size=(P, D))
    guess[3], truth[4] = 0.2, 0.3  # constants among them
    return truth, guess


def loss(Float, guess, truth, w=W, **weights):
    return gaze_loss(Float(guess.ravel()), Float(truth.ravel()), D, None if w is None else Float(w), **weights)


@pytest.mark.parametrize("w", [W, np.tile(W, P), None], ids=["shared", "own", "equal"])
def test_agrees_with_the_metrics(densities, w):
    truth, guess = densities
    got = loss(ns.Float64, guess, truth, w, **PAPER)
    shared = None if w is None else W
    want = {
        "kld": metrics.kld(truth, guess, shared, eps=KLD_EPS).mean(),
        "cc": metrics.cc(truth, guess, shared).mean(),
        "mae": metrics.mae(truth, guess, shared).mean(),
    }
    for name, value in want.items():
        assert np.isclose(getattr(got, name)[0], value, rtol=1e-10)
    assert np.isclose(got.total[0], want["kld"] + 1 - want["cc"] + want["mae"], rtol=1e-10)
    code = loss(ns.Float64, guess, truth, w, **CODE)
    assert code.kld is None and np.isclose(code.total[0], want["mae"] + 0.1 * (1 - want["cc"]), rtol=1e-10)


@pytest.mark.parametrize("weights", [PAPER, CODE, {"kld": 1, "cc": 0, "mae": 0}, {"kld": 0, "cc": 1, "mae": 0}])
def test_gradient_is_that_of_finite_differences(densities, weights):
    truth, guess = densities
    x = ns.Float64(guess.ravel())
    dr.enable_grad(x)
    dr.backward(gaze_loss(x, ns.Float64(truth.ravel()), D, ns.Float64(W), **weights).total)
    slope = np.array(x.grad).reshape(P, D)
    h = 1e-5
    for p, d in [(0, 3), (1, 50), (2, 127), (4, 9)]:
        up, down = guess.copy(), guess.copy()
        up[p, d] += h
        down[p, d] -= h
        want = (loss(ns.Float64, up, truth, **weights).total[0] - loss(ns.Float64, down, truth, **weights).total[0]) / (
            2 * h
        )
        assert np.isclose(slope[p, d], want, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("value", [0.0, 0.1, -1.0, 1e-30, 1e30])
@pytest.mark.parametrize("Float", [ns.Float32, ns.Float64])
def test_constants_give_numbers(densities, value, Float):
    truth, _ = densities
    for target in (truth, np.zeros_like(truth)):
        x = Float(np.full(P * D, value))
        dr.enable_grad(x)
        got = gaze_loss(x, Float(target.ravel()), D, Float(W))
        dr.backward(got.total)
        assert all(np.isfinite(v[0]) for v in got) and np.isfinite(np.array(x.grad)).all()
        assert got.cc[0] == 0


@pytest.mark.parametrize("Float", [ns.Float32, ns.Float64])
def test_negative_predictions_count_as_zero_in_the_divergence(densities, Float):
    """A linear activation predicts both signs: the divergence is that of the clamped prediction, and moves only what is
    positive."""
    truth, guess = densities
    guess = guess - 0.4
    assert (guess < 0).any(axis=1).all() and (guess > 0).any(axis=1)[:3].all()
    x = Float(guess.ravel())
    dr.enable_grad(x)
    got = gaze_loss(x, Float(truth.ravel()), D, Float(W), kld=1, cc=0, mae=0)
    dr.backward(got.total)
    clamped = np.maximum(guess, 0)
    assert np.isclose(got.kld[0], metrics.kld(truth, clamped, W, eps=KLD_EPS).mean(), rtol=1e-5)
    slope = np.array(x.grad).reshape(P, D)
    assert np.isfinite(slope).all() and not slope[guess < 0].any() and slope[0][guess[0] > 0].all()


def test_float32_is_good_enough(densities):
    truth, guess = densities
    assert np.isclose(loss(ns.Float32, guess, truth).total[0], loss(ns.Float64, guess, truth).total[0], rtol=1e-5)


def test_no_gradient_to_the_truth(densities):
    truth, guess = densities
    t = ns.Float64(truth.ravel())
    dr.enable_grad(t)
    assert not dr.grad_enabled(gaze_loss(ns.Float64(guess.ravel()), t, D).total)


def test_descent_finds_the_truth(densities):
    truth, _ = densities
    goal, x = ns.Float(truth.ravel()), ns.Float(np.full(P * D, 0.2))
    from drjit.opt import Adam

    opt = Adam(lr=0.05, params={"x": dr.log(x)})
    for _ in range(300):
        now = gaze_loss(dr.exp(opt["x"]), goal, D, ns.Float(W))
        dr.backward(now.total)
        opt.step()
    assert now.cc[0] > 0.79 and now.kld[0] < 0.02  # four of five truths have a shape to find


def test_refusals():
    x = ns.Float(np.ones(12))
    with pytest.raises(ValueError, match="do not fit"):
        gaze_loss(x, x, 5)
    with pytest.raises(ValueError, match="solid angles"):
        gaze_loss(x, x, 4, ns.Float(1, 2))
    with pytest.raises(ValueError, match="every weight"):
        gaze_loss(x, x, 4, kld=0, cc=0, mae=0)


# ---- Settings of a gaze training: their limits, and the learning rate over a run ----


def test_the_learning_rate_is_held_and_then_falls_to_its_last():
    s = GazeSettings(steps=10, learning_rate=0.02, final_rate=0.04, hold=0.25)
    assert s.rate(0) == s.rate(0.25) == 0.02
    assert s.rate(0.625) == pytest.approx(0.02 * 0.2) and s.rate(1) == s.rate(1.5) == pytest.approx(0.02 * 0.04)


@pytest.mark.parametrize("wrong", [{}, {"steps": 1, "minutes": 1.0}, {"steps": 1, "loss": "mse"}])
def test_settings_that_make_no_sense_are_refused(wrong):
    with pytest.raises(NergError):
        GazeSettings(**wrong)


def test_settings_are_kept_as_json():
    for settings in (GazeSettings(steps=3, loss="code"), ProbeSettings(radius=0.3, spacing=0.1)):
        assert type(settings)(**json.loads(json.dumps(settings.to_dict()))) == settings


# ---- Architectures of a size, and the scale that makes weights of zero the uniform density ----


@pytest.mark.parametrize("variant", ["emit", "emit_capture"])
@pytest.mark.parametrize("activation", ["softplus", "exp"])
def test_weights_of_zero_are_the_uniform_density(variant, activation):
    config = sized_gaze_config("small", variant, activation)
    field = GazeField.random(config, BOX, namespace("llvm"), 0)
    field.set_parameters({k: v * 0 for k, v in field.parameters().items()})
    ns = namespace("llvm")
    p, d = ns.Array3f(0.1, 0.2, 1.0), ns.Array3f(0.6, 0, 0.8)
    assert float(field.evaluate(p, p, d)[0][0]) == pytest.approx(1 / (4 * np.pi), rel=1e-5)
    with pytest.raises(ValueError, match="scale"):
        replace(config, emit_scale=0.0)


def test_a_larger_field_has_more_of_everything():
    small, paper = sized_gaze_config("small"), sized_gaze_config("paper")
    assert (
        small.grid.size < paper.grid.size
        and small.grid.levels < paper.grid.levels
        and small.grid.log2_rows < paper.grid.log2_rows
    )


def test_the_papers_size_is_the_papers():
    assert sized_gaze_config("paper").grid == GazeConfig().grid
    with pytest.raises(NergError, match="one of small, paper"):
        sized_gaze_config("huge")
