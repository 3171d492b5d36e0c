"""Folds: trained and scored in processes of their own, kept, and the same in this one."""

import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.tables import write_json
from nerg_mi.jobs import folds
from nerg_mi.jobs.folds import SCORED, evaluate_folds, train_and_score
from nerg_mi.jobs.options.folds import FoldOptions
from nerg_mi.jobs.store_account import account_for_store
from nerg_mi.tasks.store import Store
from tests.conftest import ROOT
from tests.evaluation.gaze.test_evaluation import crowd
from tests.jobs.recorder import Recorder

SMALL = {"geometry": "none", "folds": 2, "zones": 1, "positions": 3, "radius": 0.6, "probes": 8, "steps": 2}
SMALL |= {"directions": 128, "min_rays": 8, "splits": "both,pos", "threads": 1}


def test_two_processes_score_as_this_one_does(tmp_path, rgb, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    crowd(3000).save(tmp_path / "rays.npz")
    options = FoldOptions(**SMALL, scheduler="local:2")
    found = evaluate_folds(tmp_path / "rays.npz", tmp_path / "out", options)
    assert {p.name for p in found.files} == {"folds.md", "folds.csv", "folds.json"}
    assert {row["fold"] for row in found.each} == {0, 1} and {row["split"] for row in found.rows} == {"both", "pos"}
    ours = [row["KLD"] for row in found.each if row["split"] == "both" and row["method"] == "gaze field"]
    assert found.rows[0]["KLD"] == pytest.approx(sum(ours) / 2) and ours[0] != ours[1]
    assert found.rows[0]["KLD.low"] < found.rows[0]["KLD"] and all(field.is_file() for field in found.fields)
    store = Store(tmp_path / "out.tasks")
    receipt = next(r for r in store.receipts() if r.label == "fold 0")
    (tmp_path / "here").mkdir()
    train_and_score(receipt.parameters, {"of-the-job/rays.npz": tmp_path / "rays.npz"}, tmp_path / "here")
    assert (tmp_path / "here" / SCORED).read_bytes() == (found.fields[0].parent / SCORED).read_bytes()


@pytest.fixture
def trained(monkeypatch):
    """The seeds of the folds that were trained and scored, which cost nothing here."""
    seeds = []

    def score(parameters, inputs, output):
        seeds.append(parameters["seed"])
        rows = [{"method": "gaze field", "KLD": 1.0 / (1 + parameters["seed"]), "CC": 0.5}]
        write_json(output / SCORED, {split: {"rows": rows} for split in parameters["splits"]})

    monkeypatch.setattr(folds, "train_and_score", score)
    return seeds


def test_folds_that_are_kept_are_not_trained_again(tmp_path, trained):
    def go(rays=None, **more):
        trained.clear()
        told = Recorder()
        rays = crowd(300) if rays is None else rays
        evaluate_folds(rays, tmp_path / "out", FoldOptions(**SMALL | more, store=tmp_path / "store"), told)
        return list(trained)

    assert go() == [0, 1] and go() == [] and go(folds=4) == [2, 3] and go(first=2, folds=3) == [4]
    # Other rays, and another recipe, are another evaluation; a change of how it is computed is none.
    assert go(crowd(301)) == [0, 1] and go(steps=3) == [0, 1] and go(threads=2) == []
    (job,) = account_for_store(tmp_path / "store").jobs
    assert (job.what, job.total, job.left) == (f"nerg eval folds {tmp_path / 'out'}", 2, 0)


def test_what_is_plainly_wrong(tmp_path):
    with pytest.raises(NergError, match="--splits names some of both, pos, people"):
        evaluate_folds(crowd(300), tmp_path / "out", FoldOptions(**SMALL | {"splits": "both,time"}))
    with pytest.raises(NergError, match="say where people looked around"):
        evaluate_folds(crowd(300), tmp_path / "out", FoldOptions(**SMALL | {"geometry": None}))
