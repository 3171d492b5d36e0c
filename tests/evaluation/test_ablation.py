"""Tests of `nerg_mi.evaluation.ablation`."""

from __future__ import annotations

import csv
import json

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.evaluation import ablation
from nerg_mi.evaluation.ablation import (
    COLUMNS,
    add_relative_losses,
    format_table,
    list_variants,
    make_frame_timer,
    score_density,
    summarise,
    write_ablation,
)
from nerg_mi.maths.geometry import Box
from nerg_mi.train.geometry import TrainingGeometry, load_field_geometry, load_scene_geometry, make_hit_geometry
from tests.formats.splats.writers import random_splats, write_inria
from tests.notes import find_wrong_notes
from tests.plugins import fields
from tests.train.gaze.looks import looking_at

from .gaze_fields import saved

# ---- The ablation: every variant, losses relative to the product, spreads over seeds, files ----


def rows():
    made = (
        ("default", "emit", 0, 2.0),
        ("default", "emit_capture", 0, 1.0),
        ("default", "emit_capture", 1, 1.2),
        ("paper", "emit_capture", 0, 3.0),
    )
    out = [dict(zip(("recipe", "variant", "seed", "test_loss"), row)) for row in made]
    for row in out:
        loss = row["test_loss"]
        row |= {"steps": 5, "train_seconds": 1.0, "test_CC": 0.5, "test_MAE": 0.01, "test_relative": loss / 1.1}
        row |= dict.fromkeys(("train_loss", "test_KLD", "train_relative"), loss)
    return out


def test_variants():
    names = [(v.recipe, v.name) for v in list_variants(True)]
    assert [n for r, n in names if r == "default"] == ["emit", "capture", "emit_capture"]
    paper = [n for r, n in names if r == "paper"]
    assert len(paper) == 10 and "loss code" in paper and sum("semantic" in n for n in paper) == 4
    assert "begins as the field, frozen" in paper
    assert len(list_variants(False)) == 7 and len(list_variants(True, ("small",))) == 10


def test_losses_are_relative_to_the_full_field():
    made = [r for r in rows() if r["recipe"] == "default"] + [{**rows()[0], "recipe": "small"}]
    for r in made:
        r.pop("test_relative"), r.pop("train_relative")
    add_relative_losses(made)
    assert [r.get("test_relative") for r in made] == [pytest.approx(x / 1.1) for x in (2.0, 1.0, 1.2)] + [None]


def test_spreads_are_over_seeds():
    emit, both, paper = summarise(rows())
    assert both["test_loss"] == pytest.approx(1.1)
    assert both["test_loss.spread"] == pytest.approx(np.std([1, 1.2], ddof=1))
    assert "test_loss.spread" not in emit and both["seeds"] == 2 and paper["recipe"] == "paper"
    assert "1.100 ± 0.141" in format_table([emit, both]) and len(format_table([emit, both]).splitlines()) == 4
    assert len({line.count("|") for line in format_table([emit, both]).splitlines()}) == 1


def test_files(tmp_path):
    files = write_ablation(tmp_path, rows(), "notes")
    assert all(f.stat().st_size > 50 for f in files)
    with open(files[1]) as f:
        table = csv.DictReader(f)
        assert list(table.fieldnames or ()) == [*COLUMNS, "note"]
        assert not find_wrong_notes(table)
    summary = json.loads(files[2].read_text())["summary"]
    assert len(summary) == 3 and all("test_loss.spread" in r["note"] for r in summary if r["seeds"] == 1)


def test_the_loss_is_the_papers():
    from types import SimpleNamespace

    rng = np.random.default_rng(0)
    truth, result = rng.random((2, 3, 50)) / 8
    test = SimpleNamespace(truth=truth, centres=None, directions=None, smooth=lambda maps: maps)
    row = score_density({"test": test}, lambda centres, directions: result)
    assert row["test_loss"] == pytest.approx(row["test_KLD"] + 1 - row["test_CC"] + row["test_MAE"])
    assert row["test_MAE"] == pytest.approx(np.abs(truth - result).mean()) and row["test_KLD"] > 0


# ---- The time of a frame, without the first one, which compiles ----

BOX = Box((-1, -1, -1), (1, 1, 1))
CENTRES = np.array([[0.1, 0, 0.2], [-0.2, 0.1, 0]])
ROOM = '<scene version="3.0.0"><shape type="cube"><boolean name="flip_normals" value="true"/></shape></scene>'


@pytest.fixture
def clock(monkeypatch):
    """A clock on which the k-th frame takes k seconds."""
    ticks = iter([t for k in range(1, 20) for t in (100 * k, 101 * k)])
    monkeypatch.setattr(ablation.time, "perf_counter", lambda: next(ticks))


def made(kind, folder):
    if kind == "field":
        fields.radiance(folder / "place.safetensors", density_scale=30.0)
        return load_field_geometry(folder / "place.safetensors", ns)
    if kind == "splats":
        write_inria(folder / "place.ply", random_splats(50))
        return load_field_geometry(folder / "place.ply", ns)
    if kind == "hits":
        return make_hit_geometry(looking_at((1.5, 0.4, 1.2)), folder / "place.vol", 0.2)
    (folder / "room.xml").write_text(ROOM)
    return load_scene_geometry(folder / "room.xml")


@pytest.mark.parametrize("kind", ["field", "splats", "scene", "hits"])
def test_frame_time_excludes_the_first_frame(rgb, tmp_path, clock, kind):
    saved(tmp_path / "gaze.safetensors", "linear", BOX)
    render = make_frame_timer(made(kind, tmp_path), CENTRES, tmp_path, cameras=2, width=8, height=4)
    assert render(tmp_path / "gaze.safetensors") == pytest.approx((2 + 3) / 2)


def test_no_frame_time_without_geometry(tmp_path):
    assert make_frame_timer(TrainingGeometry(None, BOX, "none"), CENTRES, tmp_path) is None
