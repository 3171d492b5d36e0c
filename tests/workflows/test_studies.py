"""Studies, the demo, and alignments."""

from __future__ import annotations

import csv
import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.alignment import align as alignment
from nerg_mi.alignment import profile
from nerg_mi.alignment.align import align
from nerg_mi.alignment.check import AlignmentCheck
from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError
from nerg_mi.evaluation.study import list_rows, measure_rows
from nerg_mi.evaluation.study_subject import open_subject
from nerg_mi.maths.geometry import Box
from nerg_mi.rays.rays import Rays
from nerg_mi.train import geometry_files as geometry
from nerg_mi.train.geometry_files import check_geometry
from nerg_mi.workflows import demo, study
from nerg_mi.workflows.demo import STAGES, make_demo
from nerg_mi.workflows.gaze_commands import GazeOptions
from nerg_mi.workflows.scene_commands import DemoOptions, StudyOptions
from nerg_mi.workflows.study import find_reference_scene, measure_part, plan_study, run_study
from nerg_mi.workflows.train_gaze import train_gaze
from tests.alignment import rooms
from tests.evaluation.test_study_subject import SCENE, TWIN
from tests.figures.standins import write_standins
from tests.refusals import mentions
from tests.tasks.clusters import ClusterOfProcesses, wait_until
from tests.tasks.works import lay_out
from tests.workflows.recorder import Recorder

# ---- The study as a job: its settings and messages ----


@pytest.mark.nightly
def test_a_study_can_run_some_settings(tmp_path):
    recorder = Recorder()
    options = StudyOptions(width=12, height=8, quick=True, only="jitter|paper, 1024 steps$", mode="llvm_ad_rgb")
    result = run_study("slab", tmp_path, options, recorder)
    report = result.report
    assert [r["setting"] for r in report["rows"]] == ["default", "jitter", "paper, 1024 steps"]
    # The first renders and the timings have equal shares of the progress, and the scaling has the rest.
    shares = [share for share, _ in recorder.steps]
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] < 1
    assert 0.4 < recorder.share_at("time of default") < 0.5 and 0.8 < recorder.share_at("pixels 16") < 1
    assert recorder.messages[-len(result.files) :] == [f"wrote {path}" for path in result.files]
    assert all(path.is_file() for path in result.files) and recorder.messages[0].startswith("default: ")


# ---- A study in parts: errors of two workers equal those of this process, and the timing machine is reported ----


SMALL = {"width": 12, "height": 8, "quick": True, "mode": "llvm_ad_rgb"}
SMALL |= {"only": "jitter|spp 2|no colour|visibility transmittance|paper, 64 steps$"}
TIMES = {"seconds", "cpu_seconds", "peak_mb", "pareto"}
TIMING_COLUMNS = {"default_seconds", "default_cpu_seconds", "timed_by"}


def errors(report):
    rows = [{k: v for k, v in row.items() if k not in TIMES | TIMING_COLUMNS} for row in report["rows"]]
    return json.dumps([rows, [{**row, "seconds": 0} for row in report["scaling"]]])


def test_two_workers_measure_equal_errors(tmp_path, rgb, monkeypatch):
    pytest.importorskip("distributed", reason="dask is not installed (extra cluster)")
    monkeypatch.setattr(study, "ROWS", 2)
    local = run_study("sphere", tmp_path / "here", StudyOptions(**SMALL)).report
    with ClusterOfProcesses(tmp_path) as cluster:
        cluster.start_worker(), cluster.start_worker()
        wait_until(lambda: all("connected to" in cluster.log(f"worker{k}") for k in (0, 1)), "both workers are there")
        options = StudyOptions(**SMALL, scheduler=cluster.address)
        distributed = run_study("sphere", tmp_path / "there", options).report
    assert errors(distributed) == errors(local) and len(local["rows"]) == 6
    who = distributed["timed_by"]
    # Dask may give one worker the scaling, and the other one all settings.
    assert [w["process"] for w in who] == [1, 2][: len(who)] and sum(w["rows"] for w in who) == len(distributed["rows"])
    assert all(w["threads"] == 1 and w["processor"] and 0 < w["seconds"][0] <= w["seconds"][1] for w in who)
    assert {row["timed_by"] for row in distributed["rows"]} == {w["process"] for w in who} and local["timed_by"] == []
    assert all(row["default_seconds"] > 0 for row in distributed["rows"])
    heads = [set((tmp_path / k / "study.csv").read_text().split("\n")[0].split(",")) for k in ("here", "there")]
    assert heads[1] - heads[0] == TIMING_COLUMNS
    assert "Each setting was timed by one of several processes" in (tmp_path / "there" / "study.md").read_text()
    # A second run reads all results, including times, from the store.
    again = run_study("sphere", tmp_path / "there", StudyOptions(**SMALL, store=tmp_path / "there.tasks")).report
    assert again["rows"] == distributed["rows"] and again["scaling"] == distributed["scaling"]


