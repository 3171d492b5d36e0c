"""The job: which evidence is taken, what is refused, what is written."""

import json
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.alignment.check import Check
from nerg_mi.errors import NergError
from nerg_mi.maths.geometry import Box
from nerg_mi.train.geometry import GazePlace
from nerg_mi.workflows import align as alignment
from nerg_mi.workflows import geometry
from nerg_mi.workflows.align import align
from nerg_mi.workflows.geometry import check_place
from nerg_mi.workflows.rays_commands import AlignOptions
from tests.alignment import rooms

from .recorder import Recorder

RAYS = rooms.people(300)


def pairs(folder, noise=0.0, mirror=1.0):
    rng = np.random.default_rng(0)
    truth, x = rooms.similarity(rng, scale=2.0), rng.uniform(0, 4, (6, 3))
    y = rooms.carried(truth, x + rng.normal(0, noise, x.shape))
    rows = np.c_[x * (mirror, 1, 1), y].tolist()
    path = folder / "pairs.csv"
    path.write_text("x,y,z,place_x,place_y,place_z\n" + "".join(",".join(map(str, r)) + "\n" for r in rows))
    return truth, path


def test_what_was_found_is_written_with_its_picture(tmp_path):
    truth, path = pairs(tmp_path)
    reporter = Recorder()
    result = align(None, tmp_path / "a.json", AlignOptions(pairs=path), reporter)
    np.testing.assert_allclose(result.alignment.matrix, truth, atol=1e-6)
    about = json.loads((tmp_path / "a.json").read_text())
    assert about["files"]["pairs"]["file"] == "pairs.csv" and about["forced"] is False
    assert (tmp_path / "a.png").is_file() and "--align" in reporter.messages[-1]


def test_bad_and_mirrored_fits_are_refused_unless_forced(tmp_path):
    _, path = pairs(tmp_path, noise=0.5)
    with pytest.raises(NergError, match=r"the residual is \d+.* cm \(median\), beyond --max-residual 10"):
        align(None, tmp_path / "a.json", AlignOptions(pairs=path))
    assert not (tmp_path / "a.json").exists()
    assert align(None, tmp_path / "a.json", AlignOptions(pairs=path, force=True)).alignment.forced
    _, path = pairs(tmp_path, mirror=-1)
    with pytest.raises(NergError, match="--hand"):
        align(None, None, AlignOptions(pairs=path))


@pytest.mark.parametrize(
    "options, rays, why",
    [
        ({}, None, "say what to align by"),
        ({}, RAYS, "the place is missing"),
        ({"cameras": "a"}, None, "give both"),
        ({"pairs": "a", "twin": "b"}, None, "different evidence"),
        ({"pairs": "a", "start": "b"}, None, "different evidence"),
        ({"pairs": "PAIRS", "refine": True}, None, "--refine needs the tracking"),
        ({"pairs": "PAIRS", "up": "north"}, None, "--up is numbers"),
        ({"pairs": "PAIRS", "up": "0,0,0"}, None, "--up is an axis"),
        ({"pairs": "PAIRS", "scale": -1.0}, None, "--scale must lie in"),
        ({"pairs": "PAIRS", "field": "a", "scene": "b"}, None, "the place is one"),
    ],
)
def test_options_that_do_not_go_together_are_refused(tmp_path, options, rays, why):
    _, path = pairs(tmp_path)
    given = {k: path if v == "PAIRS" else v for k, v in options.items()}
    with pytest.raises(NergError, match=why):
        align(rays, None, AlignOptions(**given))


def test_another_up_axis_and_a_start_lead_to_the_same_frame(tmp_path, monkeypatch):
    truth, path = pairs(tmp_path)
    np.save(tmp_path / "points.npy", rooms.carried(truth, rooms.traces(8000).end))
    aligned = align(None, tmp_path / "a.json", AlignOptions(pairs=path))
    options = AlignOptions(start=tmp_path / "a.json", surface=tmp_path / "points.npy")
    again = align(RAYS, None, options).alignment
    off = rooms.carried(again.matrix, RAYS.origin) - rooms.carried(aligned.alignment.matrix, RAYS.origin)
    assert np.linalg.norm(off, axis=1).max() < 0.1 and again.evidence["kind"] == "tracking"
    assert alignment._turn("-y")[:3, :3] @ [0, -1, 0] == pytest.approx([0, 0, 1])


def place(found, monkeypatch):
    monkeypatch.setattr(geometry, "check_alignment", lambda *_: found)
    return GazePlace(object(), Box((0, 0, 0), (1, 1, 1)), "field")  # pyright: ignore[reportArgumentType] # not asked


def test_gaze_that_meets_nothing_is_refused_and_doubts_are_told_with_the_next_command(monkeypatch):
    reporter = Recorder()
    nowhere = place(Check(1.0, 0.0, 0.0), monkeypatch)
    with pytest.raises(NergError, match="100.0.*--field.*--force"):
        check_place(nowhere, RAYS, "--field f", False, reporter)
    check_place(nowhere, RAYS, "--field f", True, reporter)
    check_place(place(Check(0.4, 0.3, 0.2), monkeypatch), RAYS, "--scene s", False, reporter)
    assert len(reporter.warnings) == 2 and "30 % of the heads are inside of something" in reporter.warnings[1]
    assert "nerg align RAYS --scene s -o alignment.json" in reporter.warnings[1]
    check_place(place(Check(0.05, 0.0, 0.0), monkeypatch), RAYS, "--field f", False, reporter)
    for kind in ("hits", "none"):
        bare = replace(nowhere, kind=kind, medium=None if kind == "none" else nowhere.medium)
        check_place(bare, RAYS, "", False, reporter)
    assert len(reporter.warnings) == 2


@pytest.mark.parametrize("option", ["surface", "scene", "twin"])
def test_what_of_a_mesh_is_not_used_is_named(tmp_path, option):
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n")
    options, reporter = AlignOptions(**{option: tmp_path / "a.obj"}), Recorder()
    if option == "twin":
        alignment._evidence(options, None, reporter)
    else:
        alignment._target(options, "tracking", reporter)
    assert [m for m in reporter.messages if "mtllib" in m] == [
        f"of {tmp_path / 'a.obj'}: statements that are not used: mtllib"
    ]
