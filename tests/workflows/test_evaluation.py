"""The evaluation of a gaze field as a job: its rows, files, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from nerg_mi.errors import NergError
from nerg_mi.evaluation.gaze import SCORES
from nerg_mi.rays.rays import Rays
from nerg_mi.workflows.evaluate import evaluate_gaze
from nerg_mi.workflows.gaze_commands import GazeEvaluationOptions, GazeOptions
from nerg_mi.workflows.train_gaze import train_gaze
from tests.evaluation.test_gaze import crowd

OPTIONS = GazeEvaluationOptions(min_rays=8, directions=128, resamples=2, pictures=1)
TRAINING = GazeOptions(
    geometry="none", radius=0.5, probes=8, steps=2, directions=64, zones=0, min_rays=8, test_zones=1, test_positions=3
)


def test_scores_stand_beside_the_baselines(trained, tmp_path):
    found = evaluate_gaze(trained / "gaze.safetensors", trained / "rays.npz", tmp_path / "eval", OPTIONS)
    names = [row["method"] for row in found.rows]
    assert names[0] == "gaze field" and "uniform" in names and "4,096 nearest rays" in names and found.split == "pos"
    assert all(set(SCORES) <= set(row) for row in found.rows) and 1 <= found.positions <= 3 and found.people >= 2
    assert {row["method"] for row in found.persons} == {"gaze field", "4,096 nearest rays"}
    files = {"gaze.md", "gaze.csv", "persons.csv", "gaze.json", "positions.png", "positions.csv"}
    assert {p.name for p in found.files} == files
    # All stand in one zone; a field of no support would say so at each.
    assert len(found.by_position) == found.positions and {row["group"] for row in found.by_position} == {"0"}
    assert all(row["support"] >= 0 and row["KLD"] > 0 for row in found.by_position)
    assert {row["method"] for row in found.calibration} >= {"gaze field", "4,096 nearest rays"}
    # By what the folds of the training held out.
    assert found.calibration[1]["method"] == "gaze field, calibrated"
    assert json.loads((tmp_path / "eval" / "gaze.json").read_text())["methods"][0]["KLD"] == found.rows[0]["KLD"]
    assert "directions of equal area" in (tmp_path / "eval" / "gaze.md").read_text()


def test_without_a_folder_nothing_is_written(trained):
    before = set(trained.iterdir())
    found = evaluate_gaze(trained / "gaze.safetensors", Rays.load(trained / "rays.npz"), options=OPTIONS)
    assert found.files == [] and set(trained.iterdir()) == before and found.rows[0]["method"] == "gaze field"


def test_what_cannot_be_scored_is_refused(trained, tmp_path):
    gaze = trained / "gaze.safetensors"
    crowd(2000).save(tmp_path / "rays.npz")
    with pytest.raises(NergError, match=r"other rays than .*; give the file rays\.npz"):
        evaluate_gaze(gaze, tmp_path / "rays.npz", options=OPTIONS)
    with pytest.raises(NergError, match="no people were held out"):
        evaluate_gaze(gaze, trained / "rays.npz", options=replace(OPTIONS, split="both"))
    train_gaze(crowd(1000), tmp_path / "gaze.safetensors", replace(TRAINING, test_zones=0))
    with pytest.raises(NergError, match="trained on all positions"):
        evaluate_gaze(tmp_path / "gaze.safetensors", crowd(1000), options=OPTIONS)
