"""Folds: trained and scored by workers of which one is killed, kept, and the same in this process."""

import drjit as dr
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.tables import write_json
from nerg_mi.threads import set_thread_count
from nerg_mi.workflows import evaluate
from nerg_mi.workflows.evaluate import SCORED, evaluate_folds
from nerg_mi.workflows.gaze_commands import FoldOptions
from nerg_mi.workflows.parts import account_for_store
from tests.evaluation.test_gaze import crowd
from tests.tasks.clusters import ClusterOfProcesses, wait_until
from tests.workflows.recorder import Recorder

SMALL = {"geometry": "none", "folds": 2, "zones": 1, "positions": 3, "radius": 0.6, "probes": 8, "steps": 2}
SMALL |= {"directions": 128, "min_rays": 8, "splits": "both,pos", "threads": 1}


class Killer(Recorder):
    """Ends the first worker when the first fold is told of: it has another one in hand then."""

    def __init__(self, cluster):
        super().__init__()
        self.cluster = cluster

    def message(self, text):
        super().message(text)
        if text.startswith("fold 0"):
            self.cluster.workers[0].kill()


def test_two_workers_of_which_one_is_killed_score_as_this_process_does(tmp_path, rgb):
    pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    crowd(3000).save(tmp_path / "rays.npz")
    with ClusterOfProcesses(tmp_path) as cluster:
        told = Killer(cluster)
        cluster.start_worker(), cluster.start_worker()
        wait_until(lambda: all("works for" in cluster.log(f"worker{k}") for k in (0, 1)), "both workers are there")
        options = FoldOptions(**SMALL | {"folds": 3}, scheduler=cluster.address)
        found = evaluate_folds(tmp_path / "rays.npz", tmp_path / "out", options, told)
        assert cluster.workers[0].poll() is not None and cluster.workers[1].poll() is None
    assert {p.name for p in found.files} == {"folds.md", "folds.csv", "positions.csv", "folds.json"}
    assert {row["fold"] for row in found.each} == {0, 1, 2} and {row["split"] for row in found.rows} == {"both", "pos"}
    # Each fold's zone is a group of its own, and all positions together are asked too.
    assert {row["group"].split()[0] for row in found.by_position} == {"0", "1", "2"}
    assert {row["split"] for row in found.uncertainty} == {"both", "pos", "anywhere"}
    assert found.calibration[0]["folds"] == 3 and 0 <= found.calibration[0]["80%"] <= 1
    ours = [row["KLD"] for row in found.each if row["split"] == "both" and row["method"] == "gaze field"]
    assert found.rows[0]["KLD"] == pytest.approx(sum(ours) / 3) and ours[0] != ours[1]
    assert found.rows[0]["KLD.low"] < found.rows[0]["KLD"] and all(field.is_file() for field in found.fields)
    here = evaluate_folds(tmp_path / "rays.npz", tmp_path / "here", FoldOptions(**SMALL | {"folds": 3}))
    assert [f.read_bytes() for f in here.files] == [f.read_bytes() for f in found.files]


@pytest.fixture(autouse=True)
def threads():
    """What a job sets is the process's: it is set back."""
    before = dr.thread_count()
    yield
    set_thread_count(before)


@pytest.fixture
def trained(monkeypatch):
    """The seeds of the folds that were trained and scored with one thread, which cost nothing here."""
    seeds = []

    def score(common, seed, output):
        assert dr.thread_count() == 1
        seeds.append(seed)
        rows = [{"method": "gaze field", "KLD": 1.0 / (1 + seed), "CC": 0.5}]
        write_json(
            output / SCORED, {split: {"rows": rows, "by_position": [], "calibration": []} for split in common.splits}
        )

    score.__qualname__ = "train_and_score"

    monkeypatch.setattr(evaluate, "train_and_score", score)
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
    with pytest.raises(NergError, match="--splits"):
        evaluate_folds(crowd(300), tmp_path / "out", FoldOptions(**SMALL | {"splits": "both,time"}))
    with pytest.raises(NergError, match="say where people looked around"):
        evaluate_folds(crowd(300), tmp_path / "out", FoldOptions(**SMALL | {"geometry": None}))


@pytest.mark.nightly
def test_the_spread_of_an_ensemble_is_judged_as_support_is(tmp_path):
    found = evaluate_folds(crowd(3000), tmp_path / "out", FoldOptions(**SMALL | {"ensemble": 2, "splits": "both"}))
    assert {(row["signal"], row["error"]) for row in found.uncertainty} >= {("support", "KLD"), ("spread", "KLD")}
    assert all(row["spread"] > 0 for row in found.by_position)
    assert "spread" in (tmp_path / "out" / "folds.md").read_text()
