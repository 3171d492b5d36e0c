"""The study of a scene as a whole: its settings and messages, and its parts."""

from __future__ import annotations

import json

import pytest

from nerg_mi.evaluation import study_run
from nerg_mi.evaluation.study import list_rows, measure_rows
from nerg_mi.evaluation.study_run import find_reference_scene, measure_part, plan_study, study
from nerg_mi.evaluation.study_subject import open_subject
from nerg_mi.tasks.settings import Parallel
from tests.evaluation.test_study_subject import SCENE, TWIN
from tests.recorder import Recorder
from tests.tasks.clusters import ClusterOfProcesses, wait_until
from tests.tasks.works import lay_out

# ---- The study as a job: its settings and messages ----


@pytest.mark.nightly
def test_a_study_can_run_some_settings(rgb, tmp_path):
    recorder = Recorder()
    only = "jitter|paper, 1024 steps$"
    result = study("slab", width=12, height=8, quick=True, only=only, progress=recorder)
    report = result.report
    assert [r["setting"] for r in report["rows"]] == ["default", "jitter", "paper, 1024 steps"]
    # The first renders and the timings have equal shares of the progress, and the scaling has the rest.
    shares = [share for share, _ in recorder.steps]
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] < 1
    assert 0.4 < recorder.share_at("time of default") < 0.5 and 0.8 < recorder.share_at("pixels 16") < 1
    assert recorder.messages[0].startswith("default: ")
    assert all(path.is_file() for path in result.save(tmp_path))


# ---- A study in parts: errors of two workers equal those of this process, and the timing machine is reported ----


SMALL = {"width": 12, "height": 8, "quick": True}
SMALL |= {"only": "jitter|spp 2|no colour|visibility transmittance|paper, 64 steps$"}
TIMES = {"seconds", "cpu_seconds", "peak_mb", "pareto"}
TIMING_COLUMNS = {"default_seconds", "default_cpu_seconds", "timed_by"}


def errors(report):
    rows = [{k: v for k, v in row.items() if k not in TIMES | TIMING_COLUMNS} for row in report["rows"]]
    return json.dumps([rows, [{**row, "seconds": 0} for row in report["scaling"]]])


def test_two_workers_measure_equal_errors(equal_processes, tmp_path, rgb, monkeypatch):
    pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    monkeypatch.setattr(study_run, "ROWS", 2)
    here = study("sphere", **SMALL)
    local = here.report
    with ClusterOfProcesses(tmp_path) as cluster:
        cluster.start_worker(), cluster.start_worker()
        wait_until(lambda: all("connected to" in cluster.log(f"worker{k}") for k in (0, 1)), "both workers are there")
        there = study("sphere", **SMALL, parallel=Parallel(scheduler=cluster.address, store=tmp_path / "store"))
        distributed = there.report
    assert errors(distributed) == errors(local) and len(local["rows"]) == 6
    who = distributed["timed_by"]
    # Dask may give one worker the scaling, and the other one all settings.
    assert [w["process"] for w in who] == [1, 2][: len(who)] and sum(w["rows"] for w in who) == len(distributed["rows"])
    assert all(w["threads"] == 1 and w["processor"] and 0 < w["seconds"][0] <= w["seconds"][1] for w in who)
    assert {row["timed_by"] for row in distributed["rows"]} == {w["process"] for w in who} and local["timed_by"] == []
    assert all(row["default_seconds"] > 0 for row in distributed["rows"])
    here.save(tmp_path / "here"), there.save(tmp_path / "there")
    heads = [set((tmp_path / k / "study.csv").read_text().split("\n")[0].split(",")) for k in ("here", "there")]
    assert heads[1] - heads[0] == TIMING_COLUMNS
    assert "Each setting was timed by one of several processes" in (tmp_path / "there" / "study.md").read_text()
    # A second run reads all results, including times, from the store.
    again = study("sphere", **SMALL, parallel=Parallel(store=tmp_path / "store")).report
    assert again["rows"] == distributed["rows"] and again["scaling"] == distributed["scaling"]


def test_a_worker_measures_a_scene_and_its_mesh_in_its_folder(rgb, tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE.format(eye="-2, -1, $height"))
    (tmp_path / "twin.xml").write_text(TWIN)
    subject = open_subject(str(tmp_path / "scene.xml"), "auto", 12, 8, {"height": "3"}, find_reference_scene)
    every = list_rows(subject, True)
    (number,) = (k for k, row in enumerate(every) if row.name == "jitter")
    common = plan_study(subject, tmp_path / "scene.xml", {"height": "3"}, "llvm_ad_rgb", True, 1)
    measure_part(lay_out(common, tmp_path / "elsewhere"), (number,), tmp_path / "rows.json")
    measured = json.loads((tmp_path / "rows.json").read_text())
    expected = {"rows": measure_rows(subject, [every[0], every[number]], 1, 16), "scaling": []}
    assert errors(measured | {"scaling": []}) == errors(expected) and measured["rows"][1]["surface_mae"] > 0
