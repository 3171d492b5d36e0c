"""Partitioned statistics: tables equal those of a single process, and only changed parts are recomputed."""

from __future__ import annotations

import json
from dataclasses import fields as dataclass_fields
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.aoi import measured
from nerg_mi.aoi.measured import AoiContext, TimeWindow, ViewpointSampler, count_block, facing_directions, iter_blocks
from nerg_mi.aoi.options import PredictionOptions, StatisticsOptions
from nerg_mi.aoi.scene import GazeScene
from nerg_mi.errors import NergError
from nerg_mi.files.atomic import file_sha256
from nerg_mi.formats.areas import Region
from nerg_mi.formats.fields import save_gaze
from nerg_mi.maths.geometry import Similarity
from nerg_mi.measures.visits import ALL, BoxAoi, Cell, VisitRules, VisitSums, merge_sums
from nerg_mi.rays.rays import Rays
from nerg_mi.tasks.task import FileGroup
from nerg_mi.workflows.parts import PlannedScene, account_for_store
from nerg_mi.workflows.statistics import statistics
from nerg_mi.workflows.statistics_parts import (
    ObserverPoses,
    PlannedAoiScene,
    PlannedPrediction,
    _geometry_files,
    predict_part,
    read_prediction,
    read_sums,
    write_sums,
)
from tests.aoi.place import SIGN, STAND, people, write_place
from tests.conftest import ROOT
from tests.plugins import fields
from tests.rays.dataset.making import DAY, recipe, update_dataset, write_dataset, write_source
from tests.tasks.works import lay_out
from tests.workflows.recorder import Recorder

FAST = {
    "resamples": 199,
    "viewpoints": 40,
    "directions": 128,
    "aoi_samples": 6,
    "show_names": True,
    "mode": "llvm_ad_rgb",
}


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


def count(place, folder, rays="rays.npz", **changes):
    recorder = Recorder()
    options = StatisticsOptions(aois=place / "areas.json", **{**FAST, **changes})
    statistics([place / "scene.xml", place / rays], place / folder, options, recorder)
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
    requested = {"aoi_visibility": True, "cell_size": 0.5, "windows": ("early=0,8",), "what_if": place / "changes.json"}
    whole_result, _ = count(place, "one", **requested)
    parts, texts = count(place, "two", **requested, scheduler="local:2")
    assert parts == whole_result and {
        "aois.csv",
        "transitions.csv",
        "participants.csv",
        "what_if.csv",
        "about.json",
    } <= set(whole_result)
    assert b"poster" in whole_result["what_if.csv"]
    account = account_for_store(place / "two.tasks", reporter=texts)
    assert [(job.name.partition(" /")[0], job.remaining) for job in account.jobs] == [("nerg stats", 0)] * 3
    assert sorted(job.total for job in account.jobs) == [2, 2, 6]
    assert len(account.jobs[0].changed) == 0


def test_only_changed_parts_are_recomputed(place):
    parts = lambda: count(place, "out", store=place / "store")[1]
    assert made(parts()) == [6, 2] and made(parts()) == [0, 0]
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
    parts, texts = count(place, "two", "shop.rays", store=place / "store")
    assert parts == whole_result and made(texts)[0] > 3 and not list((place / "store").glob(".scratch-*"))
    # Only the parts of the other source are new.
    write_source(place / "files" / "2.csv", 2, start=DAY)
    update_dataset(place / "shop.rays", [place / "files" / "2.csv"], recipe())
    _, options = count(place, "two", "shop.rays", store=place / "store")
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
    options = PredictionOptions(aois=place / "areas.json", aoi_samples=4, directions=64, mode="llvm_ad_rgb")
    areas = FileGroup(options.aois, (options.aois,))
    setting = PlannedAoiScene(options, PlannedScene.plan(place / "scene.xml"), None, None, areas)
    common = lay_out(PlannedPrediction(setting, 120.0), tmp_path / "there")
    places = ObserverPoses(np.array([[1.0, 2, 1.6]] * 2), np.array([[1.0, 0, 0], [-1.0, 0, 0]]))
    predict_part(common, places, tmp_path / "f.npz")
    result = read_prediction(tmp_path / "f.npz")
    assert result.share.shape == (2, 3) and np.array_equal(result.share[0], result.share[1])
    assert result.visible[0].any() and not result.visible[1].any()


def test_gaze_field_includes_its_training_geometry(tmp_path, rgb):
    field, (room, gaze) = fields.gaze(tmp_path / "g.safetensors"), (tmp_path / n for n in ("r.vol", "a.safetensors"))
    room.write_bytes(b"voxels")
    save_gaze(field, gaze, {"geometry_file": {"file": "r.vol", "sha256": file_sha256(room)}})
    assert _geometry_files(gaze, None) == [room]
    save_gaze(field, gaze, {"geometry": "none"})
    assert _geometry_files(gaze, None) == []
    save_gaze(field, gaze, {"field_file": {"file": "r.safetensors", "sha256": "0"}})
    assert _geometry_files(gaze, tmp_path / "elsewhere.safetensors") == []


# ---- Blocks and hits ----

RULES = VisitRules()


def counting(**changes):
    aois = [BoxAoi(Region.create("sign", *SIGN)), BoxAoi(Region.create("stand", *STAND))]
    around = GazeScene(None, None, Similarity())
    made = AoiContext(around, aois, ("sign", "stand", "both"), [(0,), (1,), (0, 1)], (0, 1), RULES, 0.0)
    return replace(made, **changes)


