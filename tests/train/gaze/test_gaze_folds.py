"""Tests of `nerg_mi.train.gaze_run`."""

from __future__ import annotations

from dataclasses import replace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.checkpoint import read_checkpoint, write_checkpoint
from nerg_mi.rays.rays import Rays
from nerg_mi.train.gaze_data import Supervision
from nerg_mi.train.gaze_ensemble import train_ensemble
from nerg_mi.train.gaze_run import (
    SELECTION_KEY,
    PRIOR_WEIGHTS,
    FoldResults,
    PriorWeightSelection,
    _best,
    _choose,
    _Judgement,
    _regions,
    iter_folds,
    evaluate_folds,
    train_gaze,
)
from nerg_mi.train.gaze_settings import ProbeSettings
from nerg_mi.train.gaze_trainer import KIND, StateSettings

from .looks import LIKELIHOOD, LOG, NOWHERE, planned

# ---- The share of the blind density: chosen by people and places that are held out ----

PROBES_HERE = ProbeSettings(radius=0.3, count=48, min_rays=1, kappa=20.0, directions=128, weights="person")


def people(law: float, seed: int = 0, count: int = 6, each: int = 400) -> Rays:
    """People on a floor of 3 x 3 m. With ``law`` 1 all look at one point; with 0 each one has a direction of their own,
    wherever they stand."""
    rng = np.random.default_rng(seed)
    n = count * each
    person = np.repeat(np.arange(count), each)
    origin = np.column_stack([rng.uniform(-1.5, 1.5, (n, 2)), np.full(n, 1.6)])
    away = np.array([0.0, 0.0, 1.6]) - origin
    own = np.column_stack([rng.normal(size=(count, 2)), np.zeros(count)])
    d = np.where(rng.random((n, 1)) < law, away / np.linalg.norm(away, axis=1, keepdims=True), own[person])
    d = d / np.linalg.norm(d, axis=1, keepdims=True) + 0.2 * rng.normal(size=(n, 3))
    names = tuple("abcdefghij"[:count])
    return Rays(np.arange(n) * 0.2, person, names, origin, d / np.linalg.norm(d, axis=1, keepdims=True), np.ones(n))


def plan_of(**changes):
    settings = replace(
        LIKELIHOOD, **{"mix_folds": 3, "zones": 0, "steps": 300, "probes": 16, "weight_decay": 0.0, **changes}
    )
    return planned(LOG, settings, PROBES_HERE)


def test01_those_who_are_judged_are_not_learnt_from():
    rays = people(1.0)
    folds = list(iter_folds(rays, plan_of()))
    assert len(folds) == 3
    for learn, held, centres in folds:
        assert not set(learn.person) & set(held.person) and len(np.unique(held.person)) == 2
        assert np.linalg.norm(learn.origin[:, None] - centres[None], axis=2).min() > 2 * PROBES_HERE.radius
    assert set(np.concatenate([np.unique(held.person) for _, held, _ in folds])) == set(range(6))
    # People who sit: the zones take all that is theirs.
    seated = people(1.0)
    seated = replace(seated, origin=np.column_stack([seated.person, 0 * seated.person, 1.2 + 0 * seated.person]))
    assert [len(learn) for learn, _, _ in iter_folds(seated, plan_of())] == [1600] * 3
    for learn, held, _ in iter_folds(people(1.0, count=1), plan_of()):
        assert len(held) == 400 and 0 < len(learn) < 400


def test02_of_shares_that_cannot_be_told_apart_the_largest():
    low = np.linspace(1, 2, len(PRIOR_WEIGHTS))
    assert _choose(np.array([low, low])).mix == PRIOR_WEIGHTS[0]
    assert _choose(np.array([low[::-1], low[::-1]])).mix == 1.0
    # One fold likes the field as much as the other likes the blind density.
    unsure = _choose(np.array([low, 3.01 - low]))
    assert unsure.mix == 1.0 and unsure.folds == 2 and np.isclose(unsure.kld_blind, (2 + 1.01) / 2)
    assert np.isclose(_choose(low[None]).kld, 1)
    # The blind density alone is worse by .1 of KLD, with a standard error of .1, .15 and .25.
    for error, mix in ((0.1, PRIOR_WEIGHTS[0]), (0.15, PRIOR_WEIGHTS[0]), (0.25, 1.0)):
        curves = np.stack([low * 0 + 2, low * 0 + 2])
        curves[:, 1:], curves[:, -1] = 3, (2.1 - error, 2.1 + error)
        assert _choose(curves).mix == mix


