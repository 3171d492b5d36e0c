"""Tests of `nerg_mi.train.gaze_folds`."""

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
from nerg_mi.train.gaze_folds import (
    PRIOR_WEIGHTS,
    SELECTION_KEY,
    FoldResults,
    PriorWeightSelection,
    _calibrate_regions,
    _FoldDensities,
    _select_best,
    _select_weight,
    evaluate_folds,
    iter_folds,
)
from nerg_mi.train.gaze_run import train_gaze
from nerg_mi.train.gaze_settings import ProbeSettings
from nerg_mi.train.gaze_trainer import KIND, StateSettings

from .looks import LIKELIHOOD, LOG, NOWHERE, planned

# ---- The prior weight: selected by held-out participants and positions ----

PROBES_HERE = ProbeSettings(radius=0.3, count=48, min_rays=1, kappa=20.0, directions=128, weights="person")


def people(law: float, seed: int = 0, count: int = 6, each: int = 400) -> Rays:
    """Participants on a floor of 3 x 3 m.

    With ``law`` 1 all look at one point; with 0 each has an individual direction, independent of the position.
    """
    rng = np.random.default_rng(seed)
    n = count * each
    person = np.repeat(np.arange(count), each)
    origin = np.column_stack([rng.uniform(-1.5, 1.5, (n, 2)), np.full(n, 1.6)])
    away = np.array([0.0, 0.0, 1.6]) - origin
    individual = np.column_stack([rng.normal(size=(count, 2)), np.zeros(count)])
    d = np.where(rng.random((n, 1)) < law, away / np.linalg.norm(away, axis=1, keepdims=True), individual[person])
    d = d / np.linalg.norm(d, axis=1, keepdims=True) + 0.2 * rng.normal(size=(n, 3))
    names = tuple("abcdefghij"[:count])
    return Rays(np.arange(n) * 0.2, person, names, origin, d / np.linalg.norm(d, axis=1, keepdims=True), np.ones(n))


def plan_of(**changes):
    settings = replace(
        LIKELIHOOD, **{"mix_folds": 3, "zones": 0, "steps": 300, "probes": 16, "weight_decay": 0.0, **changes}
    )
    return planned(LOG, settings, PROBES_HERE)


def test01_held_out_participants_are_not_trained_on():
    rays = people(1.0)
    folds = list(iter_folds(rays, plan_of()))
    assert len(folds) == 3
    for learn, held, centres in folds:
        assert not set(learn.person) & set(held.person) and len(np.unique(held.person)) == 2
        assert np.linalg.norm(learn.origin[:, None] - centres[None], axis=2).min() > 2 * PROBES_HERE.radius
    assert set(np.concatenate([np.unique(held.person) for _, held, _ in folds])) == set(range(6))
    # Seated participants: the zones contain all of their rays.
    seated = people(1.0)
    seated = replace(seated, origin=np.column_stack([seated.person, 0 * seated.person, 1.2 + 0 * seated.person]))
    assert [len(learn) for learn, _, _ in iter_folds(seated, plan_of())] == [1600] * 3
    for learn, held, _ in iter_folds(people(1.0, count=1), plan_of()):
        assert len(held) == 400 and 0 < len(learn) < 400


def test02_the_largest_of_equivalent_weights_is_selected():
    low = np.linspace(1, 2, len(PRIOR_WEIGHTS))
    assert _select_weight(np.array([low, low])).prior_weight == PRIOR_WEIGHTS[0]
    assert _select_weight(np.array([low[::-1], low[::-1]])).prior_weight == 1.0
    # One fold prefers the field as much as the other prefers the prior.
    unsure = _select_weight(np.array([low, 3.01 - low]))
    assert unsure.prior_weight == 1.0 and unsure.folds == 2 and np.isclose(unsure.kld_prior, (2 + 1.01) / 2)
    assert np.isclose(_select_weight(low[None]).kld, 1)
    # The prior alone is worse by 0.1 in KLD, with a standard error of 0.1, 0.15 and 0.25.
    for error, mix in ((0.1, PRIOR_WEIGHTS[0]), (0.15, PRIOR_WEIGHTS[0]), (0.25, 1.0)):
        curves = np.stack([low * 0 + 2, low * 0 + 2])
        curves[:, 1:], curves[:, -1] = 3, (2.1 - error, 2.1 + error)
        assert _select_weight(curves).prior_weight == mix