def test_blocks_contain_whole_sessions_and_all_samples():
    rays = people(7, 60)
    # Two sessions per participant, separated by a pause of two minutes.
    rays = replace(rays, t=rays.t + 120.0 * (rays.t >= 6))
    whole_result = merge_sums([count_block(rays, counting())])
    for max_count in (1, 50, 100, 10_000):
        blocks = list(iter_blocks(rays, RULES, max_count))
        assert sum(len(b) for b in blocks) == len(rays)
        if max_count == 1:
            assert [len(b) for b in blocks] == [30] * 14
        for b in blocks:
            assert not (np.diff(b.person) < 0).any()
        result = merge_sums(count_block(b, counting()) for b in blocks)
        for name in ("time", "dwell_time", "visits", "first_visit_sum", "transitions", "sessions"):
            assert np.allclose(getattr(result, name), getattr(whole_result, name)), name


def test_session_across_dataset_parts_is_one_session(tmp_path):
    pytest.importorskip("pyarrow")
    import nerg_mi as nerg
    from nerg_mi.rays import dataset, dataset_write

    rays = people(3, 80, cohorts=False)
    lines = ["t,p,x,y,z,a,b,c"]
    for k in range(len(rays)):
        numbers = [*rays.origin[k].astype(np.float32).tolist(), *rays.direction[k].tolist()]
        lines.append(",".join([repr(float(rays.t[k])), rays.persons[rays.person[k]], *map(repr, numbers)]))
    (tmp_path / "day.csv").write_text("\n".join(lines))
    columns = "origin=x,y,z direction=a,b,c t=t person=p"
    result = {}
    for rows in (50, dataset_write.PART_ROWS):
        before = dataset_write.PART_ROWS
        dataset_write.PART_ROWS = rows
        try:
            name = tmp_path / f"{rows}.rays"
            nerg.import_rays(tmp_path / "day.csv", columns=columns, output=name)
        finally:
            dataset_write.PART_ROWS = before
        result[rows] = merge_sums(count_block(b, counting()) for b in iter_blocks(name, RULES))
        if rows == 50:
            assert len(dataset.RayDataset.open(name).parts) > 4 and dataset and dataset
    a, b = result.values()
    for name in ("time", "dwell_time", "visits", "first_visit_sum", "sessions"):
        order = [a.rows.index(row) for row in b.rows]
        assert np.allclose(getattr(a, name)[order], getattr(b, name)), name
    assert a.sessions.sum() == 3


def test_missing_samples_are_refused():
    with pytest.raises(NergError, match="no gaze samples"):
        list(iter_blocks(people().select(np.zeros(0, int)), RULES))


def test_angular_tolerance_counts_near_misses():
    o = np.tile([1.0, 3.0, 1.5], (3, 1))
    # The nearest edge of the sign is at y = 2.5, x = 4.2.
    edge = np.arctan2(-0.5, 3.2)
    angles = edge + np.radians([0.5, 1.9, 2.5])
    d = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])
    rays = Rays(np.arange(3.0), np.zeros(3, int), ("a",), o, d, np.ones(3))
    assert [len(rows) for rows in counting().assign_hits(rays).rows] == [0, 0, 0]
    assert counting(tolerance=2.0).assign_hits(rays).rows[0].tolist() == [0, 1]


def test_samples_in_another_frame():
    align = np.diag([2.0, 2, 2, 1])
    align[:3, 3] = 1, 2, 3
    around = GazeScene(None, None, Similarity(align))
    moved = [BoxAoi(Region.create(n, *(2 * c + (1, 2, 3)))) for n, c in (("sign", SIGN), ("stand", STAND))]
    rays = people()
    one, two = counting().assign_hits(rays), counting(gaze_scene=around, aois=moved).assign_hits(rays)
    for a, b in zip(one.rows, two.rows):
        assert a.tolist() == b.tolist()
    for a, b in zip(one.distance, two.distance):
        # In metres.
        assert np.allclose(a, b)


def test_cell_masks():
    rays = people()
    made = counting(
        windows=[TimeWindow("w", 1.0, 2.0)],
        zones=[Region.create("z", [0, 0, 9], [1, 4, 9.1])],
        cohort_names=("even", "x"),
    )
    cells = dict(made.cell_masks(rays, rays.origin))
    assert cells[ALL] is None and not cells[Cell("cohort", "x")].any()
    assert np.array_equal(cells[Cell("cohort", "even")], rays.person % 2 == 0)
    assert np.array_equal(cells[Cell("window", "w")], (rays.t >= 1) & (rays.t < 2))
    # Zones ignore the height.
    assert np.array_equal(cells[Cell("zone", "z")], rays.origin[:, 0] <= 1)


def test_facing_directions_are_head_directions():
    rays = people(2, 3)
    head = np.tile(np.array([0, 1, 0], np.float32), (6, 1))
    head[0] = np.nan
    result = facing_directions(replace(rays, head=head))
    assert np.array_equal(result[0], rays.direction[0]) and np.allclose(result[1:], [0, 1, 0])
    assert facing_directions(rays) is rays.direction


def test_viewpoints_cover_all_participants():
    picker = ViewpointSampler(100)
    for block in iter_blocks(people(5, 80), RULES, 100):
        picker.add(block, counting())
    observers = picker.viewpoints()
    assert set(observers.participants) == {f"name {k}" for k in range(5)} and 5 <= len(observers.participants) <= 10
    assert all(ALL in cells for cells in observers.cells) and observers.positions.shape == observers.facing.shape