def test_a_worker_measures_a_scene_and_its_mesh_in_its_folder(rgb, tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE.format(eye="-2, -1, $height"))
    (tmp_path / "twin.xml").write_text(TWIN)
    subject = open_subject(str(tmp_path / "scene.xml"), "auto", 12, 8, {"height": "3"}, find_reference_scene)
    every = list_rows(subject, True)
    (number,) = (k for k, row in enumerate(every) if row.name == "jitter")
    options = StudyOptions(**SMALL, defaults={"height": "3"})
    common = plan_study(subject, tmp_path / "scene.xml", options)
    measure_part(lay_out(common, tmp_path / "elsewhere"), (number,), tmp_path / "rows.json")
    measured = json.loads((tmp_path / "rows.json").read_text())
    expected = {"rows": measure_rows(subject, [every[0], every[number]], 1, 16), "scaling": []}
    assert errors(measured | {"scaling": []}) == errors(expected) and measured["rows"][1]["surface_mae"] > 0


# ---- The demo as a job: its stages and its result; `tests/cli/test_scenes` tests the pictures ----


@pytest.mark.nightly
def test_the_demo_reports_each_stage_and_writes_each_file(tmp_path):
    recorder = Recorder()
    options = DemoOptions(defaults=write_standins(tmp_path), width=24, spp=1, mode="llvm_ad_rgb")
    result = make_demo(tmp_path / "demo", options, recorder)
    steps = [text for _, text in recorder.steps]
    assert list(dict.fromkeys(steps)) == list(STAGES) == list(result.seconds)
    fractions = [share for share, _ in recorder.steps]
    assert fractions == sorted(fractions) and fractions[0] == 0 and fractions[-1] <= 1
    assert set(result.files) == set((tmp_path / "demo").iterdir()) and result.report["variant"] == "llvm_ad_rgb"
    assert recorder.messages[-len(result.files) :] == [f"wrote {path}" for path in result.files]
    assert len(recorder.messages) == len(STAGES) + len(result.files)


def test_demo_ends_with_the_files_to_open(tmp_path, monkeypatch):
    """Without the images, which take long."""
    recorder = Recorder()
    monkeypatch.setattr(demo, "make_demo", lambda *_: recorder.message("made"))
    demo.make_demo_to_look_at(tmp_path, DemoOptions(), recorder)
    first, made, files, command = recorder.messages
    assert str(len(STAGES)) in first and made == "made"
    assert all(str(tmp_path / name) in files for name in ("report.html", "occlusion.png"))
    assert "report.html" in command


@pytest.mark.nightly
def test_the_demo_report_contains_the_tracked_gaze(tmp_path):
    """With the field of the store; the values of an observer do not depend on other observers."""
    result = make_demo(tmp_path, DemoOptions(width=24, spp=1, mode="llvm_ad_rgb"))
    text = (tmp_path / "report.html").read_text("utf-8")
    rays = Rays.load(tmp_path / demo.TRACKED)
    assert tmp_path / demo.TRACKED in result.files and len(rays.persons) == 100 and len(rays) > 10_000
    assert (
        'id="people"' in text
        and "median number of participants within" in text
        and f"{len(rays):,} of 150,021 rows" in text
    )
    with (tmp_path / "aoi.csv").open() as file:
        shares = np.array([float(row["observer_share"]) for row in csv.DictReader(file)])
    # For one observer, who sees some of the shelves; three observers together would see almost all.
    assert len(shares) == 30 and (shares == 0).sum() > 8 and 0 < shares.sum() < 1


