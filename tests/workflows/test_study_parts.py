"""A study in parts: errors of two workers are those of this process, and who took the times is said."""

import json

import pytest

from nerg_mi.evaluation.study import measure, settings
from nerg_mi.evaluation.study_subject import open_subject
from nerg_mi.workflows import study
from nerg_mi.workflows.scene_commands import StudyOptions
from nerg_mi.workflows.study import measure_part, planned_study, run_study, twin_beside
from tests.evaluation.test_study_subject import SCENE, TWIN
from tests.tasks.clusters import ClusterOfProcesses, wait_until
from tests.tasks.works import laid_out

SMALL = {"width": 12, "height": 8, "quick": True, "mode": "llvm_ad_rgb"}
SMALL |= {"only": "jitter|spp 2|no colour|visibility transmittance|paper, 64 steps$"}
TIMES = {"seconds", "cpu_seconds", "peak_mb", "pareto"}
BESIDE = {"default_seconds", "default_cpu_seconds", "timed_by"}


def errors(report):
    rows = [{k: v for k, v in row.items() if k not in TIMES | BESIDE} for row in report["rows"]]
    return json.dumps([rows, [{**row, "seconds": 0} for row in report["scaling"]]])


def test_two_workers_find_the_errors_of_this_process(tmp_path, rgb, monkeypatch):
    pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    monkeypatch.setattr(study, "ROWS", 2)
    here = run_study("sphere", tmp_path / "here", StudyOptions(**SMALL)).report
    with ClusterOfProcesses(tmp_path) as cluster:
        cluster.start_worker(), cluster.start_worker()
        wait_until(lambda: all("works for" in cluster.log(f"worker{k}") for k in (0, 1)), "both workers are there")
        options = StudyOptions(**SMALL, scheduler=cluster.address)
        there = run_study("sphere", tmp_path / "there", options).report
    assert errors(there) == errors(here) and len(here["rows"]) == 6
    who = there["timed_by"]
    # Dask may give one worker the scaling, and the other one all settings.
    assert [w["process"] for w in who] == [1, 2][: len(who)] and sum(w["rows"] for w in who) == len(there["rows"])
    assert all(w["threads"] == 1 and w["processor"] and 0 < w["seconds"][0] <= w["seconds"][1] for w in who)
    assert {row["timed_by"] for row in there["rows"]} == {w["process"] for w in who} and here["timed_by"] == []
    assert all(row["default_seconds"] > 0 for row in there["rows"])
    heads = [set((tmp_path / k / "study.csv").read_text().split("\n")[0].split(",")) for k in ("here", "there")]
    assert heads[1] - heads[0] == BESIDE
    assert "Times are those of whoever measured a setting: process 1 (" in (tmp_path / "there" / "study.md").read_text()
    # Started again, all of it is there, times as well.
    again = run_study("sphere", tmp_path / "there", StudyOptions(**SMALL, store=tmp_path / "there.tasks")).report
    assert again["rows"] == there["rows"] and again["scaling"] == there["scaling"]


def test_a_scene_file_is_measured_with_its_twin_where_a_worker_has_laid_them(rgb, tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE.format(eye="-2, -1, $height"))
    (tmp_path / "twin.xml").write_text(TWIN)
    subject = open_subject(str(tmp_path / "scene.xml"), "auto", 12, 8, {"height": "3"}, twin_beside)
    every = settings(subject, True)
    (number,) = (k for k, row in enumerate(every) if row.name == "jitter")
    options = StudyOptions(**SMALL, defaults={"height": "3"})
    common = planned_study(subject, tmp_path / "scene.xml", options)
    measure_part(laid_out(common, tmp_path / "elsewhere"), (number,), tmp_path / "rows.json")
    found = json.loads((tmp_path / "rows.json").read_text())
    here = {"rows": measure(subject, [every[0], every[number]], 1, 16), "scaling": []}
    assert errors(found | {"scaling": []}) == errors(here) and found["rows"][1]["surface_mae"] > 0
