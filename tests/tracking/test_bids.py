"""Tests of `nerg_mi.tracking.bids`, and of the reader `nerg_mi.tracking.readers.bids` on datasets that it writes."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.tracking.bids import BidsEvents, write_bids
from nerg_mi.tracking.rays import FRAME, Rays
from tests.refusals import mentions
from tests.tracking.readers.examples import read

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


def test_the_coordinate_system_is_described(tmp_path):
    """Gaze in the world is gaze in a picture by the specification; earlier versions wrote rays under this name."""
    write_bids(tmp_path / "set", crowd())
    path = tmp_path / "set" / "task-gaze_physio.json"
    metadata = json.loads(path.read_text())
    assert metadata["SampleCoordinateSystem"] == "custom"
    assert "point in m where it meets a surface" in metadata["SampleCoordinateSystemDescription"]
    assert metadata["WorldCoordinateSystem"]["UpAxis"] == "z" and metadata["x_coordinate"]["Units"] == "m"
    del metadata["SampleCoordinateSystemDescription"]
    path.write_text(json.dumps(metadata | {"SampleCoordinateSystem": "gaze-in-world"}))
    assert_equal(crowd(), read("bids", tmp_path / "set"))


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
