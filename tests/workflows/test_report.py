"""The report as a job: from files to a page, with what is missing left out."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace

import pytest

from nerg_mi.errors import NergError
from nerg_mi.evaluation.gaze_report import write_report
from nerg_mi.workflows import report
from nerg_mi.workflows.gaze_commands import GazeOptions
from nerg_mi.workflows.report import make_report
from nerg_mi.workflows.scene_commands import ReportOptions
from nerg_mi.workflows.train_gaze import train_gaze
from tests.evaluation.test_gaze import crowd
from tests.evaluation.test_gaze_report import scored
from tests.report.made import packed_scene
from tests.workflows.recorder import Recorder

SMALL = ReportOptions(width=24, spp=1, points=600, eyes=4, mode="llvm_ad_rgb")
NAMES = ("Ada", "Grace", "Mary", "Edsger")


@pytest.fixture(scope="module")
def run(trained, tmp_path_factory):
    """A folder with rays, a gaze field of them in their hit points, an evaluation and objects."""
    folder = tmp_path_factory.mktemp("run") / "files"
    shutil.copytree(trained, folder)
    rows = scored((0.9, 0.85, 0.3), reach=0.02)
    persons = [{"method": "gaze field", "person": "Ada", "rays": 9, "bits": 0.1}]
    about = {"gaze": "gaze.safetensors", "split": "both", "kappa": 20.0, "positions": 60, "people": 30}
    (folder / "gaze.eval").mkdir()
    write_report(folder / "gaze.eval", rows, persons, about, "# notes")
    wall = {"the wall": [[1.2, -0.5, 0.0], [1.8, 0.5, 2.2]], "nothing there": [[-9, -9, -9], [-8, -8, -8]]}
    (folder / "objects.json").write_text(json.dumps(wall))
    return folder


@pytest.fixture
def without_3d(monkeypatch):
    """No 3D scene is made, where it is not the matter."""
    monkeypatch.setattr(report._Work, "_stage", lambda *_: (None, (0, 0, 0, 0)))


def test_everything_of_a_folder(run, tmp_path):
    told = Recorder()
    options = replace(SMALL, objects=run / "objects.json")
    result = make_report([run], tmp_path / "a.html", options, told)
    text = result.path.read_text(encoding="utf-8")
    assert told.messages[0] == "Better than nearest rays, the strongest baseline, for new people at new places." in text
    assert told.messages[-1].startswith(f"wrote {tmp_path / 'a.html'} (") and len(text) < 6_000_000
    found = result.run
    assert {"color", "own", "sphere", "plan", "layout"} <= set(found.pictures)
    assert {role for role, *_ in found.inputs} == {"gaze field", "hit points", "rays", "evaluation", "objects"}
    wall, nothing = found.objects
    assert wall.recorded.mean > 0.5 and wall.saw == wall.people == 4 and wall.field.mean > 0
    assert nothing.field.mean == 0 and nothing.saw == nothing.looked == 0
    scene = packed_scene(text)
    assert 100 < scene["count"] <= 600 and len(scene["observers"]) == 6 and found.company and min(found.company) >= 1
    # Nobody's name, neither of rays nor of evaluations.
    assert not any(name in text for name in NAMES) and "person 1" in text
    # How many rays of how many people the gaze rests on, and what all of it was made of.
    assert re.fullmatch(r"made of [\d,]+ rays of [1-4] people", found.basis) and text.count(found.basis) >= 2
    made = json.loads(found.made)
    assert made["what"] == "nerg report" and set(made["inputs"].values()) == {digest for *_, digest in found.inputs}
    assert found.made.encode("latin-1") in found.pictures["own"].png and 'name="provenance"' in text


@pytest.mark.nightly
def test_equal_files_make_an_equal_report(run, tmp_path):
    files = [run / "gaze.safetensors", run / "rays.npz", run / "gaze.eval"]
    one = make_report(files, tmp_path / "a.html", SMALL).path.read_bytes()
    two = make_report(files[::-1], tmp_path / "b.html", SMALL).path.read_bytes()
    assert one == two and str(tmp_path).encode() not in one


def test_names_where_they_are_asked_for(run, tmp_path):
    options = replace(SMALL, names=True, paths=False)
    text = make_report([run], tmp_path / "a.html", options).path.read_text(encoding="utf-8")
    assert "Ada" in text and packed_scene(text)["paths"] == []


def test_a_gaze_field_alone(run, tmp_path):
    told = Recorder()
    result = make_report([run / "gaze.safetensors"], tmp_path / "a.html", SMALL, told)
    text = result.path.read_text(encoding="utf-8")
    for sentence in (
        "There is no verdict, for no evaluation is at hand",
        "The rays are not at hand, so that nothing is shown of who was recorded; the field was trained on",
        "The rays are not at hand, so that it is not known where people were.",
        "No objects are named: --objects FILE.json gives their boxes.",
    ):
        assert sentence in text
    assert "no evaluation is at hand" in told.messages[0] and packed_scene(text)["marks"] == 1
    assert result.run.rays is None and result.run.results == ()


def test_objects_without_rays(without_3d, run, tmp_path):
    options = replace(SMALL, objects=run / "objects.json", observer=(-0.5, 0.0, 1.6))
    found = make_report([run / "gaze.safetensors"], tmp_path / "a.html", options).run
    assert found.objects[0].recorded is None and 0 < found.objects[0].field.mean < 1
    assert "where it was asked for, at (-0.50, 0.00, 1.60)" in found.observer


def test_evaluations_are_made(without_3d, run, tmp_path, monkeypatch):
    from nerg_mi.workflows import report

    asked = []
    evaluate = report.evaluate_gaze

    def quick(gaze, rays, output, job, reporter):
        asked.append(job.split)
        return evaluate(gaze, rays, output, replace(job, directions=64, resamples=2, min_rays=8), reporter)

    monkeypatch.setattr(report, "evaluate_gaze", quick)
    files = [run / "gaze.safetensors", run / "rays.npz"]
    found = make_report(files, tmp_path / "a.html", replace(SMALL, evaluate=True)).run
    assert asked == ["pos"] and found.results[0].rows[0]["method"] == "gaze field"
    assert found.verdicts[0][1].grade == "none"  # of three positions
    with pytest.raises(NergError, match="--evaluate"):
        make_report(files[:1], tmp_path / "a.html", replace(SMALL, evaluate=True))


def test_evaluations_of_others_are_refused_or_doubted(without_3d, run, tmp_path):
    def evaluation(**changes):
        about = {"gaze": "gaze.safetensors", "split": "pos", "kappa": 20.0, "positions": 60, "people": 30}
        folder = tmp_path / f"e{len(list(tmp_path.iterdir()))}"
        folder.mkdir()
        write_report(folder, scored((0.9, 0.85, 0.3)), [], {**about, **changes}, "# notes")
        return folder

    gaze = run / "gaze.safetensors"
    with pytest.raises(NergError, match="evaluation of another gaze"):
        make_report([gaze, evaluation(gaze_sha256="ab")], tmp_path / "a.html", SMALL)
    with pytest.raises(NergError, match='"pos"'):
        make_report([gaze, evaluation(), evaluation()], tmp_path / "a.html", SMALL)
    found = make_report([gaze, evaluation(gaze="other.safetensors")], tmp_path / "a.html", SMALL).run
    assert "a field called other.safetensors" in found.doubts[0]


def test_without_a_place(tmp_path):
    job = GazeOptions(geometry="none", radius=0.5, probes=8, steps=2, directions=64, zones=0, min_rays=8)
    crowd(600).save(tmp_path / "rays.npz")
    train_gaze(tmp_path / "rays.npz", tmp_path / "gaze.safetensors", job)
    (tmp_path / "objects.json").write_text('{"a": [[0, 0, 0], [1, 1, 1]]}')
    options = replace(SMALL, objects=tmp_path / "objects.json")
    result = make_report([tmp_path / "gaze.safetensors", tmp_path / "rays.npz"], tmp_path / "a.html", options)
    text = result.path.read_text(encoding="utf-8")
    assert "Nothing is known of the place" in text and "There is no 3D scene" in text and result.run.objects == ()
    assert "No objects are named, for nothing is known of the place." in text and "sphere" in result.run.pictures


@pytest.mark.nightly
def test_pictures_that_are_there_are_not_rendered_again(run, tmp_path, monkeypatch):
    first, rendered = report.render_channels, {}

    def kept(scene, sensor, *rest):
        made = first(scene, sensor, *rest)
        rendered[report.VIEWS[len(rendered)]] = made
        return made

    monkeypatch.setattr(report, "render_channels", kept)
    one = make_report([run / "gaze.safetensors"], tmp_path / "a.html", SMALL).path.read_bytes()
    assert set(rendered) == set(report.VIEWS)

    def never(*_):
        raise AssertionError("rendered again")

    monkeypatch.setattr(report, "render_channels", never)
    two = make_report([run / "gaze.safetensors"], tmp_path / "b.html", SMALL, rendered=rendered).path.read_bytes()
    assert one == two


@pytest.mark.parametrize("name", ["report.pdf", "folder"])
def test_what_cannot_be_written_is_told_first(run, tmp_path, name):
    (tmp_path / "folder").mkdir()
    with pytest.raises(NergError):
        make_report([run], tmp_path / name, SMALL)


def test_damaged_rays_are_a_sentence(run, tmp_path):
    (tmp_path / "rays.npz").write_bytes(b"PK\x03\x04 no")
    with pytest.raises(NergError, match=r"rays\.npz"):
        make_report([run / "gaze.safetensors", tmp_path / "rays.npz"], tmp_path / "a.html", SMALL)
    assert not (tmp_path / "a.html").exists()