@pytest.mark.parametrize(("law", "kept"), [(1.0, True), (0.0, False)])
def test04_a_field_counts_where_position_tells(law, kept, rgb):
    """Where all look at one point the field stays as it is; where each person has a way of their own, position tells
    nothing of others."""
    told = []
    found = evaluate_folds(Supervision(people(law)), NOWHERE, plan_of(), ns, told.append).select_weight()
    assert found is not None and told[-1].stage.startswith("fold") and 0 < told[-1].done <= 1
    assert found.regions is not None and 0 < found.regions["50%"] < found.regions["80%"] < found.regions["95%"] < 1
    if kept:
        assert found.mix < 0.3 and found.kld < found.kld_blind and found.folds <= 3
    else:
        assert found.mix > 0.6 and found.kld <= found.kld_field and found.folds == 3


def test05_of_a_training_and_of_an_ensemble(rgb):
    rays = people(0.0)
    plan = plan_of(steps=20)
    field, about = train_gaze(Supervision(rays), NOWHERE, plan, ns)
    assert field.config.mix == about["mix"]["mix"] == PRIOR_WEIGHTS[np.isclose(PRIOR_WEIGHTS, about["mix"]["mix"])][0]
    ensemble, about = train_ensemble(2, Supervision(rays), NOWHERE, plan, ns)
    assert [f.config.mix for f in ensemble.members] == [about["mix"]["mix"]] * 2
    # Nobody can be held out at places that hold too few rays: the share stays.
    few, about = train_gaze(Supervision(people(0.0, each=12)), NOWHERE, plan, ns)
    assert few.config.mix == LOG.mix and about["mix"]["mix"] == LOG.mix and about["mix"]["folds"] == 0
    assert about["mix"]["regions"] is None
    assert PriorWeightSelection(0.5, 1, regions={"80%": 0.71234}).to_dict()["regions"] == {"80%": 0.7123}

    # After Ctrl-C the field is there, as it was before.
    def stop(progress):
        if progress.stage.startswith("fold"):
            raise KeyboardInterrupt

    field, about = train_gaze(Supervision(rays), NOWHERE, plan, ns, on_progress=stop)
    assert about["interrupted"] and "mix" not in about and field.config.mix == LOG.mix


def test07_regions_are_those_of_the_mixture():
    """Of looks in three of four directions, the shares in which they lie are quantiles: half of the looks lie in the
    region of the second."""
    field, blind = np.array([[0.8, 0.4, 0.2, 0.0]]), np.array([[0.0, 0.2, 0.2, 0.4]])
    # Half of each: 0.4, 0.3, 0.2, 0.2.
    judgement = _Judgement(field, blind, np.array([0, 1, 3]), np.array([0, 3]))
    found = _regions([judgement], 0.5)
    np.testing.assert_allclose([found[k] for k in ("50%", "80%", "95%")], [0.55 / 1.1, 0.9 / 1.1, 0.9 / 1.1])
    # The blind density alone finds the third look the likeliest, and the second as likely as where nobody looked.
    np.testing.assert_allclose(_regions([judgement], 1.0)["50%"], 1 - 0.5 * (0.2 + 0.2) / 0.8)


# ---- Variants ----
#
# Which architecture a place gets: by people and positions that are held out, once, and kept for a run that goes on.

CAPTURE, BOTH = replace(LOG, variant="capture", geometry="none"), replace(LOG, geometry="none")


def two(**changes):
    return replace(plan_of(**changes), config=CAPTURE, alternatives=(BOTH,))


def judged(*klds, mix=0.1):
    """Folds in which a field has these KLD with the least share, and is worse with any other."""
    look = _Judgement(np.ones((1, 4)), np.ones((1, 4)), np.array([0]), np.array([0, 1]))
    curves = np.array([k + np.linspace(0, 1, len(PRIOR_WEIGHTS)) for k in klds])
    return FoldResults(mix, curves, [look] * len(klds))


