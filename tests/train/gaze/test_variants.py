"""Which architecture a place gets: by people and positions that are held out, once, and kept for a run that goes on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.checkpoint import read_checkpoint, write_checkpoint
from nerg_mi.train.gaze_data import Supervision
from nerg_mi.train.gaze_ensemble import train_ensemble
from nerg_mi.train.gaze_folds import CHOICE, SHARES, JudgedFolds, MixChoice, _best, _Judgement, choose_variant
from nerg_mi.train.gaze_run import train_gaze
from nerg_mi.train.gaze_trainer import KIND, StateSettings

from .looks import LOG, NOWHERE
from .test_mixing import people, plan_of

CAPTURE, BOTH = replace(LOG, variant="capture", geometry="none"), replace(LOG, geometry="none")


def two(**changes):
    return replace(plan_of(**changes), config=CAPTURE, alternatives=(BOTH,))


def judged(*klds, mix=0.1):
    """Folds in which a field has these KLD with the least share, and is worse with any other."""
    look = _Judgement(np.ones((1, 4)), np.ones((1, 4)), np.array([0]), np.array([0, 1]))
    curves = np.array([k + np.linspace(0, 1, len(SHARES)) for k in klds])
    return JudgedFolds(mix, curves, [look] * len(klds))


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
        assert found.config == chosen and choice.variant == chosen.variant and choice.mix == SHARES[0]
        assert choice.variants == pytest.approx({"capture": np.mean(first[:2]), "emit_capture": np.mean(second)})
    found, choice = _best(plan, (CAPTURE, BOTH), [JudgedFolds(0.1, np.empty(0), [])] * 2)
    assert found.config == CAPTURE and choice == MixChoice(0.1, 0)


@pytest.mark.nightly
def test02_what_foretells_those_who_are_held_out_is_trained(rgb):
    """A direction that all people share wherever they stand is in the blind density; one point that all look at, in
    the middle of a floor, needs emit where capture has one harmonic."""
    from nerg_mi.fields.mlp import namespace

    ns, told = namespace(rgb.Float(0)), []
    flat = replace(CAPTURE, sh_degree=1)
    plan = replace(two(), config=flat, alternatives=(replace(BOTH, reach=1.9, sh_degree=1),))
    field, about = train_gaze(Supervision(people(1.0)), NOWHERE, plan, ns, tell=told.append)
    klds = about["mix"]["variants"]
    assert about["mix"]["variant"] == field.config.variant == "emit_capture"
    assert klds["emit_capture"] < klds["capture"] and field.config.mix == about["mix"]["mix"]
    stages = [state.stage for state in told]
    assert stages.index("fit") > max(i for i, s in enumerate(stages) if s.startswith("fold"))
    assert {"fold 1 of capture", "fold 1 of emit_capture"} <= set(stages)
    ensemble, about = train_ensemble(2, Supervision(people(1.0)), NOWHERE, plan, ns)
    assert {(f.config.variant, f.config.mix) for f in ensemble.members} == {("emit_capture", about["mix"]["mix"])}


def test03_nothing_is_chosen_without_folds_or_others(rgb):
    from nerg_mi.fields.mlp import namespace

    ns, supervision = namespace(rgb.Float(0)), Supervision(people(1.0, each=40))
    for plan in (two(mix_folds=0), replace(two(), alternatives=())):
        assert choose_variant(supervision, NOWHERE, plan, ns) == (replace(plan, alternatives=()), None)
    views = Supervision(None, (object(),))  # which nothing looks at
    assert choose_variant(views, NOWHERE, two(), ns) == (replace(two(), alternatives=()), None)


@pytest.mark.parametrize("members", [0, 2])
def test04_a_run_that_goes_on_keeps_what_was_chosen(members, tmp_path, rgb, monkeypatch):
    from nerg_mi.fields.mlp import namespace

    ns, supervision = namespace(rgb.Float(0)), Supervision(people(1.0))
    path, plan, steps = tmp_path / "a.run", two(steps=8), []

    def stop(progress):
        steps.append(progress)
        if progress.stage.endswith("fit") and progress.steps == 4:
            raise KeyboardInterrupt

    def trained(**more):
        if members:
            return train_ensemble(members, supervision, NOWHERE, plan, ns, **more)
        return train_gaze(supervision, NOWHERE, plan, ns, write=lambda field, about: None, **more)

    state = StateSettings(path=path, every=0.0)
    if members:
        with pytest.raises(KeyboardInterrupt):
            trained(state=state, tell=stop)
    else:
        assert trained(state=state, tell=stop).provenance["interrupted"]
    chosen = read_checkpoint(path, KIND)[1]["about"][CHOICE]
    # Folds do not choose again.
    monkeypatch.setattr("nerg_mi.train.gaze_folds.judge_folds", None)
    tensors, meta = read_checkpoint(path, KIND)
    for wrong in ({"mix": 2.0, "folds": 1}, {"colour": 1}, "capture"):
        write_checkpoint(path, KIND, tensors, {**meta, "about": {**meta["about"], CHOICE: wrong}})
        with pytest.raises(NergError, match="damaged.*start anew"):
            trained(state=replace(state, resume=True))
    write_checkpoint(path, KIND, tensors, meta)
    about = trained(state=replace(state, resume=True)).provenance
    assert not about["interrupted"] and about["mix"] == chosen
    with pytest.raises(NergError, match="nothing to resume"):
        train_gaze(supervision, NOWHERE, plan, ns, state=StateSettings(path=tmp_path / "b.run", resume=True))


def test05_ctrl_c_while_folds_choose_says_that_nothing_was_kept(rgb):
    from nerg_mi.fields.mlp import namespace

    def stop(progress):
        if progress.stage.startswith("fold"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="emit_capture"):
        train_gaze(Supervision(people(1.0)), NOWHERE, two(), namespace(rgb.Float(0)), tell=stop)