@pytest.mark.parametrize(("law", "has_weight"), [(1.0, True), (0.0, False)])
def test04_the_field_has_weight_if_position_is_informative(law, has_weight, rgb):
    """If all look at one point, the field is not mixed; if each participant has an individual direction, position is
    not informative.
    """
    messages = []
    result = evaluate_folds(Supervision(people(law)), NOWHERE, plan_of(), ns, messages.append).select_weight()
    assert result is not None and messages[-1].stage.startswith("fold") and 0 < messages[-1].fraction <= 1
    assert result.regions is not None and 0 < result.regions["50%"] < result.regions["80%"] < result.regions["95%"] < 1
    if has_weight:
        assert result.prior_weight < 0.3 and result.kld < result.kld_prior and result.folds <= 3
    else:
        assert result.prior_weight > 0.6 and result.kld <= result.kld_field and result.folds == 3


def test05_of_a_training_and_of_an_ensemble(rgb):
    rays = people(0.0)
    plan = plan_of(steps=20)
    field, provenance = train_gaze(Supervision(rays), NOWHERE, plan, ns)
    assert (
        field.config.mix
        == provenance["mix"]["mix"]
        == PRIOR_WEIGHTS[np.isclose(PRIOR_WEIGHTS, provenance["mix"]["mix"])][0]
    )
    ensemble, provenance = train_ensemble(2, Supervision(rays), NOWHERE, plan, ns)
    assert [f.config.mix for f in ensemble.members] == [provenance["mix"]["mix"]] * 2
    # No position has enough rays to hold out, so the weight stays.
    few, provenance = train_gaze(Supervision(people(0.0, each=12)), NOWHERE, plan, ns)
    assert few.config.mix == LOG.mix and provenance["mix"]["mix"] == LOG.mix and provenance["mix"]["folds"] == 0
    assert provenance["mix"]["regions"] is None
    assert PriorWeightSelection(0.5, 1, regions={"80%": 0.71234}).to_dict()["regions"] == {"80%": 0.7123}

    # After Ctrl-C the field exists, without a selected weight.
    def stop(progress):
        if progress.stage.startswith("fold"):
            raise KeyboardInterrupt

    field, provenance = train_gaze(Supervision(rays), NOWHERE, plan, ns, on_progress=stop)
    assert provenance["interrupted"] and "mix" not in provenance and field.config.mix == LOG.mix


def test07_regions_are_those_of_the_mixture():
    """Rays are in three of four directions, and the levels are quantiles: half of the rays are in the region of the
    second.
    """
    field, prior = np.array([[0.8, 0.4, 0.2, 0.0]]), np.array([[0.0, 0.2, 0.2, 0.4]])
    # Half of each: 0.4, 0.3, 0.2, 0.2.
    judgement = _FoldDensities(field, prior, np.array([0, 1, 3]), np.array([0, 3]))
    result = _calibrate_regions([judgement], 0.5)
    np.testing.assert_allclose([result[k] for k in ("50%", "80%", "95%")], [0.55 / 1.1, 0.9 / 1.1, 0.9 / 1.1])
    # The prior alone prefers the third direction, and the second as much as the direction without rays.
    np.testing.assert_allclose(_calibrate_regions([judgement], 1.0)["50%"], 1 - 0.5 * (0.2 + 0.2) / 0.8)


# ---- Variants ----
#
# Selection of the architecture by held-out participants and positions, made once and stored for a resumed run.

CAPTURE, BOTH = replace(LOG, variant="capture", geometry="none"), replace(LOG, geometry="none")


def two(**changes):
    return replace(plan_of(**changes), config=CAPTURE, alternatives=(BOTH,))


def judged(*klds, mix=0.1):
    """Folds in which a field has these KLD with the smallest weight, and is worse with any other."""
    look = _FoldDensities(np.ones((1, 4)), np.ones((1, 4)), np.array([0]), np.array([0, 1]))
    curves = np.array([k + np.linspace(0, 1, len(PRIOR_WEIGHTS)) for k in klds])
    return FoldResults(mix, curves, [look] * len(klds))


