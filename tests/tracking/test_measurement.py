"""Tests of `nerg_mi.tracking.measurement`."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.tracking.event_settings import EventRules
from nerg_mi.tracking.measurement import measure_events
from nerg_mi.tracking.quality import GazeTarget
from nerg_mi.tracking.rays import Rays
from tests.notes import find_wrong_notes
from tests.recorder import Recorder
from tests.tracking.people import some_rays


@pytest.fixture
def looks() -> Rays:
    """Two participants at 100 Hz, each of whom looks along x for half a second, and then along y."""
    n = 100
    along_x = np.arange(n) < n // 2
    d = np.where(along_x[:, None], [1.0, 0, 0], [0, 1.0, 0])
    point = np.where(along_x[:, None], [2.0, 0, 0], [0, 3.0, 0])
    t = np.arange(n) / 100
    person = np.r_[np.zeros(n), np.ones(n)]
    return some_rays(2 * n, t=np.r_[t, t], person=person, direction=np.r_[d, d], hit=np.r_[point, point])


@pytest.mark.parametrize("person", ["person", "participant", "Participant ID"])
def test_tables(looks, tmp_path, person):
    looks.save(tmp_path / "rays.npz")
    (tmp_path / "targets.csv").write_text(f"start,end,x,y,z,{person}\n0,0.4,2,0,0,ann\n0.6,1,0,1,1,\n")
    reporter = Recorder()
    result = measure_events(tmp_path / "rays.npz", targets=tmp_path / "targets.csv", progress=reporter)
    result.save(tmp_path / "events.csv", tmp_path / "quality.csv")
    with open(tmp_path / "events.csv") as file:
        rows = list(csv.DictReader(file))
    assert [row["kind"] for row in rows] == ["fixation", "saccade", "fixation"] * 2
    assert [row["participant"] for row in rows] == ["ann"] * 3 + ["bo"] * 3
    assert float(rows[1]["amplitude"]) == pytest.approx(90) and float(rows[1]["onset"]) == pytest.approx(0.49)
    assert [float(rows[2][f"{name}_y"]) for name in ("direction", "point")] == pytest.approx([1, 3])
    assert rows[1]["direction_x"] == "" and not find_wrong_notes(rows)
    assert {name: rows[0][name] for name in ("velocity", "min_fixation")} == {
        "velocity": "100.0",
        "min_fixation": "0.06",
    }
    with open(tmp_path / "quality.csv") as file:
        first, second = csv.DictReader(file)
    assert not find_wrong_notes([first, second]) and first["algorithm"] == rows[0]["algorithm"]
    # One target is met, the other one is 45 degrees above; bo has the second one only.
    assert (first["targets"], second["targets"]) == ("2", "1")
    assert float(first["accuracy"]) == pytest.approx(22.5) and float(second["accuracy"]) == pytest.approx(45)
    assert float(first["effective_frequency"]) == pytest.approx(100) and float(first["rms_s2s"]) == pytest.approx(0)
    assert any("4 fixation" in message for message in reporter.messages)


def test_data_frames(looks):
    pytest.importorskip("pandas")
    result = measure_events(looks.with_tracking("eye"), targets=[GazeTarget(0, 0.4, (2, 0, 0), "ann")])
    events, quality = result.to_dataframe("pandas"), result.quality_to_dataframe("pandas")
    assert list(events["kind"]) == ["fixation", "saccade", "fixation"] * 2 and list(events)[-1] == "point_z"
    assert list(events["participant"]) == ["ann"] * 3 + ["bo"] * 3 and events["direction_y"][2] == pytest.approx(1)
    assert list(quality["participant"]) == ["ann", "bo"] and list(quality["targets"]) == [1, 0]


def test_rules_are_used(looks):
    rules = EventRules(velocity_threshold=10_000.0)
    assert "saccade" not in measure_events(looks.with_tracking("eye"), rules=rules).events.count()


def test_tables_state_their_definition_and_missing_values(looks, tmp_path):
    """Without hit points, without targets, with a pause, and one participant with a single sample."""
    one = looks.select((looks.person == 0) | (looks.t == 0))
    rays = replace(one.select((one.t < 0.2) | (one.t > 0.3)), hit=None).with_tracking("eye")
    rays.save(tmp_path / "rays.npz")
    rules, recorder = EventRules(velocity_threshold=80.0, min_fixation=0.05), Recorder()
    result = measure_events(tmp_path / "rays.npz", rules=rules, progress=recorder)
    result.save(tmp_path / "events.csv", tmp_path / "quality.csv")
    with open(tmp_path / "events.csv") as file:
        rows = list(csv.DictReader(file))
    definition = rules.describe()
    assert all({name: row[name] for name in definition} == {k: str(v) for k, v in definition.items()} for row in rows)
    assert rows and not find_wrong_notes(rows) and not recorder.warnings
    notes = {row["kind"]: row["note"] for row in rows}
    assert "hit" in notes["fixation"] and "peak_velocity" in notes["blink"] and "pursuits" in notes["saccade"]
    with open(tmp_path / "quality.csv") as file:
        quality = list(csv.DictReader(file))
    assert not find_wrong_notes(quality) and "accuracy" in quality[0]["note"] and "frequency" in quality[1]["note"]
    assert all(row["velocity"] == "80.0" for row in quality)


@pytest.mark.parametrize("tracking", ["unknown", "eye"])
def test_rays_of_unknown_tracking_are_reported_once(looks, tracking):
    recorder = Recorder()
    measure_events(looks.with_tracking(tracking), progress=recorder)
    assert [("heads" in text) for text in recorder.warnings] == ([True] if tracking == "unknown" else [])


def test_slow_samples_are_reported(looks):
    slow = some_rays(20, t=0.5 * np.arange(20))
    slow, reporter = slow.with_tracking("eye"), Recorder()
    assert not measure_events(slow, progress=reporter).events.count()
    assert any("max_step" in warning for warning in reporter.warnings)
    reporter = Recorder()
    assert set(measure_events(slow, rules=EventRules(max_step=1.0), progress=reporter).events.count()) == {"fixation"}
    assert not reporter.warnings


@pytest.mark.parametrize(
    "text, message",
    [
        ("start,end,x,y,z\n", "no targets"),
        ("start,end,x,y\n0,1,2,3\n", "column z"),
        ("start,end,x,y,z\n0,1,2,3,\n", "line 2"),
        ("start,end,x,y,z\n2,1,2,3,4\n", "line 2"),
        ("start,end,x,y,z,person\n0,1,2,3,4,zoe\n", "zoe"),
    ],
)
def test_wrong_targets_are_refused(looks, tmp_path, text, message):
    (tmp_path / "targets.csv").write_text(text)
    with pytest.raises(NergError, match=message):
        measure_events(looks, targets=tmp_path / "targets.csv")