# ---- The alignment as a job: evidence, refused input and output files ----


RAYS = rooms.people(300)


def pairs(folder, noise=0.0, mirror=1.0):
    rng = np.random.default_rng(0)
    truth, x = rooms.similarity(rng, scale=2.0), rng.uniform(0, 4, (6, 3))
    y = rooms.carried(truth, x + rng.normal(0, noise, x.shape))
    rows = np.c_[x * (mirror, 1, 1), y].tolist()
    path = folder / "pairs.csv"
    path.write_text("x,y,z,place_x,place_y,place_z\n" + "".join(",".join(map(str, r)) + "\n" for r in rows))
    return truth, path


def test_an_alignment_is_written_with_its_figure(tmp_path):
    truth, path = pairs(tmp_path)
    reporter = Recorder()
    result = align(pairs=path, output=tmp_path / "a.json", progress=reporter)
    np.testing.assert_allclose(result.matrix, truth, atol=1e-6)
    metadata = json.loads((tmp_path / "a.json").read_text())
    assert metadata["files"]["pairs"]["file"] == "pairs.csv" and metadata["forced"] is False
    assert (tmp_path / "a.png").is_file() and "align" in reporter.messages[-1]


def test_bad_and_mirrored_fits_are_refused_unless_forced(tmp_path):
    _, path = pairs(tmp_path, noise=0.5)
    with pytest.raises(NergError, match=r"give other evidence, or a larger limit; or add"):
        align(pairs=path, output=tmp_path / "a.json")
    assert not (tmp_path / "a.json").exists()
    assert align(pairs=path, output=tmp_path / "a.json", force=True).forced
    _, path = pairs(tmp_path, mirror=-1)
    with pytest.raises(NergError, check=lambda error: error.kind == "mirrored" and mentions("handedness")(error)):
        align(pairs=path)


@pytest.mark.parametrize(
    "options, rays, why",
    [
        ({}, None, "or add pairs=FILE, tracking_surface=FILE,"),
        ({}, RAYS, "no scene is given: add environment=FILE, or surface"),
        ({"tracking_cameras": "a"}, None, "tracking_cameras and scene_cameras must be"),
        ({"pairs": "a", "tracking_surface": "b"}, None, "are alternatives"),
        ({"pairs": "a", "init": "b"}, None, "are alternatives"),
        ({"pairs": "PAIRS", "refine": True}, None, "refine=True needs the tracking"),
        ({"pairs": "PAIRS", "up": "north"}, None, "up must be comma-separated numbers, got"),
        ({"pairs": "PAIRS", "up": "0,0,0"}, None, "or three numbers x,y,z that are not all"),
        ({"pairs": "PAIRS", "scale": -1.0}, None, "scale must lie in"),
        ({"pairs": "PAIRS", "environment": "a", "surface": "b"}, None, "only one scene can be given: use environment"),
    ],
)
def test_contradictory_options_are_refused(tmp_path, options, rays, why):
    _, path = pairs(tmp_path)
    settings = {k: path if v == "PAIRS" else v for k, v in options.items()}
    with pytest.raises(NergError, match=why):
        align(rays, **settings)


def test_up_axis_and_initial_alignment_give_the_same_frame(tmp_path, monkeypatch):
    truth, path = pairs(tmp_path)
    np.save(tmp_path / "points.npy", rooms.carried(truth, rooms.traces(8000).end))
    aligned = align(pairs=path, output=tmp_path / "a.json")
    again = align(RAYS, init=tmp_path / "a.json", surface=tmp_path / "points.npy")
    same = align(RAYS, init=aligned, surface=tmp_path / "points.npy")
    np.testing.assert_array_equal(same.matrix, again.matrix)
    off = rooms.carried(again.matrix, RAYS.origin) - rooms.carried(aligned.matrix, RAYS.origin)
    assert np.linalg.norm(off, axis=1).max() < 0.1 and again.evidence["kind"] == "tracking"
    assert alignment._turn("-y")[:3, :3] @ [0, -1, 0] == pytest.approx([0, 0, 1])


