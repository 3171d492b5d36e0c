"""Tests of `nerg_mi.train.gaze_settings`."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError
from nerg_mi.evaluation import metrics
from nerg_mi.fields.gaze_product import GazeConfig, ProductHead
from nerg_mi.fields.mlp import namespace
from nerg_mi.train.gaze_product import make_gaze_config
from nerg_mi.train.gaze_recipes import DEFAULT_RECIPE, FieldOptions, get_recipe, load_recipes, register_recipe
from nerg_mi.train.gaze_settings import CODE, LOSSES, PAPER, GazeSettings
from nerg_mi.train.gaze_trainer import KLD_EPS, compute_gaze_loss
from nerg_mi.train.trainer import learning_rate_at

from .looks import BOX, NOWHERE

# ---- Losses ----

P, D = 5, 128


@pytest.fixture
def densities():
    rng = np.random.default_rng(0)
    truth, guess = rng.gamma(0.5, size=(P, D)), rng.gamma(0.5, size=(P, D))
    guess[3], truth[4] = 0.2, 0.3  # constants among them
    return truth, guess


def loss(Float, guess, truth, **weights):
    return compute_gaze_loss(Float(guess.ravel()), Float(truth.ravel()), D, **weights)


def test_agrees_with_the_metrics(densities):
    truth, guess = densities
    got = loss(ns.Float64, guess, truth, **PAPER)
    want = {
        "kld": metrics.kld(truth, guess, eps=KLD_EPS).mean(),
        "cc": metrics.cc(truth, guess).mean(),
        "mae": metrics.mae(truth, guess).mean(),
    }
    for name, value in want.items():
        assert np.isclose(getattr(got, name)[0], value, rtol=1e-10)
    assert np.isclose(got.total[0], want["kld"] + 1 - want["cc"] + want["mae"], rtol=1e-10)
    code = loss(ns.Float64, guess, truth, **CODE)
    assert code.kld is None and np.isclose(code.total[0], want["mae"] + 0.1 * (1 - want["cc"]), rtol=1e-10)


@pytest.mark.parametrize("weights", [PAPER, CODE, {"kld": 1, "cc": 0, "mae": 0}, {"kld": 0, "cc": 1, "mae": 0}])
def test_gradient_is_that_of_finite_differences(densities, weights):
    truth, guess = densities
    x = ns.Float64(guess.ravel())
    dr.enable_grad(x)
    dr.backward(compute_gaze_loss(x, ns.Float64(truth.ravel()), D, **weights).total)
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
        got = compute_gaze_loss(x, Float(target.ravel()), D)
        dr.backward(got.total)
        assert all(np.isfinite(v[0]) for v in got) and np.isfinite(np.array(x.grad)).all()
        assert got.cc[0] == 0


@pytest.mark.parametrize("Float", [ns.Float32, ns.Float64])
def test_negative_predictions_count_as_zero_in_the_divergence(densities, Float):
    """A linear activation predicts both signs: the divergence is that of the clamped prediction, and moves only
    positive values.
    """
    truth, guess = densities
    guess = guess - 0.4
    assert (guess < 0).any(axis=1).all() and (guess > 0).any(axis=1)[:3].all()
    x = Float(guess.ravel())
    dr.enable_grad(x)
    got = compute_gaze_loss(x, Float(truth.ravel()), D, kld=1, cc=0, mae=0)
    dr.backward(got.total)
    clamped = np.maximum(guess, 0)
    assert np.isclose(got.kld[0], metrics.kld(truth, clamped, eps=KLD_EPS).mean(), rtol=1e-5)
    slope = np.array(x.grad).reshape(P, D)
    assert np.isfinite(slope).all() and not slope[guess < 0].any() and slope[0][guess[0] > 0].all()


def test_refusals():
    x = ns.Float(np.ones(12))
    with pytest.raises(ValueError, match="do not match"):
        compute_gaze_loss(x, x, 5)
    with pytest.raises(ValueError, match="all weights"):
        compute_gaze_loss(x, x, 4, kld=0, cc=0, mae=0)


# ---- Settings of a gaze training: their limits, and the learning rate over a run ----


def test_the_learning_rate_is_held_and_then_falls_to_its_last():
    s = GazeSettings(steps=10, learning_rate=0.02, lr_final_ratio=0.04, lr_hold_fraction=0.25)
    assert learning_rate_at(s, 0) == learning_rate_at(s, 0.25) == pytest.approx(0.02)
    assert learning_rate_at(s, 0.625) == pytest.approx(0.02 * 0.2) and learning_rate_at(s, 1) == learning_rate_at(
        s, 1.5
    ) == pytest.approx(0.02 * 0.04)


@pytest.mark.parametrize("wrong", [{}, {"steps": 1, "minutes": 1.0}, {"steps": 1, "loss": "mse"}])
def test_settings_that_make_no_sense_are_refused(wrong):
    with pytest.raises(NergError):
        GazeSettings(**wrong)


# ---- Architectures of a size, and the scale that makes weights of zero the uniform density ----


@pytest.mark.parametrize("variant", ["emit", "emit_capture"])
@pytest.mark.parametrize("activation", ["softplus", "exp"])
def test_weights_of_zero_are_the_uniform_density(variant, activation):
    config = make_gaze_config("small", variant, activation)
    field = ProductHead.random(config, BOX, namespace("llvm"), 0)
    field.set_parameters({k: v * 0 for k, v in field.parameters().items()})
    ns = namespace("llvm")
    p, d = ns.Array3f(0.1, 0.2, 1.0), ns.Array3f(0.6, 0, 0.8)
    assert float(field.evaluate(p, p, d)[0][0]) == pytest.approx(1 / (4 * np.pi), rel=1e-5)
    with pytest.raises(ValueError, match="scale"):
        replace(config, emit_scale=0.0)


def test_the_papers_size_is_the_papers():
    assert make_gaze_config("paper").grid == GazeConfig().grid
    with pytest.raises(NergError, match="one of small, paper"):
        make_gaze_config("huge")


# ---- Recipes: what they make of choices and places, and what they take ----

HITS = Environment(None, BOX, "hits")
SCENE = Environment(None, BOX, "scene")


def test_three_recipes_exist():
    assert (
        tuple(load_recipes())[:3] == ("default", "small", "paper") and get_recipe().name == DEFAULT_RECIPE == "default"
    )
    with pytest.raises(NergError, match='one of default, small, paper.*, got "best"'):
        get_recipe("best")
    with pytest.raises(ValueError, match="already"):
        register_recipe(get_recipe())


@pytest.mark.parametrize("name", load_recipes())
def test_recipes_are_complete(name):
    recipe = get_recipe(name)
    plan = recipe.make_plan(SCENE, "emit")
    assert plan.config.variant == "emit" and plan.trainer is recipe.trainer and plan.initial_arrays is None
    assert plan.settings.loss == recipe.losses[0] and set(recipe.losses) <= set(LOSSES)
    assert plan.settings.steps and recipe.summary
    assert recipe.without_rays().settings.patience == 10


def test_default_recipe_has_more_patience_with_views_only():
    plain, alone = get_recipe().settings, get_recipe().without_rays().settings
    assert plain.validation_zones == 0 and alone.validation_zones == 3 and alone.steps > plain.steps
    assert get_recipe().without_rays().override(steps=7).settings.steps == 7
    # Other recipes keep their length.
    assert all("steps" not in get_recipe(name).views_only_settings for name in ("small", "paper"))


def test_log_density_depends_on_the_geometry_kind():
    messages = lambda place: (c := get_recipe().make_plan(place).config) and (c.geometry, c.escaped)
    assert messages(SCENE) == ("surface", "constant") and messages(HITS) == ("surface", "nearest")
    assert messages(NOWHERE) == ("none", "constant")
    with pytest.raises(NergError, match="needs surfaces"):
        get_recipe("small").make_plan(NOWHERE)


def test_without_surfaces_folds_select_the_variant():
    def variants(place, *choices, recipe="default"):
        plan = get_recipe(recipe).make_plan(place, *choices)
        return [c.variant for c in (plan.config, *plan.alternatives)]

    assert [variants(place) for place in (SCENE, HITS)] == [["emit_capture"]] * 2
    assert variants(NOWHERE) == ["capture", "emit_capture"]
    for v in ("emit_capture", "emit", "capture"):
        assert variants(NOWHERE, v) == [v]
    assert variants(SCENE, recipe="small") == ["emit_capture"]


def test_options_reach_the_plan():
    with_options = lambda name: replace(
        get_recipe(name), options=FieldOptions(activation="exp", size="small", normalized=True)
    )
    config = with_options("paper").make_plan(SCENE).config
    assert config.activation == "exp" and config.normalized
    assert config == with_options("small").make_plan(SCENE).config
    assert get_recipe("paper").make_plan(SCENE).config.activation == "linear"
    plan = get_recipe("small").override(seed=4, radius=0.5).make_plan(SCENE)
    assert (plan.settings.seed, plan.settings.steps, plan.probes.radius) == (4, 600, 0.5)


@pytest.mark.parametrize(
    "options, steps, minutes", [({}, 600, None), ({"minutes": 2.0}, None, 2.0), ({"steps": 5}, 5, None)]
)
def test_minutes_and_steps_override_each_other(options, steps, minutes):
    settings = get_recipe("small").override(**options).settings
    assert (settings.steps, settings.minutes) == (steps, minutes)


@pytest.mark.parametrize("name", [DEFAULT_RECIPE, "small", "paper"])
def test_unsupported_options_are_refused(name):
    recipe = get_recipe(name)
    recipe.check()
    changed = replace(
        recipe,
        options=FieldOptions(semantic="snapshot", init_from_field=True),
        settings=replace(recipe.settings, loss="code"),
    )
    if name != DEFAULT_RECIPE:
        changed.check()
        return
    with pytest.raises(NergError, match='semantic, init_from_field, loss; use recipe="small"') as error:
        changed.check()
    assert error.value.parameters == {"recipe": "small"}


def test_the_papers_recipe_is_fifty_epochs_at_a_rate_that_falls_from_the_start():
    """Each probe is drawn fifty times; the rate decreases with every step, down to a tenth."""
    recipe = get_recipe("paper")
    settings = recipe.settings
    assert settings.steps is not None and settings.steps * settings.probes == 50 * recipe.probes.probes
    assert learning_rate_at(settings, 0) == pytest.approx(1e-3) and learning_rate_at(settings, 0.01) < 1e-3
    assert learning_rate_at(settings, 0.5) == pytest.approx(1e-3 * 0.1**0.5) and learning_rate_at(
        settings, 1
    ) == pytest.approx(1e-4)
