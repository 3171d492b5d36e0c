"""`nerg eval gaze`: an evaluation from training to tables."""

from __future__ import annotations

import json

import pytest

from nerg_mi.cli import main
from tests.evaluation.test_gaze import crowd


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
