"""Partitioned statistics: tables equal those of a single process, and only changed parts are recomputed."""

from __future__ import annotations

import json
from dataclasses import fields as dataclass_fields
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.aoi import measured
from nerg_mi.aoi.settings import AoiSampling, TrackerError
from nerg_mi.aoi.statistics import statistics
from nerg_mi.aoi.statistics_parts import (
    ObserverPoses,
    PlannedAreas,
    PlannedPrediction,
    _geometry_files,
    predict_part,
    read_prediction,
    read_sums,
    write_sums,
)
from nerg_mi.aoi.visits import ALL, Cell, VisitSums
from nerg_mi.environment.planned import PlannedFiles
from nerg_mi.files.atomic import file_sha256
from nerg_mi.formats.fields import save_gaze
from nerg_mi.tasks.jobs import report_jobs
from nerg_mi.tasks.settings import Parallel
from nerg_mi.tasks.task import FileGroup
from tests.aoi.place import people, write_place
from tests.conftest import ROOT
from tests.plugins import fields
from tests.recorder import Recorder
from tests.tasks.works import lay_out
from tests.tracking.dataset.making import DAY, recipe, update_dataset, write_dataset, write_source

FAST = {"resamples": 199, "viewpoints": 40, "show_names": True}
SAMPLING = AoiSampling(directions=128, aoi_samples=6)


