"""Reports on gaze fields, without missing sections."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from typing import Any

import pytest

from nerg_mi.environment.gaze import GazeField
from nerg_mi.errors import NergError
from nerg_mi.evaluation.gaze_report import write_report
from nerg_mi.files.atomic import file_sha256
from nerg_mi.reports import inputs
from nerg_mi.reports import report as report_module
from nerg_mi.reports.data import Run
from nerg_mi.reports.report import Report, ReportBuilder, report
from nerg_mi.tracking.rays import Rays
from nerg_mi.train.gaze import train_gaze
from tests.evaluation.test_gaze import crowd
from tests.evaluation.test_gaze_report import scored
from tests.recorder import Recorder
from tests.refusals import mentions
from tests.reports.made import packed_scene

SMALL: dict[str, Any] = {"width": 24, "spp": 1, "max_points": 600, "viewpoints": 4}
NAMES = ("Ada", "Grace", "Mary", "Edsger")


@pytest.fixture(scope="module")
def run(trained, tmp_path_factory):
    """A folder with rays, a gaze field trained on them and their hit points, an evaluation and AOIs."""
    folder = tmp_path_factory.mktemp("run") / "files"
    shutil.copytree(trained, folder)
    rows = scored((0.9, 0.85, 0.3), reach=0.02)
    persons = [{"method": "gaze field", "person": "Ada", "rays": 9, "bits": 0.1}]
    metadata = {"gaze": "gaze.safetensors", "split": "both", "kappa": 20.0, "positions": 60, "people": 30}
    (folder / "gaze.eval").mkdir()
    write_report(folder / "gaze.eval", rows, persons, metadata, "# notes")
    wall = {"the wall": [[1.2, -0.5, 0.0], [1.8, 0.5, 2.2]], "nothing there": [[-9, -9, -9], [-8, -8, -8]]}
    (folder / "objects.json").write_text(json.dumps(wall))
    return folder


@pytest.fixture
def without_3d(monkeypatch):
    """Skip the 3D scene in tests that do not need it."""
    monkeypatch.setattr(ReportBuilder, "_stage", lambda *_: (None, (0, 0, 0, 0)))


def test_a_report_of_all_files_in_a_folder(run, tmp_path):
    recorder = Recorder()
    result = report([run], **SMALL, aois=run / "objects.json", progress=recorder)
    text = result.html
    assert (
        recorder.messages[0]
        == "Better than the nearest rays, the strongest baseline, for held-out participants at held-out positions."
        in text
    )
    assert len(text) < 6_000_000 and result.save(tmp_path / "a.html").read_text(encoding="utf-8") == text
    contents = result.run
    assert {"color", "own", "sphere", "plan", "layout"} <= set(contents.pictures)
    assert {role for role, *_ in contents.inputs} == {"gaze field", "hit points", "rays", "evaluation", "objects"}
    wall, unseen = contents.objects
    assert wall.recorded.mean > 0.5 and wall.num_could_see == wall.num_participants == 4 and wall.predicted.mean > 0
    assert unseen.predicted.mean == 0 and unseen.num_could_see == unseen.num_looked == 0
    scene = packed_scene(text)
    assert (
        100 < scene["count"] <= 600
        and len(scene["observers"]) == 6
        and contents.nearby_participants
        and min(contents.nearby_participants) >= 1
    )
    # There are no names, neither from rays nor from evaluations.
    assert not any(name in text for name in NAMES) and "participant 1" in text
    # The numbers of rays and participants of the gaze field, and all sources of the report.
    assert (
        re.fullmatch(r"data: [\d,]+ rays of [1-4] participants", contents.support_note)
        and text.count(contents.support_note) >= 2
    )
    made = json.loads(contents.provenance_json)
    assert made["what"] == "nerg report" and set(made["inputs"].values()) == {digest for *_, digest in contents.inputs}
    assert contents.provenance_json.encode("latin-1") in contents.pictures["own"].png and 'name="provenance"' in text


@pytest.mark.nightly
def test_equal_inputs_give_an_equal_report(run, tmp_path):
    files = [run / "gaze.safetensors", run / "rays.npz", run / "gaze.eval"]
    one, two = report(files, **SMALL).html, report(files[::-1], **SMALL).html
    assert one == two and str(run) not in one


def test_names_are_shown_only_on_request(run, tmp_path):
    text = report([run], **SMALL, show_names=True, paths=False).html
    assert "Ada" in text and packed_scene(text)["paths"] == []


@pytest.fixture
def not_evaluated(run, tmp_path):
    """The folder ``run`` without its evaluation."""
    return shutil.copytree(run, tmp_path / "not evaluated", ignore=shutil.ignore_patterns("gaze.eval"))


def test_evaluation_next_to_the_gaze_field_is_used(without_3d, run, tmp_path):
    recorder, gaze = Recorder(), run / "gaze.safetensors"
    contents = report(gaze, **SMALL, progress=recorder).run
    assert len(contents.results) == 1 and contents.results[0].num_positions == 60
    assert any(str(run / "gaze.eval" / "gaze.json") in text for text in recorder.messages)
    # An evaluation of an earlier checkpoint of that name.
    copy = shutil.copytree(run, tmp_path / "copy")
    data = json.loads((copy / "gaze.eval" / "gaze.json").read_text())
    for sha256, count in ((file_sha256(gaze), 1), ("0" * 64, 0)):
        (copy / "gaze.eval" / "gaze.json").write_text(json.dumps({**data, "gaze_sha256": sha256}))
        contents = report(copy / "gaze.safetensors", **SMALL, progress=recorder).run
        assert len(contents.results) == count
    assert any("trained again" in text for text in recorder.warnings)


def test_extrapolated_observers_are_reported_once(without_3d, run, tmp_path):
    """Of recorded positions, and the one that was chosen."""
    rays = Rays.load(run / "rays.npz")
    origin = rays.origin.copy()
    origin[::3, 1] += 99
    replace(rays, origin=origin).save(tmp_path / "moved.npz")
    cases = [(run / "rays.npz", None, 0), (tmp_path / "moved.npz", None, 1), (run / "rays.npz", (0.0, 99.0, 1.6), 1)]
    for file, observer, count in cases:
        recorder = Recorder()
        view: dict[str, Any] = {"observer": observer, "camera": (0.0, 0.0, 1.6), "target": (1.5, 0.0, 1.0)}
        report([run / "gaze.safetensors", file], **SMALL, **view, progress=recorder)
        assert sum("extrapolated" in text for text in recorder.warnings) == count, (file, observer)
    # Also if no camera is found.
    recorder = Recorder()
    with pytest.raises(NergError, check=mentions("camera")):
        report(run / "gaze.safetensors", **SMALL, observer=(0.0, 99.0, 1.6), progress=recorder)
    assert [("extrapolated" in text) for text in recorder.warnings] == [True]


def test_a_report_of_a_gaze_field_alone(not_evaluated, tmp_path):
    recorder = Recorder()
    result = report(not_evaluated / "gaze.safetensors", **SMALL, progress=recorder)
    text = result.html
    for sentence in (
        "No evaluation was given",
        "No gaze samples were given, so the report has no data-quality section. The field was trained on",
        "positions are unknown",
        "No AOIs were given. Name a file of AOIs.",
    ):
        assert sentence in text
    assert "there is no evaluation" in recorder.messages[0] and packed_scene(text)["marks"] == 1
    assert result.run.rays is None and result.run.results == ()


def test_a_report_of_objects_without_rays(without_3d, run, tmp_path):
    options: dict[str, Any] = {"aois": run / "objects.json", "observer": (-0.5, 0.0, 1.6)}
    contents = report(run / "gaze.safetensors", **SMALL, **options).run
    assert contents.objects[0].recorded is None and 0 < contents.objects[0].predicted.mean < 1
    assert "at the given position, (-0.50, 0.00, 1.60)" in contents.observer


def test_missing_evaluations_are_computed(without_3d, not_evaluated, monkeypatch):
    splits, evaluate = [], inputs.evaluate_gaze

    def evaluate_quickly(gaze, rays, environment, **settings):
        splits.append(settings["split"])
        return evaluate(gaze, rays, environment, **settings, directions=64, resamples=2, min_rays=8)

    monkeypatch.setattr(inputs, "evaluate_gaze", evaluate_quickly)
    files = [not_evaluated / "gaze.safetensors", not_evaluated / "rays.npz"]
    contents = report(files, **SMALL, evaluate=True).run
    assert splits == ["pos"] and contents.results[0].rows[0]["method"] == "gaze field"
    assert contents.verdicts[0][1].grade == "none"  # of three positions
    with pytest.raises(NergError, check=mentions("evaluate")):
        report(files[:1], **SMALL, evaluate=True)


def test_evaluations_of_another_field_are_refused_or_warned_about(without_3d, run, tmp_path):
    def evaluation(**changes):
        metadata = {"gaze": "gaze.safetensors", "split": "pos", "kappa": 20.0, "positions": 60, "people": 30}
        folder = tmp_path / f"e{len(list(tmp_path.iterdir()))}"
        folder.mkdir()
        write_report(folder, scored((0.9, 0.85, 0.3)), [], {**metadata, **changes}, "# notes")
        return folder

    gaze = run / "gaze.safetensors"
    with pytest.raises(NergError, match="is an evaluation of a gaze field other than"):
        report([gaze, evaluation(gaze_sha256="ab")], **SMALL)
    with pytest.raises(NergError, match='"pos"'):
        report([gaze, evaluation(), evaluation()], **SMALL)
    contents = report([gaze, evaluation(gaze="other.safetensors")], **SMALL).run
    assert "a field named other.safetensors" in contents.warnings[0]


def test_a_report_without_geometry(rgb):
    small = {"radius": 0.5, "probes": 8, "steps": 2, "directions": 64, "validation_zones": 0, "min_rays": 8}
    rays = crowd(600)
    result = report([train_gaze(rays, "none", **small), rays], **SMALL, aois={"a": [[0, 0, 0], [1, 1, 1]]})
    assert "The 3D view needs the geometry" in result.html and result.run.objects == ()
    assert "AOIs need the geometry of the scene, which was not given." in result.html
    assert "sphere" in result.run.pictures


def test_objects_in_memory_give_the_report_of_their_files(without_3d, run):
    gaze, rays = GazeField.load(run / "gaze.safetensors"), Rays.load(run / "rays.npz")
    in_memory = replace(gaze, path=None, name="in memory", environment=gaze.open_environment())
    one, two = (report([field, rays], **SMALL).run for field in (gaze, in_memory))
    assert two.title == "Gaze field" and "volume" not in two.geometry_description
    assert two.inputs[0][:2] == ("gaze field", "in memory")
    assert one.pictures["own"].png[:8] == two.pictures["own"].png[:8] and one.objects == two.objects
    assert one.observer == two.observer and one.nearby_participants == two.nearby_participants
    assert repr(two) and len(repr(Report(two))) < 200


@pytest.mark.nightly
def test_existing_images_are_not_rendered_again(run, monkeypatch):
    first, rendered = report_module.render_channels, {}

    def count_rendering(scene, sensor, *rest):
        made = first(scene, sensor, *rest)
        rendered[report_module.VIEWS[len(rendered)]] = made
        return made

    monkeypatch.setattr(report_module, "render_channels", count_rendering)
    one = report(run / "gaze.safetensors", **SMALL).html
    assert set(rendered) == set(report_module.VIEWS)

    def never(*_):
        raise AssertionError("rendered again")

    monkeypatch.setattr(report_module, "render_channels", never)
    assert report(run / "gaze.safetensors", **SMALL, rendered=rendered).html == one


def test_pages_have_their_suffix(run, tmp_path):
    with pytest.raises(NergError, match=r"ends in \.html"):
        Report(Run("a", {}, "", "none")).save(tmp_path / "report.pdf")


def test_damaged_rays_are_refused(run, tmp_path):
    (tmp_path / "rays.npz").write_bytes(b"PK\x03\x04 no")
    with pytest.raises(NergError, match=r"rays\.npz"):
        report([run / "gaze.safetensors", tmp_path / "rays.npz"], **SMALL)
