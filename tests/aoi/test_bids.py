"""Tests of `nerg_mi.aoi.bids`."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.aoi.bids import export_rays
from nerg_mi.errors import NergError
from nerg_mi.tracking.bids import write_bids
from nerg_mi.tracking.event_settings import EventRules
from nerg_mi.tracking.rays import Rays
from tests.recorder import Recorder
from tests.refusals import mentions
from tests.tracking.readers.examples import read
from tests.tracking.test_bids import assert_equal, crowd, read_events, unit


@pytest.mark.parametrize("kind", ["head", "mixed"])
def test_heads_are_not_exported_as_eyes(tmp_path, kind):
    with pytest.raises(NergError, match="heads"):
        export_rays(crowd().with_tracking(kind), tmp_path / "bids", events=False)
    assert not (tmp_path / "bids").exists()


def test_exports_name_what_was_tracked_and_how_events_were_detected(tmp_path):
    for kind in ("unknown", "eye"):
        recorder = Recorder()
        rays, rules = crowd().with_tracking(kind), EventRules(min_fixation=0.02)
        export_rays(rays, tmp_path / kind, rules=rules, progress=recorder)
        assert json.loads((tmp_path / kind / "task-gaze_physio.json").read_text())["Tracking"] == kind
        assert any("heads" in text for text in recorder.warnings) == (kind == "unknown")
        assert read("bids", tmp_path / kind).tracking == kind
    detection = json.loads((tmp_path / "eye" / "task-gaze_physioevents.json").read_text())["Detection"]
    assert detection["min_fixation"] == pytest.approx(0.02) and detection["velocity"] == pytest.approx(100)


def test_the_rate_of_times_in_milliseconds(tmp_path):
    rays = crowd()
    t = np.floor(np.arange(300) / 60 * 1000) / 1000
    t[150:] += 0.5  # a gap, which is no interval between samples
    one = replace(rays.select(slice(300)), t=t, person=np.zeros(300, int), cohort=None, cohorts=())
    export_rays(one, tmp_path / "bids")
    (path,) = (tmp_path / "bids").rglob("sub-*_physio.json")
    assert json.loads(path.read_text())["SamplingFrequency"] == pytest.approx(60, rel=1e-3)


# ---- Events and visits ----


@pytest.fixture
def watched(tmp_path) -> tuple[Rays, Path]:
    """Somebody who looks at two boxes in turn for a second each, and the file of these areas."""
    n = 300
    t = np.arange(n) / 50
    target = np.where((np.floor(t) % 2 == 0)[:, None], [2.0, 0.0, 1.0], [0.0, 2.0, 1.0])
    origin = np.tile([0.0, 0.0, 1.6], (n, 1))
    rays = Rays(t, [0] * n, ("ann",), origin, unit(target - origin), np.ones(n), hit=target)
    boxes = [{"name": name, "min": low, "max": high} for name, low, high in BOXES]
    (tmp_path / "areas.json").write_text(json.dumps({"regions": boxes}))
    return rays, tmp_path / "areas.json"


BOXES = [("shelf", [1.5, -0.5, 0.5], [2.5, 0.5, 1.5]), ("till", [-0.5, 1.5, 0.5], [0.5, 2.5, 1.5])]


def test_export_with_events_and_visits(watched, tmp_path):
    rays, areas = watched
    result = export_rays(rays, tmp_path / "set", aois=areas)
    assert result.events == {"visit": 6, "fixation": 6, "saccade": 5}
    meta = json.loads((tmp_path / "set" / "task-gaze_physioevents.json").read_text())
    rows = [dict(zip(meta["Columns"], cells)) for cells in read_events(tmp_path / "set")]
    visits = [row for row in rows if row["trial_type"] == "visit"]
    assert [row["area"] for row in visits] == ["shelf", "till"] * 3
    assert [float(row["onset"]) for row in visits] == [0, 1, 2, 3, 4, 5]
    fixations = [row for row in rows if row["trial_type"] == "fixation"]
    assert [round(float(row["x_coordinate"])) for row in fixations] == [2, 0] * 3
    assert np.allclose([float(row["duration"]) for row in fixations], 0.98)
    saccades = [row for row in rows if row["trial_type"] == "saccade"]
    assert len({row["amplitude"] for row in saccades}) == 1 and saccades[0]["x_coordinate"] == "n/a"
    assert set(meta["trial_type"]["Levels"]) == {"fixation", "saccade", "visit"}
    assert_equal(rays, read("bids", tmp_path / "set"))
    export_rays(rays, tmp_path / "plain", events=False)
    assert read_events(tmp_path / "plain") == []


def test_alignments_need_areas(tmp_path):
    with pytest.raises(NergError, check=mentions("align", "aois")):
        export_rays(crowd(), tmp_path / "set", align="a.json")


# ---- The validator ----


def find_validator() -> str | None:
    """The validator of the extra `bids`, next to the interpreter or on the path."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    return shutil.which("bids-validator-deno", path=path)


def find_errors(folder: Path) -> list[str]:
    """What the validator of BIDS refuses in all rows, by the schema that it contains."""
    validator = find_validator()
    if validator is None:
        pytest.skip("bids-validator-deno is not installed (extra bids)")
    # Its runtime, Deno, refuses folders below /dev, such as those of tests in memory.
    with tempfile.TemporaryDirectory() as copy:
        shutil.copytree(folder, copy, dirs_exist_ok=True)
        command = [validator, copy, "--format", "json", "--max-rows", "-1"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.stdout, done.stderr
    issues = json.loads(done.stdout)["issues"]["issues"]
    return [f"{i['code']} {i.get('location')} {i.get('issueMessage')}" for i in issues if i["severity"] == "error"]


def test_valid(watched, tmp_path):
    rays, areas = watched
    export_rays(rays, tmp_path / "a", aois=areas)
    write_bids(tmp_path / "b", crowd())
    assert find_errors(tmp_path / "a") == [] and find_errors(tmp_path / "b") == []
    # The validator sees these files: without the recorded eye, they are invalid.
    path = tmp_path / "b" / "task-gaze_physio.json"
    path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k != "RecordedEye"}))
    assert any("RecordedEye" in error or "SIDECAR" in error for error in find_errors(tmp_path / "b"))


@pytest.mark.nightly
@pytest.mark.parametrize(
    "preset, folder, pattern",
    [
        ("vr_supermarket", "vr_supermarket", "*.csv.gz"),
        ("eyenavgs", "eyenavgs", "room/*.csv.gz"),
        ("aria", "aria", "gen1/mps_sample"),
        ("aria", "aria", "adt"),
    ],
)
def test_recordings(recorded, tmp_path, preset, folder, pattern):
    rays = read(preset, *sorted(recorded(folder).glob(pattern)))
    export_rays(rays, tmp_path / "set")
    assert_equal(rays, read("bids", tmp_path / "set"))
    assert find_errors(tmp_path / "set") == []
