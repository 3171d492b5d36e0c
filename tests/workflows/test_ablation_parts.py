"""Trainings of an ablation in parts: kept, and run by a process of its own as by this one."""

from dataclasses import replace

import pytest

from nerg_mi.workflows import ablation
from nerg_mi.workflows.ablation import ablate
from nerg_mi.workflows.parts import account_for_store
from tests.conftest import ROOT
from tests.evaluation.test_gaze import crowd
from tests.workflows.recorder import Recorder
from tests.workflows.test_ablation import OPTIONS

TIMES = ("train_seconds", "frame_seconds")
ONE = replace(OPTIONS, variant=("emit_capture",), seeds=1, cameras=0, threads=1)


def scores(found):
    return [{k: v for k, v in row.items() if k not in TIMES} for row in found.rows]


@pytest.fixture
def trained(monkeypatch):
    """What was trained in this process."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    found, original = [], ablation.train_variant
    monkeypatch.setattr(ablation, "train_variant", lambda *given: found.append(given[:2]) or original(*given))
    return found


@pytest.mark.nightly
def test_a_training_elsewhere_scores_as_one_here_and_is_kept(tmp_path, rgb, trained):
    rays = crowd(3000)
    elsewhere = ablate(rays, tmp_path / "a", replace(ONE, scheduler="local:1"))
    assert trained == []
    here = ablate(rays, tmp_path / "b", ONE)
    assert scores(elsewhere) == scores(here)
    trained.clear()
    assert (tmp_path / "a" / "default_emit_capture_0.safetensors").is_file()
    # One seed more: that one is trained, whoever does it.
    ablate(rays, tmp_path / "a", replace(ONE, seeds=2, store=tmp_path / "a.tasks"))
    assert [seed for _, seed in trained] == [1]
    told = Recorder()
    (job,) = account_for_store(tmp_path / "a.tasks", reporter=told).jobs
    assert (job.what, job.total, job.left) == (f"nerg ablate {tmp_path / 'a'}", 2, 0)
