"""All exports have the same fixations, and state their definition with all limits."""

from __future__ import annotations

import csv
import gzip
import importlib.util
import json

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.aoi.settings import Choices, TrackerError
from nerg_mi.formats.ply import write_columns
from nerg_mi.interop.scenes import export_scene
from nerg_mi.reports.data import ParticipantLabels, anonymize_rays
from nerg_mi.tracking.event_settings import FIXATIONS, EventRules
from nerg_mi.tracking.events import label_fixations
from nerg_mi.tracking.rays import Rays
from tests.recorder import Recorder
from tests.surfaces.meshes import box

RULES = EventRules(velocity_threshold=80.0, min_fixation=0.08, merge_gap=0.03)
RATE = 50


@pytest.fixture(scope="module")
def looks() -> Rays:
    """Four participants who look at points of a wall for 0.3 s each, and follow one that moves at 10 degrees/s."""
    rng, all_angles = np.random.default_rng(0), []
    for _ in range(4):
        rests = np.repeat(rng.uniform(-0.3, 0.3, (8, 2)), 15, axis=0) + rng.normal(0, 5e-4, (120, 2))
        pursuit = np.stack([np.radians(np.arange(50) / 5), np.zeros(50)], axis=1)
        all_angles.append(np.concatenate([rests, pursuit]))
    y, z = np.tan(np.concatenate(all_angles)).T
    each = len(y) // 4
    # Each look is from another position.
    eye = np.repeat(rng.uniform((-2, -0.8, -0.3), (0, 0.8, 0.3), (4 * 9, 3)), 4 * [*8 * [15], 50], axis=0)
    directions = np.column_stack([np.ones_like(y), y, z])
    times, names = np.tile(np.arange(each) / RATE, 4), np.repeat(list("abcd"), each)
    return nerg.Rays.from_arrays(eye, directions, times=times, participants=names, tracking="eye")


@pytest.fixture(scope="module")
def reduced(looks) -> Rays:
    return nerg.filter_rays(looks, fixations="ivt", rules=RULES)


def matches(recorded, definition=None) -> bool:
    """Whether ``recorded`` has all entries of the definition."""
    definition = RULES.describe() if definition is None else definition
    return recorded is not None and {k: recorded.get(k) for k in definition} == definition


def test_all_exports_have_the_same_fixations(looks, reduced, tmp_path, rgb):
    label, kinds = label_fixations(looks, RULES)
    assert len(kinds) == 4 * 8 and len(reduced) == (label >= 0).sum() < len(looks)
    nerg.measure_events(looks, rules=RULES).save(tmp_path / "events.csv", tmp_path / "quality.csv")
    for name in ("events.csv", "quality.csv"):
        rows = list(csv.DictReader((tmp_path / name).open()))
        assert all(matches(row, {k: str(v) for k, v in RULES.describe().items()}) for row in rows)
        if name == "events.csv":
            assert sum(row["kind"] in FIXATIONS for row in rows) == len(kinds)
    nerg.export_rays(looks, tmp_path / "bids", rules=RULES)
    (events,) = (tmp_path / "bids").glob("task-*_physioevents.json")
    assert matches(json.loads(events.read_text())["Detection"])
    tables = [gzip.decompress(file.read_bytes()).decode() for file in (tmp_path / "bids").rglob("*events.tsv.gz")]
    assert sum(line.split("\t")[2] in FIXATIONS for text in tables for line in text.splitlines()) == len(kinds)
    recorder = Recorder()
    nerg.filter_rays(looks, fixations="ivt", rules=RULES, progress=recorder)
    assert any(text.startswith(f"{len(kinds)} fixations") for text in recorder.messages)
    averaged = nerg.filter_rays(looks, fixations="ivt", rules=RULES, merge_fixations=True)
    assert len(averaged) == len(kinds) and matches(averaged.metadata["steps"][-1])
    by_dispersion = nerg.filter_rays(looks, fixations="idt", rules=RULES, dispersion_threshold=2.0)
    assert len(by_dispersion) == (label_fixations(looks, RULES, 2.0)[0] >= 0).sum()
    assert matches(by_dispersion.metadata["steps"][-1], RULES.describe(2.0))
    if importlib.util.find_spec("pxr") is not None:
        made = export_scene(looks, tmp_path / "scene.usda", rules=RULES)
        assert sum(len(f.times) for f in made.scene.fixations) == len(kinds)
        assert json.dumps(RULES.describe()) in (tmp_path / "scene.usda").read_text().replace("\\", "")


def test_files_of_fixations_state_the_definition(reduced, tmp_path):
    reduced.save(tmp_path / "rays.npz")
    steps = Rays.load(tmp_path / "rays.npz").metadata["steps"]
    assert matches(steps[-1])
    nerg.export_rays(reduced, tmp_path / "bids", events=False)
    (samples,) = (tmp_path / "bids").glob("task-*_physio.json")
    assert matches(json.loads(samples.read_text())["Fixations"])
    labels = ParticipantLabels(reduced, [])
    assert matches(anonymize_rays(reduced, labels).metadata["steps"][-1])
    (text,) = (value for name, value in nerg.check_rays(reduced).lines if name == "step")
    assert "velocity 80.0" in text and "min_fixation 0.08" in text


def test_numbers_from_fixations_state_the_definition(looks, reduced, tmp_path, rgb):
    areas = {"left": [[1.9, 0, -1], [2, 1, 1]], "right": [[1.9, -1, -1], [2, 0, 1]]}
    error = TrackerError(accuracy=1.0, fixation_part=0.5, draws=2)
    nerg.statistics(reduced, areas, resamples=199, error=error).save(tmp_path / "stats")
    of_file = lambda folder: json.loads((tmp_path / folder / "about.json").read_text())["settings"]
    assert matches(of_file("stats")["fixations"])
    assert matches(of_file("stats")["tracker_fixations"], EventRules().describe())
    choices = Choices(velocity=(70, 90), min_fixation=(0.06, 0.1))
    nerg.robustness(looks, areas, analyses=10, choices=choices).save(tmp_path / "choices")
    drawn = EventRules().describe() | {"velocity": [70, 90], "min_fixation": [0.06, 0.1]}
    assert matches(of_file("choices")["drawn_fixations"], drawn)
    nerg.robustness(reduced, areas, analyses=10, choices=Choices(samples=("all",))).save(tmp_path / "reduced")
    assert matches(of_file("reduced")["fixations"]) and "drawn_fixations" not in of_file("reduced")
    vertices, faces = box((2, -1, -1), (2.1, 1, 1))
    write_columns(tmp_path / "wall.ply", dict(zip("xyz", vertices.T)), faces)
    baked = nerg.bake(tmp_path / "wall.ply", rays=reduced, max_edge=1.0)
    assert matches(baked.summary["provenance"]["settings"]["fixations"])
    gaze = nerg.train_gaze(reduced, "none", test_zones=1, test_positions=2, validation_zones=0, steps=2, min_rays=8)
    assert matches(gaze.provenance["fixations"])
    nerg.evaluate_gaze(gaze, reduced, resamples=2, min_rays=8, directions=64, output=tmp_path / "eval")
    assert matches(json.loads((tmp_path / "eval" / "gaze.json").read_text())["fixations"])