def test01_the_first_counts_unless_another_is_better_by_half_a_standard_error():
    plan = replace(two(), alternatives=())
    for first, second, chosen in (
        ((1.0, 1.0), (0.9, 0.9), BOTH),
        ((0.9, 0.9), (1.0, 1.0), CAPTURE),
        # Better by .1, with a standard error of .3, and of .15.
        ((1.0, 1.0), (0.6, 1.2), CAPTURE),
        ((1.0, 1.0), (0.75, 1.05), BOTH),
        # Of folds that both have.
        ((1.0, 1.0, 0.1), (0.9, 0.9), BOTH),
    ):
        found, choice = _best(plan, (CAPTURE, BOTH), [judged(*first), judged(*second)])
        assert found.config == chosen and choice.variant == chosen.variant and choice.mix == PRIOR_WEIGHTS[0]
        assert choice.variants == pytest.approx({"capture": np.mean(first[:2]), "emit_capture": np.mean(second)})
    found, choice = _best(plan, (CAPTURE, BOTH), [FoldResults(0.1, np.empty(0), [])] * 2)
    assert found.config == CAPTURE and choice == PriorWeightSelection(0.1, 0)


@pytest.mark.nightly
def test02_what_foretells_those_who_are_held_out_is_trained(rgb):
    """A direction that all people share wherever they stand is in the blind density; one point that all look at, in
    the middle of a floor, needs emit where capture has one harmonic."""
    told = []
    flat = replace(CAPTURE, sh_degree=1)
    plan = replace(two(), config=flat, alternatives=(replace(BOTH, reach=1.9, sh_degree=1),))
    field, about = train_gaze(Supervision(people(1.0)), NOWHERE, plan, ns, on_progress=told.append)
    klds = about["mix"]["variants"]
    assert about["mix"]["variant"] == field.config.variant == "emit_capture"
    assert klds["emit_capture"] < klds["capture"] and field.config.mix == about["mix"]["mix"]
    stages = [state.stage for state in told]
    assert stages.index("fit") > max(i for i, s in enumerate(stages) if s.startswith("fold"))
    assert {"fold 1 of capture", "fold 1 of emit_capture"} <= set(stages)
    ensemble, about = train_ensemble(2, Supervision(people(1.0)), NOWHERE, plan, ns)
    assert {(f.config.variant, f.config.mix) for f in ensemble.members} == {("emit_capture", about["mix"]["mix"])}


@pytest.mark.parametrize("members", [0, 2])
def test04_a_run_that_goes_on_keeps_what_was_chosen(members, tmp_path, rgb, monkeypatch):
    supervision = Supervision(people(1.0))
    path, plan, steps = tmp_path / "a.run", two(steps=8), []

    def stop(progress):
        steps.append(progress)
        if progress.stage.endswith("fit") and progress.steps == 4:
            raise KeyboardInterrupt

    def trained(**more):
        if members:
            return train_ensemble(members, supervision, NOWHERE, plan, ns, **more)
        return train_gaze(supervision, NOWHERE, plan, ns, write=lambda field, about: None, **more)

    state = StateSettings(path=path, interval=0.0)
    if members:
        with pytest.raises(KeyboardInterrupt):
            trained(state=state, tell=stop)
    else:
        assert trained(state=state, tell=stop).provenance["interrupted"]
    chosen = read_checkpoint(path, KIND)[1]["about"][SELECTION_KEY]
    # Folds do not choose again.
    monkeypatch.setattr("nerg_mi.train.gaze_run.evaluate_folds", None)
    tensors, meta = read_checkpoint(path, KIND)
    for wrong in ({"mix": 2.0, "folds": 1}, {"colour": 1}, "capture"):
        write_checkpoint(path, KIND, tensors, {**meta, "about": {**meta["about"], SELECTION_KEY: wrong}})
        with pytest.raises(NergError, match="damaged.*start anew"):
            trained(state=replace(state, resume=True))
    write_checkpoint(path, KIND, tensors, meta)
    about = trained(state=replace(state, resume=True)).provenance
    assert not about["interrupted"] and about["mix"] == chosen
    with pytest.raises(NergError, match="nothing to resume"):
        train_gaze(supervision, NOWHERE, plan, ns, state=StateSettings(path=tmp_path / "b.run", resume=True))


def test05_ctrl_c_while_folds_choose_says_that_nothing_was_kept(rgb):
    def stop(progress):
        if progress.stage.startswith("fold"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="emit_capture"):
        train_gaze(Supervision(people(1.0)), NOWHERE, two(), ns, on_progress=stop)
