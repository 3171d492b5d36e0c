"""A setting of gaze trainings is an option of all that trains: of folds and of ablations, too."""

from __future__ import annotations

from dataclasses import fields
from types import SimpleNamespace

import pytest

from nerg_mi.evaluation.ablation import Variant
from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings
from nerg_mi.workflows import ablation, evaluate
from nerg_mi.workflows.gaze_commands import AblationOptions, FoldOptions, GazeOptions
from nerg_mi.workflows.options import exposed_options

FIELDS = [f for kind in (ProbeSettings, GazeSettings) for f in fields(kind) if "help" in f.metadata]
SETTINGS = {f.metadata["option"] or f.name for f in FIELDS}
CHOSEN = {"learning_rate": 0.5, "cap": 7, "placement": "grid", "fresh": True}


class Stop(Exception):
    pass


@pytest.fixture
def training(monkeypatch):
    """The options that a training is begun with, which is then ended."""
    seen = []

    def begin(*arguments):
        seen.extend(a for a in arguments if isinstance(a, GazeOptions))
        raise Stop

    monkeypatch.setattr(evaluate, "train_gaze", begin)
    monkeypatch.setattr(ablation, "plan_gaze", begin)
    return seen


def test_folds_have_them(training, tmp_path):
    options = FoldOptions(geometry="hits", **CHOSEN)
    with pytest.raises(Stop):
        evaluate.train_and_score(evaluate.Folds(options, ("both",), None, None), 3, tmp_path)
    assert {name: getattr(training[0], name) for name in CHOSEN} == CHOSEN and training[0].seed == 3
    # What tests are made by has the same words, and is left out.
    assert training[0].kappa is training[0].radius is None


def test_ablations_have_them(training):
    bench = SimpleNamespace(options=AblationOptions(**CHOSEN, default_steps=3), place=None)
    with pytest.raises(Stop):
        ablation.plan_of(Variant(name="emit", recipe="default", gaze="emit"), 3, bench)
    assert {name: getattr(training[0], name) for name in CHOSEN} == CHOSEN
    assert training[0].kappa is training[0].radius is None and training[0].steps == 3


@pytest.mark.parametrize("kind", [FoldOptions, AblationOptions])
def test_none_is_forgotten(kind):
    assert {f.name for f in fields(kind)} | {"seed", "freeze", "loss", "mix_folds"} >= SETTINGS
    assert exposed_options(kind()) == {} and set(exposed_options(kind(**CHOSEN))) == set(CHOSEN)