@pytest.fixture(autouse=True)
def engine(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    # Blocks of about one participant.
    monkeypatch.setattr(measured.iter_blocks, "__defaults__", (100,))


@pytest.fixture
def place(tmp_path, rgb):
    write_place(tmp_path)
    people().save(tmp_path / "rays.npz")
    return tmp_path


def count(place, folder, rays="rays.npz", sampling=SAMPLING, **changes):
    recorder = Recorder()
    options = {**FAST, "sampling": sampling, "progress": recorder, **changes}
    statistics([place / "scene.xml", place / rays], place / "areas.json", **options).save(place / folder)
    return {p.name: p.read_bytes() for p in (place / folder).iterdir()}, recorder


def made(recorder):
    """Return the numbers of computed parts of samples and of viewpoints."""
    result = []
    for _, text in recorder.steps:
        if " parts" in text:
            done, total = int(text.split()[0]), int(text.split()[2])
            if not result or result[-1][0] != total:
                result.append([total, done, done])
            result[-1][2] = done
    return [last - first for _, first, last in result]


@pytest.mark.nightly
def test_parallel_tables_equal_serial_tables(place):
    (place / "poster.obj").write_text("v 5 1 1\nv 5 2 1\nv 5 1 2\nf 1 2 3\n")
    changes = {"move": [{"shape": "stand", "by": [0, 1.9, 0]}], "add": [{"name": "poster", "mesh": "poster.obj"}]}
    (place / "changes.json").write_text(json.dumps(changes | {"shift": [0, 0, 0.1]}))
    requested = {
        "aoi_visibility": True,
        "sampling": replace(SAMPLING, cell_size=0.5),
        "windows": {"early": (0, 8)},
        "what_if": place / "changes.json",
    }
    whole_result, _ = count(place, "one", **requested)
    parts, texts = count(place, "two", **requested, parallel=Parallel(store=place / "two.tasks", scheduler="local:2"))
    assert parts == whole_result and {
        "aois.csv",
        "transitions.csv",
        "participants.csv",
        "what_if.csv",
        "about.json",
    } <= set(whole_result)
    assert b"poster" in whole_result["what_if.csv"]
    account = report_jobs(place / "two.tasks", progress=texts)
    assert [(job.name.partition(" /")[0], job.remaining) for job in account.jobs] == [("nerg stats", 0)] * 3
    assert sorted(job.total for job in account.jobs) == [2, 2, 6]
    assert len(account.jobs[0].changed) == 0


def test_parts_add_the_same_errors(place):
    options = {"error": TrackerError(accuracy=2.0, precision=0.5, draws=2)}
    whole, _ = count(place, "one", **options)
    parts, _ = count(place, "two", **options, parallel=Parallel(store=place / "store"))
    assert parts == whole and "tracker.csv" in parts


def test_only_changed_parts_are_recomputed(place):
    parts = lambda **changes: count(place, "out", parallel=Parallel(store=place / "store"), **changes)[1]
    assert made(parts()) == [6, 2] and made(parts()) == [0, 0]
    # Each part depends on the settings of its own work.
    assert made(parts(sampling=replace(SAMPLING, tolerance=1.0, glance_duration=0.5))) == [6, 0]
    assert made(parts(sampling=replace(SAMPLING, directions=256))) == [0, 2]
    # One participant's samples are rotated; viewpoints do not change.
    rays = people()
    turned = np.where((rays.person == 3)[:, None], rays.direction * (-1, -1, 1), rays.direction)
    replace(rays, direction=turned).save(place / "rays.npz")
    assert made(parts())[0] == 1
    # A changed area affects all parts.
    (place / "areas.json").write_text((place / "areas.json").read_text().replace("1.5", "1.6"))
    assert made(parts()) == [6, 2]


def test_dataset_parts_are_read_in_place(place):
    pytest.importorskip("pyarrow")
    write_dataset(place, 2)
    whole_result, _ = count(place, "one", "shop.rays")
    parts, texts = count(place, "two", "shop.rays", parallel=Parallel(store=place / "store"))
    assert parts == whole_result and made(texts)[0] > 3 and not list((place / "store").glob(".scratch-*"))
    # Only the parts of the other source are new.
    write_source(place / "files" / "2.csv", 2, start=DAY)
    update_dataset(place / "shop.rays", [place / "files" / "2.csv"], recipe())
    _, options = count(place, "two", "shop.rays", parallel=Parallel(store=place / "store"))
    assert 0 < made(options)[0] < made(texts)[0]


def test_sums_are_stored_per_block(tmp_path):
    cells = (ALL, Cell("window", "früh"))
    one = VisitSums.empty(("a", "b"), cells, [(cells[0], "p"), (cells[1], "p"), (cells[0], "q")])
    one.time[:] = (0.1, 1 / 3, 7)
    two = replace(one, time=one.time * 2, transitions=one.transitions + 1)
    write_sums(tmp_path / "s.npz", [one, two])
    for back, sums in zip(read_sums(tmp_path / "s.npz"), (one, two), strict=True):
        for f in dataclass_fields(VisitSums):
            assert np.array_equal(getattr(back, f.name), getattr(sums, f.name)), f.name


def test_prediction_from_copied_files(place, tmp_path):
    file, sampling = place / "areas.json", AoiSampling(aoi_samples=4, directions=64)
    scene = PlannedFiles.plan(place / "scene.xml")
    areas = PlannedAreas(scene, None, FileGroup(file, (file,)), None, sampling, "llvm_ad_rgb")
    common = lay_out(PlannedPrediction(areas, 120.0), tmp_path / "there")
    places = ObserverPoses(np.array([[1.0, 2, 1.6]] * 2), np.array([[1.0, 0, 0], [-1.0, 0, 0]]))
    predict_part(common, places, tmp_path / "f.npz")
    result = read_prediction(tmp_path / "f.npz")
    assert result.share.shape == (2, 3) and np.array_equal(result.share[0], result.share[1])
    assert result.visible[0].any() and not result.visible[1].any()


def test_gaze_field_includes_its_training_geometry(tmp_path, rgb):
    field, (room, gaze) = fields.gaze(tmp_path / "g.safetensors"), (tmp_path / n for n in ("r.vol", "a.safetensors"))
    room.write_bytes(b"voxels")
    save_gaze(field, gaze, {"geometry_file": {"file": "r.vol", "sha256": file_sha256(room)}})
    assert _geometry_files(gaze) == [room]
    save_gaze(field, gaze, {"geometry": "none"})
    assert _geometry_files(gaze) == []