def test01_the_first_variant_is_kept_unless_another_is_better():
    plan = replace(two(), alternatives=())
    for first, second, selected in (
        ((1.0, 1.0), (0.9, 0.9), BOTH),
        ((0.9, 0.9), (1.0, 1.0), CAPTURE),
        # Better by 0.1, with a standard error of 0.3, and of 0.15.
        ((1.0, 1.0), (0.6, 1.2), CAPTURE),
        ((1.0, 1.0), (0.75, 1.05), BOTH),
        # Over the common folds.
        ((1.0, 1.0, 0.1), (0.9, 0.9), BOTH),
    ):
        result, choice = _select_best(plan, (CAPTURE, BOTH), [judged(*first), judged(*second)])
        assert (
            result.config == selected and choice.variant == selected.variant and choice.prior_weight == PRIOR_WEIGHTS[0]
        )
        assert choice.variants == pytest.approx({"capture": np.mean(first[:2]), "emit_capture": np.mean(second)})
    result, choice = _select_best(plan, (CAPTURE, BOTH), [FoldResults(0.1, np.empty(0), [])] * 2)
    assert result.config == CAPTURE and choice == PriorWeightSelection(0.1, 0)


@pytest.mark.nightly
def test02_the_variant_that_predicts_held_out_participants_is_trained(rgb):
    """A common direction, independent of position, is in the prior; one common point in the middle of a floor needs
    emit if capture has only one harmonic.
    """
    messages = []
    flat = replace(CAPTURE, sh_degree=1)
    plan = replace(two(), config=flat, alternatives=(replace(BOTH, reach=1.9, sh_degree=1),))
    field, provenance = train_gaze(Supervision(people(1.0)), NOWHERE, plan, ns, on_progress=messages.append)
    klds = provenance["mix"]["variants"]
    assert provenance["mix"]["variant"] == field.config.variant == "emit_capture"
    assert klds["emit_capture"] < klds["capture"] and field.config.mix == provenance["mix"]["mix"]
    stages = [state.stage for state in messages]
    assert stages.index("fit") > max(i for i, s in enumerate(stages) if s.startswith("fold"))
    assert {"fold 1 of capture", "fold 1 of emit_capture"} <= set(stages)
    ensemble, provenance = train_ensemble(2, Supervision(people(1.0)), NOWHERE, plan, ns)
    assert {(f.config.variant, f.config.mix) for f in ensemble.members} == {("emit_capture", provenance["mix"]["mix"])}


@pytest.mark.parametrize("members", [0, 2])
def test04_a_resumed_run_keeps_its_selection(members, tmp_path, rgb, monkeypatch):
    supervision = Supervision(people(1.0))
    path, plan, steps = tmp_path / "a.run", two(steps=8), []

    def stop(progress):
        steps.append(progress)
        if progress.stage.endswith("fit") and progress.steps == 4:
            raise KeyboardInterrupt

    def trained(**options):
        if members:
            return train_ensemble(members, supervision, NOWHERE, plan, ns, **options)
        return train_gaze(supervision, NOWHERE, plan, ns, write=lambda field, provenance: None, **options)

    state = StateSettings(path=path, interval=0.0)
    if members:
        with pytest.raises(KeyboardInterrupt):
            trained(state=state, on_progress=stop)
    else:
        assert trained(state=state, on_progress=stop).provenance["interrupted"]
    selected = read_checkpoint(path, KIND)[1]["about"][SELECTION_KEY]
    # Folds are not evaluated again.
    monkeypatch.setattr("nerg_mi.train.gaze_folds.evaluate_folds", None)
    tensors, meta = read_checkpoint(path, KIND)
    for wrong in ({"mix": 2.0, "folds": 1}, {"colour": 1}, "capture"):
        write_checkpoint(path, KIND, tensors, {**meta, "about": {**meta["about"], SELECTION_KEY: wrong}})
        with pytest.raises(NergError, match="damaged.*start again"):
            trained(state=replace(state, resume=True))
    write_checkpoint(path, KIND, tensors, meta)
    provenance = trained(state=replace(state, resume=True)).provenance
    assert not provenance["interrupted"] and provenance["mix"] == selected
    with pytest.raises(NergError, match="cannot resume"):
        train_gaze(supervision, NOWHERE, plan, ns, state=StateSettings(path=tmp_path / "b.run", resume=True))


def test05_ctrl_c_during_folds_reports_that_no_state_is_saved(rgb):
    def stop(progress):
        if progress.stage.startswith("fold"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="emit_capture"):
        train_gaze(Supervision(people(1.0)), NOWHERE, two(), ns, on_progress=stop)
