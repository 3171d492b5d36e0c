"""`nerg eval gaze`: what it hands on, and an evaluation from training to tables."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from nerg_mi.cli import main
from nerg_mi.jobs import evaluation
from nerg_mi.jobs.evaluation import GazeEvaluation
from nerg_mi.jobs.options.evaluation import GazeEvaluationOptions
from tests.evaluation.gaze.test_evaluation import crowd


def test_the_job_is_given_what_was_asked_for(monkeypatch, capsys):
    given, row = [], {"method": "gaze field", "integral": 1.0}
    row |= dict.fromkeys(("KLD", "CC", "SIM", "MAE", "NSS", "AUC", "sAUC", "bits", "loglik"), 0.25)
    found = GazeEvaluation([row], [], "people", 7, 3, [Path("a.eval/gaze.md")])
    monkeypatch.setattr(evaluation, "evaluate_gaze", lambda *a: given.append(a[:-1]) or found)
    line = "eval gaze a.safetensors rays.npz --scene room.xml --split people --kappa 9 --blind-kappa 40 --directions 99"
    with pytest.raises(SystemExit) as end:
        main([*line.split(), *"--min-rays 5 --resamples 11 --pictures 0 --seed 2 --threads 1 -m llvm_ad_mono".split()])
    assert not end.value.code
    options = GazeEvaluationOptions(
        scene=Path("room.xml"),
        split="people",
        kappa=9.0,
        blind_kappa=40.0,
        directions=99,
        min_rays=5,
        resamples=11,
        pictures=0,
        seed=2,
        threads=1,
        mode="llvm_ad_mono",
    )
    assert given == [(Path("a.safetensors"), Path("rays.npz"), Path("a.eval"), options)]
    said = capsys.readouterr().out
    assert "a.safetensors, people: 7 positions, 3 persons" in said and "gaze field" in said
    assert said.rstrip().endswith("wrote a.eval/gaze.md")


@pytest.mark.nightly
def test_a_field_is_scored_as_it_was_trained(tmp_path, capsys):
    crowd().save(tmp_path / "rays.npz")
    gaze = tmp_path / "gaze.safetensors"

    def nerg(*arguments):
        with pytest.raises(SystemExit) as end:
            main([str(a) for a in arguments])
        return end.value.code, " ".join(capsys.readouterr().err.split())

    line = "--geometry hits --voxel 0.2 --radius 0.6 --steps 5 --directions 64 --probes 20 --zones 0"
    train = ["train", "gaze", tmp_path / "rays.npz", "-o", gaze, *line.split()]
    assert nerg(*train)[0] in (0, None)
    code, said = nerg("eval", "gaze", gaze, tmp_path / "rays.npz")
    assert code == 1 and "--test-zones 3" in said
    assert nerg(*train, "--test-zones", "2", "--test-positions", "6", "--test-people", "0.5")[0] in (0, None)
    line = "--min-rays 16 --resamples 4 --directions 256 --pictures 1"
    assert nerg("eval", "gaze", gaze, tmp_path / "rays.npz", *line.split())[0] in (0, None)
    found = json.loads((tmp_path / "gaze.eval" / "gaze.json").read_text())
    names = [r["method"] for r in found["methods"]]
    assert names[:2] == ["gaze field", "uniform"] and "4,096 nearest rays" in names and found["split"] == "both"
    assert found["methods"][0]["integral"] == pytest.approx(1, abs=0.02)
    for name in ("gaze.md", "gaze.csv", "persons.csv", "positions.png"):
        assert (tmp_path / "gaze.eval" / name).stat().st_size > 100
    crowd(seed=1).save(tmp_path / "others.npz")
    code, said = nerg("eval", "gaze", gaze, tmp_path / "others.npz")
    assert code == 1 and "trained on other rays" in said
