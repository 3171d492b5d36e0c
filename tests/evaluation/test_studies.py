"""Studies and alignments."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.alignment import align as alignment
from nerg_mi.alignment import profile
from nerg_mi.alignment.align import align
from nerg_mi.alignment.check import AlignmentCheck
from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError
from nerg_mi.maths.geometry import Box
from nerg_mi.train import gaze as training
from nerg_mi.train.gaze import check_environment, train_gaze
from tests.alignment import rooms
from tests.recorder import Recorder
from tests.refusals import mentions

# ---- The alignment as a job: evidence, refused input and output files ----


RAYS = rooms.people(300)


def pairs(folder, noise=0.0, mirror=1.0):
    rng = np.random.default_rng(0)
    truth, x = rooms.similarity(rng, scale=2.0), rng.uniform(0, 4, (6, 3))
    y = rooms.carried(truth, x + rng.normal(0, noise, x.shape))
    rows = np.c_[x * (mirror, 1, 1), y].tolist()
    path = folder / "pairs.csv"
    path.write_text("x,y,z,place_x,place_y,place_z\n" + "".join(",".join(map(str, r)) + "\n" for r in rows))
    return truth, path


def test_an_alignment_is_written_with_its_figure(tmp_path):
    truth, path = pairs(tmp_path)
    reporter = Recorder()
    result = align(pairs=path, output=tmp_path / "a.json", progress=reporter)
    np.testing.assert_allclose(result.matrix, truth, atol=1e-6)
    metadata = json.loads((tmp_path / "a.json").read_text())
    assert metadata["files"]["pairs"]["file"] == "pairs.csv" and metadata["forced"] is False
    assert (tmp_path / "a.png").is_file() and "align" in reporter.messages[-1]


def test_bad_and_mirrored_fits_are_refused_unless_forced(tmp_path):
    _, path = pairs(tmp_path, noise=0.5)
    with pytest.raises(NergError, match=r"give other evidence, or a larger limit; or add"):
        align(pairs=path, output=tmp_path / "a.json")
    assert not (tmp_path / "a.json").exists()
    assert align(pairs=path, output=tmp_path / "a.json", force=True).forced
    _, path = pairs(tmp_path, mirror=-1)
    with pytest.raises(NergError, check=lambda error: error.kind == "mirrored" and mentions("handedness")(error)):
        align(pairs=path)


@pytest.mark.parametrize(
    "options, rays, why",
    [
        ({}, None, "or add pairs=FILE, tracking_surface=FILE,"),
        ({}, RAYS, "no scene is given: add environment=FILE, or surface"),
        ({"tracking_cameras": "a"}, None, "tracking_cameras and scene_cameras must be"),
        ({"pairs": "a", "tracking_surface": "b"}, None, "are alternatives"),
        ({"pairs": "a", "init": "b"}, None, "are alternatives"),
        ({"pairs": "PAIRS", "refine": True}, None, "refine=True needs the tracking"),
        ({"pairs": "PAIRS", "up": "north"}, None, "up must be comma-separated numbers, got"),
        ({"pairs": "PAIRS", "up": "0,0,0"}, None, "or three numbers x,y,z that are not all"),
        ({"pairs": "PAIRS", "scale": -1.0}, None, "scale must lie in"),
        ({"pairs": "PAIRS", "environment": "a", "surface": "b"}, None, "only one scene can be given: use environment"),
    ],
)
def test_contradictory_options_are_refused(tmp_path, options, rays, why):
    _, path = pairs(tmp_path)
    settings = {k: path if v == "PAIRS" else v for k, v in options.items()}
    with pytest.raises(NergError, match=why):
        align(rays, **settings)


def test_up_axis_and_initial_alignment_give_the_same_frame(tmp_path, monkeypatch):
    truth, path = pairs(tmp_path)
    np.save(tmp_path / "points.npy", rooms.carried(truth, rooms.traces(8000).end))
    aligned = align(pairs=path, output=tmp_path / "a.json")
    again = align(RAYS, init=tmp_path / "a.json", surface=tmp_path / "points.npy")
    same = align(RAYS, init=aligned, surface=tmp_path / "points.npy")
    np.testing.assert_array_equal(same.matrix, again.matrix)
    off = rooms.carried(again.matrix, RAYS.origin) - rooms.carried(aligned.matrix, RAYS.origin)
    assert np.linalg.norm(off, axis=1).max() < 0.1 and again.evidence["kind"] == "tracking"
    assert alignment._turn("-y")[:3, :3] @ [0, -1, 0] == pytest.approx([0, 0, 1])


def test_undetermined_turn_is_refused_unless_forced(tmp_path, monkeypatch):
    monkeypatch.setattr(profile, "_TURNS", np.radians([10, 90, 180]))
    np.save(tmp_path / "points.npy", rooms.traces(8000).end)
    gaze, out = replace(RAYS, hit=None), tmp_path / "a.json"
    options, reporter = {"surface": tmp_path / "points.npy", "scale": 1.0}, Recorder()
    with pytest.raises(NergError, match=r"do not determine the turn.*turn.*force"):
        align(gaze, output=out, **options)
    assert not out.exists()
    forced = align(gaze, output=out, **options, force=True, progress=reporter)
    low, high = forced.uncertainty["turn_degrees"]
    assert forced.forced and high - low > 10 and not any(line.startswith("residuals") for line in reporter.messages)
    with pytest.raises(NergError, match=r"a\.json.*do not determine the turn.*force"):
        train_gaze(gaze, tmp_path / "a.xml", align=out)
    fixed = align(gaze, output=out, **options, turn=0.0, shift="0,0,0")
    assert np.allclose(fixed.matrix, np.eye(4)) and fixed.uncertainty["shift_cm"] == 0


def test_turn_and_shift_hold_with_pairs(tmp_path):
    truth, path = pairs(tmp_path)
    shift = ",".join(map(str, truth[:3, 3]))
    options = {"pairs": path, "up": "y", "shift": shift, "force": True}
    free = alignment._turn("y") @ align(**options).matrix
    degrees = np.degrees(np.arctan2(free[1, 0], free[0, 0])) + 10
    result = align(**options, turn=degrees)
    fixed = alignment._turn("y") @ result.matrix
    assert np.degrees(np.arctan2(fixed[1, 0], fixed[0, 0])) == pytest.approx(degrees)
    np.testing.assert_allclose(result.matrix[:3, 3], truth[:3, 3], atol=1e-9)
    with pytest.raises(NergError, match="no positive scale"):
        align(**options, turn=degrees + 180)
    constraints = alignment._find_constraints("z", 0.5, None, 2.0, None, "1,2,3")
    assert constraints["scene_floor"] == pytest.approx(3 + 2 * 0.5)


def place(alignment_check, monkeypatch):
    monkeypatch.setattr(training, "check_alignment", lambda *_: alignment_check)
    return Environment(object(), Box((0, 0, 0), (1, 1, 1)), "field")  # pyright: ignore[reportArgumentType] # unused argument


def test_gaze_that_hits_no_surface_is_refused_and_doubts_are_reported(monkeypatch):
    reporter = Recorder()
    nowhere = place(AlignmentCheck(1.0, 0.0, 0.0), monkeypatch)
    with pytest.raises(NergError, match="100.0.*align.*force"):
        check_environment(nowhere, RAYS, False, reporter)
    check_environment(nowhere, RAYS, True, reporter)
    check_environment(place(AlignmentCheck(0.4, 0.3, 0.2), monkeypatch), RAYS, False, reporter)
    assert len(reporter.warnings) == 2 and "30 % of the heads are inside solid objects" in reporter.warnings[1]
    assert "nerg align" in reporter.warnings[1]
    check_environment(place(AlignmentCheck(0.05, 0.0, 0.0), monkeypatch), RAYS, False, reporter)
    for kind in ("hits", "none"):
        bare = replace(nowhere, kind=kind, medium=None if kind == "none" else nowhere.medium)
        check_environment(bare, RAYS, False, reporter)
    assert len(reporter.warnings) == 2


@pytest.mark.parametrize("option", ["surface", "environment", "tracking_surface"])
def test_unused_parts_of_a_mesh_are_reported(tmp_path, option):
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n")
    reporter, (_, path) = Recorder(), pairs(tmp_path)
    evidence = {} if option == "tracking_surface" else {"pairs": path, "force": True}
    with pytest.raises(NergError, match="no scene") if option == "tracking_surface" else nullcontext():
        align(**{option: tmp_path / "a.obj"}, **evidence, progress=reporter)
    (note,) = [m for m in reporter.messages if "mtllib" in m]
    assert str(tmp_path / "a.obj") in note and note.endswith(": mtllib")