def test_undetermined_turn_is_refused_unless_forced(tmp_path, monkeypatch):
    monkeypatch.setattr(profile, "_TURNS", np.radians([10, 90, 180]))
    np.save(tmp_path / "points.npy", rooms.traces(8000).end)
    gaze, out = replace(RAYS, hit=None), tmp_path / "a.json"
    options, reporter = {"surface": tmp_path / "points.npy", "scale": 1.0}, Recorder()
    with pytest.raises(NergError, match=r"do not determine the turn.*turn.*force"):
        align(gaze, output=out, **options)
    assert not out.exists()
    forced = align(gaze, output=out, **options, force=True, progress=reporter)
    low, high = forced.uncertainty["turn_degrees"]
    assert forced.forced and high - low > 10 and not any(line.startswith("residuals") for line in reporter.messages)
    with pytest.raises(NergError, match=r"a\.json.*do not determine the turn.*force"):
        plan = GazeOptions(align=out, scene=tmp_path / "a.xml", mode="llvm_ad_rgb")
        train_gaze(gaze, tmp_path / "gaze.safetensors", plan)
    fixed = align(gaze, output=out, **options, turn=0.0, shift="0,0,0")
    assert np.allclose(fixed.matrix, np.eye(4)) and fixed.uncertainty["shift_cm"] == 0


def test_turn_and_shift_hold_with_pairs(tmp_path):
    truth, path = pairs(tmp_path)
    shift = ",".join(map(str, truth[:3, 3]))
    options = {"pairs": path, "up": "y", "shift": shift, "force": True}
    free = alignment._turn("y") @ align(**options).matrix
    degrees = np.degrees(np.arctan2(free[1, 0], free[0, 0])) + 10
    result = align(**options, turn=degrees)
    fixed = alignment._turn("y") @ result.matrix
    assert np.degrees(np.arctan2(fixed[1, 0], fixed[0, 0])) == pytest.approx(degrees)
    np.testing.assert_allclose(result.matrix[:3, 3], truth[:3, 3], atol=1e-9)
    with pytest.raises(NergError, match="no positive scale"):
        align(**options, turn=degrees + 180)
    constraints = alignment._find_constraints("z", 0.5, None, 2.0, None, "1,2,3")
    assert constraints["scene_floor"] == pytest.approx(3 + 2 * 0.5)


def place(alignment_check, monkeypatch):
    monkeypatch.setattr(geometry, "check_alignment", lambda *_: alignment_check)
    return Environment(object(), Box((0, 0, 0), (1, 1, 1)), "field")  # pyright: ignore[reportArgumentType] # unused argument


def test_gaze_that_hits_no_surface_is_refused_and_doubts_are_reported(monkeypatch):
    reporter = Recorder()
    nowhere = place(AlignmentCheck(1.0, 0.0, 0.0), monkeypatch)
    with pytest.raises(NergError, match="100.0.*field.*force"):
        check_geometry(nowhere, RAYS, "--field f", False, reporter)
    check_geometry(nowhere, RAYS, "--field f", True, reporter)
    check_geometry(place(AlignmentCheck(0.4, 0.3, 0.2), monkeypatch), RAYS, "--scene s", False, reporter)
    assert len(reporter.warnings) == 2 and "30 % of the heads are inside solid objects" in reporter.warnings[1]
    assert "nerg align RAYS --scene s -o alignment.json" in reporter.warnings[1]
    check_geometry(place(AlignmentCheck(0.05, 0.0, 0.0), monkeypatch), RAYS, "--field f", False, reporter)
    for kind in ("hits", "none"):
        bare = replace(nowhere, kind=kind, medium=None if kind == "none" else nowhere.medium)
        check_geometry(bare, RAYS, "", False, reporter)
    assert len(reporter.warnings) == 2


@pytest.mark.parametrize("option", ["surface", "environment", "tracking_surface"])
def test_unused_parts_of_a_mesh_are_reported(tmp_path, option):
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n")
    reporter, (_, path) = Recorder(), pairs(tmp_path)
    evidence = {} if option == "tracking_surface" else {"pairs": path, "force": True}
    with pytest.raises(NergError, match="no scene") if option == "tracking_surface" else nullcontext():
        align(**{option: tmp_path / "a.obj"}, **evidence, progress=reporter)
    (note,) = [m for m in reporter.messages if "mtllib" in m]
    assert str(tmp_path / "a.obj") in note and note.endswith(": mtllib")
