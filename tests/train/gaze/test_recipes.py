"""Recipes: what they make of choices and places, what they take, and that one more is one entry."""

from __future__ import annotations

from dataclasses import replace

import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_log_density import LogGazeConfig
from nerg_mi.train.gaze_log_density import LikelihoodTrainer
from nerg_mi.train.gaze_product import ProductTrainer
from nerg_mi.train.gaze_recipes import DEFAULT, RECIPES, FieldChoices, Recipe, gaze_recipe, recipes, register
from nerg_mi.train.gaze_settings import LOSSES, GazeSettings
from nerg_mi.train.geometry import GazePlace

from .looks import BOX, NOWHERE

HITS = GazePlace(None, BOX, "hits")
SCENE = GazePlace(None, BOX, "scene")


def test_there_are_three():
    assert tuple(recipes())[:3] == ("default", "small", "paper") and gaze_recipe().name == DEFAULT == "default"
    with pytest.raises(NergError, match='one of default, small, paper.*, got "best"'):
        gaze_recipe("best")
    with pytest.raises(ValueError, match="already"):
        register(gaze_recipe())


@pytest.mark.parametrize("name", recipes())
def test_each_is_whole(name):
    recipe = gaze_recipe(name)
    plan = recipe.plan(SCENE, FieldChoices(variant="emit"))
    assert plan.config.variant == "emit" and plan.trainer is recipe.trainer and plan.initial is None
    assert plan.settings.loss == recipe.losses[0] and set(recipe.losses) <= set(LOSSES)
    assert plan.settings.steps and recipe.summary
    assert recipe.plan(SCENE, views_alone=True).settings.patience == 10


def test_the_default_one_looks_longer_where_there_are_views_alone():
    plain, alone = (gaze_recipe().plan(SCENE, views_alone=alone).settings for alone in (False, True))
    assert plain.zones == 0 and alone.zones == 3 and alone.steps > plain.steps
    # The others' lengths stay their own.
    assert all("steps" not in gaze_recipe(name).views_alone for name in ("small", "paper"))


def test_a_log_density_is_told_of_its_place():
    told = lambda place: (c := gaze_recipe().plan(place).config) and (c.geometry, c.escaped)
    assert told(SCENE) == ("surface", "constant") and told(HITS) == ("surface", "nearest")
    assert told(NOWHERE) == ("none", "constant")
    with pytest.raises(NergError, match="needs surfaces"):
        gaze_recipe("small").plan(NOWHERE)


def test_without_surfaces_folds_choose_between_capture_and_both_unless_told_otherwise():
    def variants(place, *choices, recipe="default"):
        plan = gaze_recipe(recipe).plan(place, *choices)
        return [c.variant for c in (plan.config, *plan.alternatives)]

    assert [variants(place) for place in (SCENE, HITS)] == [["emit_capture"]] * 2
    assert variants(NOWHERE) == ["capture", "emit_capture"]
    for v in ("emit_capture", "emit", "capture"):
        assert variants(NOWHERE, FieldChoices(variant=v)) == [v]
    assert variants(SCENE, recipe="small") == ["emit_capture"]


def test_what_is_chosen_arrives():
    choices = FieldChoices(activation="exp", size="small", normalized=True)
    config = gaze_recipe("paper").plan(SCENE, choices).config
    assert (
        config.activation == "exp" and config.normalized and config == gaze_recipe("small").plan(SCENE, choices).config
    )
    assert gaze_recipe("paper").plan(SCENE).config.activation == "linear"
    plan = gaze_recipe("small").plan(SCENE, settings={"seed": 4, "loss": "code"}, probes={"radius": 0.5})
    assert (plan.settings.seed, plan.settings.loss, plan.settings.steps, plan.probes.radius) == (4, "code", 600, 0.5)


@pytest.mark.parametrize(
    "given, steps, minutes", [({}, 600, None), ({"minutes": 2.0}, None, 2.0), ({"steps": 5}, 5, None)]
)
def test_of_minutes_and_steps_the_one_that_is_given_counts(given, steps, minutes):
    settings = gaze_recipe("small").gaze_settings(given)
    assert (settings.steps, settings.minutes) == (steps, minutes)


@pytest.mark.parametrize("name, takes", [(DEFAULT, False), ("small", True), ("paper", True)])
def test_what_a_recipe_does_not_take_is_refused(name, takes):
    recipe = gaze_recipe(name)
    recipe.require([])
    if takes:
        recipe.require(["loss", "semantic", "begin"])
        return
    with pytest.raises(NergError, match="no choice of --loss, --begin field, but ways of its own; add --recipe small"):
        recipe.require(["loss", "begin"])


def test_features_and_weights_are_those_of_a_radiance_field():
    for wrong in ({"begin": True}, {"choices": FieldChoices(semantic="snapshot")}):
        with pytest.raises(NergError, match="needs a radiance field: give it with --field"):
            gaze_recipe("small").plan(SCENE, **wrong)


def test_the_papers_recipe_is_fifty_epochs_at_a_rate_that_falls_from_the_start():
    """Each probe is drawn fifty times; the rate is lower with every step, down to a tenth."""
    recipe = gaze_recipe("paper")
    assert recipe.settings["steps"] * recipe.settings["probes"] == 50 * recipe.probes["count"]
    settings = GazeSettings(**recipe.settings)
    assert settings.rate(0) == 1e-3 and settings.rate(0.01) < 1e-3
    assert settings.rate(0.5) == pytest.approx(1e-3 * 0.1**0.5) and settings.rate(1) == pytest.approx(1e-4)


def test_another_kind_of_recipe_is_one_entry(monkeypatch):
    monkeypatch.setattr("nerg_mi.train.gaze_recipes.RECIPES", dict(RECIPES))
    coarse = register(
        Recipe(
            name="coarse",
            summary="a log density on two levels",
            config=lambda choices: LogGazeConfig(variant=choices.variant, width=16),
            trainer=LikelihoodTrainer,
            losses=("likelihood",),
            settings={"steps": 4, "zones": 0, "loss": "likelihood"},
            probes={},
        )
    )
    plan = gaze_recipe("coarse").plan(SCENE, FieldChoices(variant="capture"))
    assert plan.trainer is LikelihoodTrainer and plan.config == LogGazeConfig(variant="capture", width=16)
    assert gaze_recipe("small").trainer is ProductTrainer
    with pytest.raises(NergError, match="one of default, small, paper.*, coarse"):
        gaze_recipe("finer")
    # What nobody takes cannot be had elsewhere.
    with pytest.raises(NergError, match="no choice of --colour.*leave it out"):
        replace(coarse).require(["colour"])
