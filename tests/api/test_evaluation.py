"""Scores from a call: options are passed on to the jobs. That these work is shown by the examples (test_names)."""

from pathlib import Path

import pytest

import nerg_mi as nerg
from nerg_mi.workflows import ablation, evaluate, study, train_radiance
from nerg_mi.workflows.ablation import AblationOptions
from nerg_mi.workflows.geometry import GazeEvaluationOptions


class Asked(Exception):
    """Ends a job before it begins, with what it was asked."""


def raise_it(*arguments):
    raise Asked(*arguments)


@pytest.mark.parametrize(
    "module, job, call, expected",
    [
        (
            train_radiance,
            "evaluate_radiance",
            lambda: nerg.evaluate_radiance("f.safetensors", "photos", spp=3, pictures="out"),
            (
                Path("f.safetensors"),
                Path("photos"),
                train_radiance.RadianceScoreOptions(spp=3, pictures=Path("out"), mode="llvm_ad_rgb"),
            ),
        ),
        (
            evaluate,
            "evaluate_gaze",
            lambda: nerg.evaluate_gaze("g.safetensors", "r.npz", "out", split="pos"),
            (Path("g.safetensors"), Path("r.npz"), "out", GazeEvaluationOptions(split="pos", mode="llvm_ad_rgb")),
        ),
        (
            ablation,
            "ablate",
            lambda: nerg.ablate("r.npz", "out", options=AblationOptions(seeds=2), recipes="small"),
            (Path("r.npz"), "out", AblationOptions(seeds=2, recipes="small", mode="llvm_ad_rgb")),
        ),
        (
            study,
            "run_study",
            lambda: nerg.study("slab", "out", quick=True),
            ("slab", "out", study.StudyOptions(quick=True, mode="llvm_ad_rgb")),
        ),
    ],
)
def test01_options_reach_the_jobs(monkeypatch, tmp_path, module, job, call, expected):
    monkeypatch.chdir(tmp_path)
    for name in ("f.safetensors", "g.safetensors", "r.npz", "photos"):
        Path(name).touch()
    monkeypatch.setattr(module, job, raise_it)
    with pytest.raises(Asked) as found:
        call()
    assert found.value.args[:-1] == expected


@pytest.mark.parametrize("name", ["evaluate_radiance", "evaluate_gaze", "ablate", "study"])
def test02_wrong_options_are_told(name):
    with pytest.raises(nerg.NergError, match=f'{name} has no option "nothing"'):
        getattr(nerg, name)("a", "b", nothing=3)
