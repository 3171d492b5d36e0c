"""Tests of `nerg_mi.rays.bids`, and of the reader `nerg_mi.rays.readers.bids` on datasets that it writes."""

from __future__ import annotations

import gzip
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

from nerg_mi.errors import NergError
from nerg_mi.rays.bids import BidsEvents, write_bids
from nerg_mi.rays.rays import FRAME, Rays
from nerg_mi.workflows.rays_commands import RaysExportOptions
from nerg_mi.workflows.rays_export import export_rays
from tests.rays.readers.examples import read
from tests.refusals import mentions
from tests.workflows.recorder import Recorder

FULL = ("t", "origin", "direction", "confidence", "hit", "head")


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def crowd(n: int = 400, seed: int = 0) -> Rays:
    """Participants with odd names, of whom one has two recordings and two cohorts, mixed with each other."""
    rng = np.random.default_rng(seed)
    names = ("Ada L.", "ada-l", "user10", "\N{GREEK SMALL LETTER MU}")
    person = rng.integers(0, len(names), n)
    t = 1.7e9 + np.arange(n) / 60
    t[(person == 2) & (np.arange(n) > n / 2)] += 1000  # a pause: another recording
    hit = rng.normal(size=(n, 3))
    hit[rng.random(n) < 0.3] = np.nan
    return Rays(
        t,
        person,
        names,
        origin=rng.normal(size=(n, 3)),
        direction=unit(rng.normal(size=(n, 3))),
        confidence=rng.random(n),
        hit=hit,
        head=unit(rng.normal(size=(n, 3))),
        cohort=((person == 1) & (np.arange(n) > n / 3)).astype(int),
        cohorts=("before", "after the change"),
        metadata={"frame": dict(FRAME), "floor": "unknown", "place_from_rays": np.diag([2.0, 2, 2, 1]).tolist()},
    )


@pytest.mark.parametrize("kind", ["head", "mixed"])
def test_heads_are_not_exported_as_eyes(tmp_path, kind):
    with pytest.raises(NergError, match="heads"):
        export_rays(crowd().with_tracking(kind), tmp_path / "bids", RaysExportOptions(events=False))
    assert not (tmp_path / "bids").exists()


def test_exports_name_what_was_tracked_and_how_events_were_detected(tmp_path):
    for kind in ("unknown", "eye"):
        recorder = Recorder()
        export_rays(crowd().with_tracking(kind), tmp_path / kind, RaysExportOptions(min_fixation=0.02), recorder)
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


def assert_equal(rays: Rays, again: Rays, atol: float = 1e-6) -> None:
    """The same rays of each participant, in the same order."""
    assert set(again.persons) == {rays.persons[p] for p in np.unique(rays.person)}
    for name in again.persons:
        a, b = (r.select(r.person == r.persons.index(name)) for r in (rays, again))
        for column in FULL:
            first, second = getattr(a, column), getattr(b, column)
            if first is None:
                assert second is None or np.isnan(second).all()
            else:
                np.testing.assert_allclose(second, first, rtol=0, atol=0 if column == "t" else atol)
        if rays.cohort is not None:
            assert [rays.cohorts[c] for c in a.cohort] == [again.cohorts[c] for c in b.cohort]


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


# ---- Round trip ----


def test_round_trip(tmp_path):
    rays = crowd()
    files = write_bids(tmp_path / "set", rays)
    again = read("bids", tmp_path / "set")
    assert_equal(rays, again)
    assert again.metadata["place_from_rays"] == rays.metadata["place_from_rays"]
    assert again.metadata["floor"] == "unknown" and again.metadata["rows_read"] == len(rays)
    assert len(files) == 6 and all(path.is_file() for path in files)
    # One participant, and one recording.
    assert {again.persons[p] for p in read("bids", files[0].parents[1]).person} <= set(again.persons)
    assert len(read("bids", files[0])) == np.sum(rays.person == 0)


def test_rays_without_optional_columns(tmp_path):
    full = crowd(40)
    rays = Rays(full.t, full.person, full.persons, full.origin, full.direction, full.confidence)
    write_bids(tmp_path / "set", rays)
    again = read("bids", tmp_path / "set")
    assert_equal(rays, again)
    assert again.head is None and again.cohort is None and "floor" not in again.metadata


def test_equal_rays_give_equal_bytes(tmp_path):
    contents = []
    for name in ("a", "b"):
        write_bids(tmp_path / name, crowd())
        files = sorted(p for p in (tmp_path / name).rglob("*") if p.is_file())
        contents.append([(p.relative_to(tmp_path / name), p.read_bytes()) for p in files])
    assert contents[0] == contents[1]


def test_runs_are_in_the_order_of_their_numbers(tmp_path):
    n = 24
    t = np.repeat(1000.0 * np.arange(n // 2), 2) + np.tile([0, 0.01], n // 2)
    rays = Rays(t, [0] * n, ("ann",), np.ones((n, 3)), np.tile([1.0, 0, 0], (n, 1)), np.linspace(0, 1, n))
    files = write_bids(tmp_path / "set", rays)
    assert len(files) == n // 2 and "run-12" in files[-1].name
    assert_equal(rays, read("bids", tmp_path / "set"))


def test_refusals(tmp_path):
    rays = crowd(20)
    with pytest.raises(NergError, check=mentions("task")):
        write_bids(tmp_path / "set", rays, task="a b")
    with pytest.raises(NergError, match="no rays"):
        write_bids(tmp_path / "set", rays.select(np.zeros(20, bool)))
    with pytest.raises(NergError, match="two times"):
        write_bids(tmp_path / "set", rays.select([0]))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "a.txt").write_text("a")
    with pytest.raises(NergError, match="not empty"):
        write_bids(tmp_path / "full", rays)
    assert not (tmp_path / "set").exists()


# ---- Events ----


def read_events(folder: Path) -> list[list[str]]:
    return [
        line.split("\t")
        for path in sorted(folder.rglob("*_physioevents.tsv.gz"))
        for line in gzip.decompress(path.read_bytes()).decode().splitlines()
    ]


def test_events_are_in_the_recording_of_their_ray(tmp_path):
    rays = crowd()
    rows = np.flatnonzero(rays.person == 2)[[0, -1]]
    unknown = np.array([np.nan, 1.0])
    events = BidsEvents(rows, rays.t[rows], np.array([0.1, 0.2]), np.array(["a", "b"]), {"x_coordinate": unknown})
    write_bids(tmp_path / "set", rays, events=events)
    paths = sorted((tmp_path / "set").rglob("*_physioevents.tsv.gz"))
    assert [path.name.split("_")[2] for path in paths] == ["run-1", "run-2"]
    cells = read_events(tmp_path / "set")
    assert [row[1:] for row in cells] == [["0.100000", "a", "n/a"], ["0.200000", "b", "1.000000"]]
    assert [float(row[0]) for row in cells] == rays.t[rows].tolist()


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
    result = export_rays(rays, tmp_path / "set", RaysExportOptions(aois=areas))
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
    export_rays(rays, tmp_path / "plain", RaysExportOptions(events=False))
    assert read_events(tmp_path / "plain") == []


@pytest.mark.parametrize("options", [{"pursuit_angle": -1.0}, {"align": Path("a.json")}])
def test_wrong_options(options):
    with pytest.raises(NergError, check=mentions(*options)):
        RaysExportOptions(**options)


# ---- The validator ----


def test_valid(watched, tmp_path):
    rays, areas = watched
    export_rays(rays, tmp_path / "a", RaysExportOptions(aois=areas))
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
