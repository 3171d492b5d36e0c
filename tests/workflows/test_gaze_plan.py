"""Options of a gaze training: what goes together, and what of it arrives in the plan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from nerg_mi.errors import NergError
from nerg_mi.train.geometry import GazePlace
from nerg_mi.workflows.train_gaze import GazeOptions, check_plan, plan_gaze
from tests.train.gaze.looks import BOX

HITS = GazeOptions(geometry="hits")
FIELD = GazeOptions(field=Path("field.safetensors"), recipe="small")
VIEWS = GazeOptions(geometry="none", views=Path("photos"), salience="maps")
SCENE = GazePlace(None, BOX, "scene")


@pytest.mark.parametrize(
    "options, alone, said",
    [
        (GazeOptions(), False, "--field FILE.*--scene FILE.*--geometry"),
        (replace(HITS, scene=Path("a.xml")), False, "one of --field FILE"),
        (GazeOptions(geometry="hit"), False, '"hits".*"none".*"hit"'),
        (GazeOptions(geometry="none"), True, "say what to learn from"),
        (replace(VIEWS, geometry="hits"), True, "--geometry.*--align.*--semantic.*--mix-folds"),
        (replace(VIEWS, mix_kappa=20.0), True, "--mix-kappa"),
        (replace(VIEWS, mix_folds=2), True, "--mix-folds.*--mix-kappa"),
        (replace(VIEWS, test_zones=1), True, "belong to rays"),
        (replace(VIEWS, salience=None), False, "salience needs both"),
        (replace(HITS, align_views=Path("a.json")), False, "salience needs both"),
        (replace(HITS, align=Path("a.json")), False, "--align.*--field.*--scene"),
        (replace(HITS, test_people=0.5), False, "say where, with --test-zones"),
        (replace(FIELD, begin="nerf"), False, '"random".*"field"'),
        (replace(FIELD, freeze=True), False, "--freeze"),
        (replace(HITS, recipe="small", begin="field"), False, "--begin"),
        (replace(HITS, recipe="small", semantic="snapshot"), False, "--semantic"),
        (replace(HITS, loss="paper"), False, "add --recipe small"),
        (replace(HITS, integral=1.0), False, "no choice of --integral"),
        (replace(HITS, recipe="small", mix_kappa=20.0), False, "--mix-kappa.*--recipe"),
        (replace(HITS, recipe="small", mix_folds=2), False, "--mix-folds.*--recipe"),
        (replace(HITS, mix_kappa=2000.0), False, "concentration of 2000 vanish; let it be at most 1660"),
        (replace(HITS, activation="exp"), False, "no choice of --activation"),
        (replace(FIELD, loss="likelihood"), False, '"likelihood"'),
        (replace(HITS, recipe="large"), False, "one of default, small, paper"),
        (replace(HITS, variant="both"), False, "--variant.*--activation"),
        (replace(FIELD, semantic="glance"), False, "--semantic.*--variant.*--begin"),
        (GazeOptions(geometry="none", recipe="small"), False, "needs surfaces"),
    ],
)
def test_what_does_not_go_together_is_told_in_a_sentence(options, alone, said):
    with pytest.raises(NergError, match=said):
        check_plan(options, alone)


@pytest.mark.parametrize("options, alone", [(HITS, False), (FIELD, False), (VIEWS, True), (VIEWS, False)])
def test_what_goes_together_is_not_refused(options, alone):
    assert check_plan(options, alone).radius == 0.25


def test_every_option_of_settings_and_probes_arrives():
    options = GazeOptions(
        scene=Path("a.xml"),
        recipe="small",
        steps=7,
        seed=3,
        loss="code",
        zones=1,
        refit=False,
        learning_rate=0.5,
        weight_decay=0.25,
        integral=2.0,
        radius=0.4,
        probes=9,
        placement="grid",
        cap=32,
        min_rays=4,
        kappa_rule="silverman",
        kappa=11.0,
        weights="person",
        directions=33,
        fresh=True,
        variant="emit",
        activation="exp",
        size="paper",
        normalized=True,
    )
    plan = plan_gaze(options, SCENE)
    s, p, c = plan.settings, plan.probes, plan.config
    assert (s.steps, s.seed, s.loss, s.zones, s.refit, s.learning_rate) == (7, 3, "code", 1, False, 0.5)
    assert (s.weight_decay, s.integral, s.frozen) == (0.25, 2.0, False)
    assert (p.radius, p.count, p.placement, p.cap, p.min_rays) == (0.4, 9, "grid", 32, 4)
    assert (p.kappa_rule, p.kappa, p.weights, p.directions, p.fresh) == ("silverman", 11.0, "person", 33, True)
    assert (c.variant, c.activation, c.grid.levels, c.normalized) == ("emit", "exp", 16, True)


def test_views_alone_make_a_normalised_field():
    """They do not say how much is looked altogether."""
    options = GazeOptions(scene=Path("a.xml"), recipe="small")
    assert plan_gaze(options, SCENE, views_alone=True).config.normalized
    assert not plan_gaze(options, SCENE).config.normalized
