"""Tests of `nerg_mi.tracking.guess`."""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.tracking import guess as rows
from nerg_mi.tracking.guess import (
    TableSample,
    find_preset_by_columns,
    find_preset_by_files,
    find_preset_by_first_line,
    propose_import,
    propose_imports,
)
from nerg_mi.tracking.rays import Rays
from nerg_mi.tracking.readers import tables
from nerg_mi.tracking.readers.columns import ColumnFinder, are_degrees, find_roles, parse_time_unit
from tests.cli.rays.running import run
from tests.tracking.readers.examples import EXAMPLES

# ---- A walk in the frame of rays, and tables of it in the style of several programs ----

N = 1500
OTHER_FORMATS = {
    "z right": np.eye(3),
    "y left": np.eye(3)[[0, 2, 1]],
    "y right": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}
"""Matrices from the frame of rays to other frames, by rows."""
FORWARD = {"z right": [1.0, 0, 0], "y left": [0, 0, 1.0], "y right": [0, 0, -1.0]}


@dataclass(frozen=True)
class Walk:
    """Half a minute at 50 Hz: ``eye`` (n, 3), ``gaze`` (n, 3) unit, the ``heading`` (n,) of the head, ``t`` seconds."""

    t: np.ndarray
    eye: np.ndarray
    gaze: np.ndarray
    heading: np.ndarray


def walk(seed: int = 0) -> Walk:
    rng = np.random.default_rng(seed)
    t = 100 + 0.02 * np.arange(N)
    heading = np.cumsum(rng.normal(0, 0.04, N))
    step = 0.02 * 1.1 * np.c_[np.cos(heading), np.sin(heading), np.zeros(N)]
    eye = np.cumsum(step, axis=0) + [3.0, -2.0, 1.62] + rng.normal(0, 0.01, (N, 3)) * [0, 0, 1]
    turned, lift = heading + rng.normal(0, 0.2, N), rng.normal(-0.15, 0.1, N)
    gaze = np.c_[np.cos(lift) * np.cos(turned), np.cos(lift) * np.sin(turned), np.sin(lift)]
    return Walk(t, eye, gaze, heading)


def frame(w: Walk, to: str, metre: float = 1.0) -> tuple[np.ndarray, np.ndarray, Rotation]:
    """Eyes, gaze and heads of a walk in another frame: rotations of the head's frame, whose forward axis is
    `FORWARD`."""
    m = OTHER_FORMATS[to]
    ahead, up = np.c_[np.cos(w.heading), np.sin(w.heading), np.zeros(N)] @ m.T, m @ [0, 0, 1]
    f = np.array(FORWARD[to])
    # Columns of each rotation: directions of the head's axes.
    single = np.stack([f, up, np.cross(f, up)])
    present = np.stack([ahead, np.tile(up, (N, 1)), np.cross(ahead, up)], axis=2)
    return w.eye @ m.T / metre, w.gaze @ m.T, Rotation.from_matrix(present @ single)


def csv(**columns) -> str:
    names = [name.replace("__", " ") for name in columns]
    rows = zip(*(np.asarray(c).tolist() for c in columns.values()))
    return "\n".join([",".join(names), *(",".join(map(str, row)) for row in rows)]) + "\n"


def xyz(stem: str, values: np.ndarray, axes: str = "xyz") -> dict[str, np.ndarray]:
    return {f"{stem}{a}": v for a, v in zip(axes, values.T)}


# ---- Roles of column names ----


@pytest.mark.parametrize(
    "columns",
    [
        ["x", "y", "z"],
        ["PositionX", "PositionY", "PositionZ"],
        ["tx_world_device", "ty_world_device", "tz_world_device"],
        ["head.pos.x", "head.pos.y", "head.pos.z"],
        ["X Pos", "Y Pos", "Z Pos"],
        ["gaze origin x [mm]", "gaze origin y [mm]", "gaze origin z [mm]"],
        ["px", "py", "pz"],
    ],
)
def test_vectors(columns):
    assert list(find_roles(["t", *columns, "other"]).vectors.values()) == [tuple(columns)]


def test_quaternions_and_matrices():
    roles = find_roles([*(f"q{a}" for a in "wxyz"), *(f"QuaternionG{a}" for a in "XYZW")])
    assert roles.quaternions["q*"] == ("qx", "qy", "qz", "qw") and len(roles.quaternions) == 2
    m = [f"ctw_{r}{c}" for r in range(3) for c in range(4)]
    assert find_roles(m[::-1]).matrices == {"ctw": tuple(m)} and find_roles(m[1:]).matrices == {}
    complete = [f"m{r}{c}" for r in range(4) for c in range(4)]
    assert find_roles(complete).matrices == {"": tuple(complete)}


def test_other_columns_have_no_role():
    names = ["velocity", "angular_velocity", "gyro", "gaze_target_pos", "head_scale", "PupilPos"]
    assert find_roles([f"{n}_{a}" for n in names for a in "xyz"]).vectors == {}
    assert find_roles(["gaze_x_px", "gaze_y_px", "a,b", "c=d"]).vectors == {}
    assert find_roles([f"gravity_{a}_world" for a in "xyz"]).gravity == tuple(f"gravity_{a}_world" for a in "xyz")


def test_roles_of_angles_times_and_participants():
    roles = find_roles(
        ["device_timestamp_ns", "timestamp [ns]", "relative time", "left_yaw_rads", "yaw_rads", "pitch_rads", "UserId"]
    )
    assert roles.yaw_pitch_roll == ("yaw_rads", "pitch_rads") and roles.person == "UserId"
    assert roles.times[0] == "timestamp [ns]" and sorted(roles.times[1:]) == ["device_timestamp_ns", "relative time"]
    assert find_roles(["azimuth [deg]", "elevation [deg]"]).azel == ("azimuth [deg]", "elevation [deg]")
    assert find_roles(["duration", "blink"]).times == []


@pytest.mark.parametrize(
    "name, unit",
    [
        ("timestamp [ns]", 1e-9),
        ("time_us", 1e-6),
        ("Time (ms)", 1e-3),
        ("time_s", 1.0),
        ("time", None),
        ("t [h]", None),
    ],
)
def test_units_of_time(name, unit):
    assert parse_time_unit(name) == unit


def test_ticks_are_a_time():
    assert find_roles(["ticks", "x"]).times == ["ticks"] and find_roles(["device_ticks", "time"]).times[0] == "time"


def test_units_of_angles():
    assert are_degrees(["yaw_deg", "pitch"]) is True and are_degrees(["yaw_rads"]) is False
    assert are_degrees(["yaw"]) is None


# ---- Proposals: the printed command imports the intended rays ----

WALK = walk()


def imported(path, monkeypatch) -> Rays:
    """The rays imported with the proposed command for ``path``."""
    monkeypatch.chdir(path.parent)
    proposal = propose_import(path)
    assert proposal.command is not None
    words = shlex.split(proposal.command)
    assert words[:3] == ["nerg", "rays", "import"]
    done = run(*words[2:])
    assert done.exit_code == 0, (proposal.command, done.exception)
    return Rays.load(path.parent / words[words.index("-o") + 1])


def gaze_in_world(to, metre, tick, **names):
    eye, gaze, _ = frame(WALK, to, metre)
    stems = {"time": "time", "eye": "gaze_origin_", "gaze": "gaze_direction_", **names}
    return {stems["time"]: WALK.t / tick, **xyz(stems["eye"], eye), **xyz(stems["gaze"], gaze)}


def gaze_in_head(to, local=True, **names):
    eye, gaze, head = frame(WALK, to)
    stems = {"head": "head_pos_", "turn": "head_rot_", "gaze": "look_dir_", **names}
    gaze = head.inv().apply(gaze) if local else gaze
    return {
        "t": WALK.t,
        **xyz(stems["head"], eye),
        **xyz(stems["turn"], head.as_quat(), "xyzw"),
        **xyz(stems["gaze"], gaze),
    }


TABLES = {
    "ros, millimetres, microseconds": gaze_in_world("z right", 1e-3, 1e-6, eye="eyePos", gaze="rayVec"),
    "unity, named units": gaze_in_world("y left", 1.0, 1e-3, time="timestamp (ms)", eye="Origin.", gaze="Dir."),
    "centimetres, nanoseconds": gaze_in_world("y left", 1e-2, 1e-9, time="time", eye="o_pos", gaze="d"),
    "unity, local": gaze_in_head("y left"),
    "unity, world next to the head": gaze_in_head("y left", local=False),
    "openxr, local": gaze_in_head("y right", head="pos", turn="q", gaze="gaze_vec_"),
    "openxr, world next to the head": gaze_in_head("y right", local=False),
    "ros, local": gaze_in_head("z right", head="camera.position.", turn="camera.orientation."),
}


def assert_walk(rays, gaze=WALK.gaze):
    assert len(rays) == N and np.allclose(rays.t, WALK.t, atol=1e-4)
    assert np.abs(rays.origin - WALK.eye).max() < 1e-5 and np.abs(rays.direction - gaze).max() < 1e-5


@pytest.mark.parametrize("name", TABLES)
def test_proposed_command_imports_the_rays(tmp_path, monkeypatch, name):
    (tmp_path / "log.csv").write_text(csv(**TABLES[name]))
    assert_walk(imported(tmp_path / "log.csv", monkeypatch))


@pytest.mark.parametrize("radians", [False, True])
def test_angles_are_a_direction(tmp_path, monkeypatch, radians):
    eye, gaze, head = frame(WALK, "y left")
    local, unit = head.inv().apply(gaze), 1.0 if radians else 180 / np.pi
    angles = {"azimuth": unit * np.arctan2(local[:, 0], local[:, 2]), "elevation": unit * np.arcsin(local[:, 1])}
    pose = {**xyz("head_pos_", eye), **xyz("head_rot_", head.as_quat(), "xyzw")}
    (tmp_path / "log.csv").write_text(csv(t=WALK.t, **pose, **angles))
    assert_walk(imported(tmp_path / "log.csv", monkeypatch))
    assert ("--radians" in propose_import(tmp_path / "log.csv").options) == radians


def test_heads_only_and_matrices(tmp_path, monkeypatch):
    """Each head looks where it walks; the rows of its matrix are in the column names."""
    eye, _, head = frame(WALK, "y right")
    ahead = np.c_[np.cos(WALK.heading), np.sin(WALK.heading), np.zeros(N)]
    m = np.concatenate([head.as_matrix(), eye[:, :, None]], axis=2)
    cells = {f"m_{r}{c}": m[:, r, c] for r in range(3) for c in range(4)}
    (tmp_path / "log.csv").write_text(csv(t=WALK.t, **cells))
    assert_walk(imported(tmp_path / "log.csv", monkeypatch), ahead)


def test_participants_confidence_and_hits(tmp_path, monkeypatch):
    table = gaze_in_world("z right", 1.0, 1.0)
    table |= {"participant_id": np.repeat(["ann", "bo"], N // 2), "confidence": np.full(N, 0.5)}
    table |= xyz("hit_point_", WALK.eye + 2 * WALK.gaze)
    path = tmp_path / "log.tsv"
    path.write_text(csv(**table).replace(",", "\t"))
    rays = imported(path, monkeypatch)
    assert rays.persons == ("ann", "bo") and np.all(rays.confidence == 0.5)  # noqa: RUF069 (stored)
    assert rays.hit is not None and np.allclose(rays.hit, rays.origin + 2 * rays.direction, atol=1e-5)


@pytest.mark.parametrize("name", [n for n in EXAMPLES if n not in ("table", "unity", "unity_local", "unity_head")])
def test_examples_of_presets_are_recognised(tmp_path, name):
    """By their header, or by the files of their folder."""
    proposal = propose_import(EXAMPLES[name].make(tmp_path))
    assert proposal.preset == name and f"--preset {name}" in (proposal.command or "")


@pytest.mark.parametrize("name", ["unity", "unity_local", "unity_head"])
def test_column_map_is_proposed_for_ambiguous_presets(tmp_path, name):
    """Usual names of gaze in Unity projects do not tell its frame."""
    proposal = propose_import(EXAMPLES[name].make(tmp_path))
    assert proposal.preset is None and proposal.columns is not None and proposal.options["--hand"] == "left"
    assert (proposal.columns.xyzw is not None) == (name != "unity")


def test_folders(tmp_path):
    EXAMPLES["neon"].make(tmp_path)
    proposal = propose_import(tmp_path)
    assert proposal.preset == "neon" and proposal.questions and "--poses MODEL" in (proposal.command or "")
    (tmp_path / "info.json").unlink()
    assert propose_import(tmp_path).preset == "neon"
    (tmp_path / "world_timestamps.csv").unlink()
    with pytest.raises(NergError, match="is not a recording of a known format"):
        propose_import(tmp_path)


def test_unknown_settings_are_open(tmp_path):
    """These rows are at no eye height, and no name identifies them: the command needs values of the user."""
    path = tmp_path / "log.csv"
    rising = np.outer(np.arange(9.0), [1, 7, 5])
    path.write_text(csv(**xyz("a_", rising), **xyz("dir_", np.tile([1.0, 0, 0], (9, 1)))))
    proposal = propose_import(path)
    assert proposal.options["--up"] == "UP" and any("the up axis" in s for s in proposal.questions)
    assert any("the time" in s for s in proposal.questions) and not proposal.certain
    with pytest.raises(NergError, match='"UP up'):
        raise run(*shlex.split(proposal.command or "")[2:]).exception
    path.write_text(csv(speed=np.arange(9.0), note=["x"] * 9))
    proposal = propose_import(path)
    assert proposal.command is None and "origin is missing" in proposal.questions[-1]


def test_up_axis_from_gravity(tmp_path):
    table = {**gaze_in_world("y right", 1.0, 1.0), **xyz("gravity_", np.tile([0, -9.81, 0], (N, 1)))}
    table = {name: v + (50 if name == "gaze_origin_y" else 0) for name, v in table.items()}
    path = tmp_path / "log.csv"
    path.write_text(csv(**{k.replace("gaze_direction", "d"): v for k, v in table.items()}))
    proposal = propose_import(path)
    assert proposal.options["--up"] == "y" and any("gravity" in s for s in proposal.certain)


@pytest.mark.parametrize(
    "text, message", [("1,2,3\n4,5,6\n", "contains no column names"), ("", "contains no column names")]
)
def test_other_files_are_refused(tmp_path, text, message):
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(NergError, match=message):
        propose_import(path)


def alike(eye, gaze, **extra):
    return csv(t=WALK.t, **xyz("gaze_origin_", eye), **xyz("gaze_dir_", gaze), **extra)


@pytest.mark.parametrize(
    "to, hand",
    [
        (lambda v: v[:, [0, 2, 1]] * [1, -1, 1], "right"),  # -y up: OpenCV, Kinect
        (lambda v: v * [1, -1, 1] * 100, "left"),  # z up in centimetres: Unreal
        (lambda v: 1000 * v, "right"),  # z up in millimetres: Vicon
        (lambda v: v[:, [2, 0, 1]], "right"),  # x up
    ],
)
def test_handedness_of_frames(tmp_path, monkeypatch, to, hand):
    eye, gaze = to(WALK.eye), to(WALK.gaze)
    (tmp_path / "log.csv").write_text(alike(eye, gaze / np.linalg.norm(gaze, axis=1, keepdims=True)))
    proposal = propose_import(tmp_path / "log.csv")
    assert proposal.options["--hand"] == hand
    rays = imported(tmp_path / "log.csv", monkeypatch)
    # A rotation about the vertical axis is not determined.
    assert np.allclose(rays.origin[:, 2], WALK.eye[:, 2], atol=1e-5) and np.allclose(
        rays.direction[:, 2], WALK.gaze[:, 2], atol=1e-5
    )


@pytest.mark.parametrize("name, cell", [("time", "12:00"), ("timestamp", "5/1/2024 12:00:00"), ("utc", "noon")])
def test_unreadable_times_are_reported(tmp_path, name, cell):
    eye, gaze, _ = frame(WALK, "y left")
    table = {name: [cell] * N, **xyz("gaze_origin_", eye), **xyz("gaze_dir_", gaze)}
    (tmp_path / "log.csv").write_text(csv(**table))
    (sentence,) = (s for s in propose_import(tmp_path / "log.csv").questions if "the time" in s)
    assert f"{name!r} contains {cell!r}" in sentence


@pytest.mark.parametrize(
    "ids",
    [np.arange(N), [f"u{k:05d}" for k in range(N)], [f"{k / 90:.3f}" for k in range(N)], np.arange(N)[::-1]],
    ids=["counter", "words", "times", "backwards"],
)
def test_row_counter_is_no_participant(tmp_path, ids):
    name = "user_id"
    (tmp_path / "log.csv").write_text(alike(*frame(WALK, "y left")[:2], **{name: ids}))
    proposal = propose_import(tmp_path / "log.csv")
    assert proposal.columns.person is None and any(f"{name!r} has another value" in s for s in proposal.questions)


@pytest.mark.parametrize("form", ["2024-05-01T12:00:{:08.5f}", "12:00:{:08.5f}", "2024/05/01 12:00:{:08.5f}Z"])
def test_times_as_text(tmp_path, monkeypatch, form):
    eye, gaze, _ = frame(WALK, "y left")
    table = {"when": [form.format(t - 100) for t in WALK.t], **xyz("gaze_origin_", eye), **xyz("gaze_dir_", gaze)}
    (tmp_path / "log.csv").write_text(csv(**table))
    assert np.allclose(np.diff(imported(tmp_path / "log.csv", monkeypatch).t), 0.02, atol=1e-5)
    assert "'when' contains times of day" in propose_import(tmp_path / "log.csv").certain[0]


def test_validity(tmp_path, monkeypatch):
    status = np.arange(N) % 3
    (tmp_path / "log.csv").write_text(alike(*frame(WALK, "y left")[:2], gaze_status=status, tracking_state=status))
    proposal = propose_import(tmp_path / "log.csv")
    assert proposal.options["--valid"] == "gaze_status=2"
    assert any("which values of 'tracking_state' mark valid rows" in sentence for sentence in proposal.questions)
    assert len(imported(tmp_path / "log.csv", monkeypatch)) == N // 3


def test_decimal_commas(tmp_path, monkeypatch):
    eye, gaze, _ = frame(WALK, "y left")
    text = alike(eye, gaze)
    (tmp_path / "log.csv").write_text(text.replace(",", ";").replace(".", ","))
    assert np.allclose(imported(tmp_path / "log.csv", monkeypatch).origin, WALK.eye)
    (tmp_path / "log.csv").write_text(text.replace(".", ","))
    with pytest.raises(NergError, match="are these decimal commas"):
        propose_import(tmp_path / "log.csv")


def test_repeated_names_and_mirrored_matrices(tmp_path):
    eye, gaze, head = frame(WALK, "y left")
    rows = np.concatenate([head.as_matrix() @ np.diag([1, 1, -1.0]), eye[:, :, None]], axis=2).reshape(N, 12)
    names = {f"m{r}{c}": rows[:, 4 * r + c] for r in range(3) for c in range(4)}
    (tmp_path / "log.csv").write_text(csv(t=WALK.t, **names, x=eye[:, 0], X=eye[:, 0]).replace(",X", ",x"))
    result = propose_import(tmp_path / "log.csv").questions
    assert any("1,500 of 1,500 rows: the head's matrix is mirrored" in sentence for sentence in result)
    assert any("several columns are called 'x'" in sentence for sentence in result)


def test_several_files_and_folders(tmp_path):
    eye, gaze, _ = frame(WALK, "y left")
    (tmp_path / "data").mkdir()
    for name in ("a.csv", "data/b.csv", "data/c.csv"):
        (tmp_path / name).write_text(alike(eye, gaze))
    (tmp_path / "data" / "d.csv").write_text(alike(100 * WALK.eye, WALK.gaze))
    (tmp_path / "data" / "notes.md").write_text("no table")
    metres, centimetres = propose_imports([tmp_path / "a.csv", tmp_path / "data"])
    assert [p.name for p in metres.paths] == ["a.csv", "b.csv", "c.csv"] and "--units cm" in centimetres.command
    assert shlex.split(metres.command)[3:6] == [str(p) for p in metres.paths]
    (tmp_path / "empty").mkdir()
    with pytest.raises(NergError, match="is not a recording"):
        propose_imports([tmp_path / "empty"])


def test_outputs_are_named_after_the_folder(tmp_path):
    eye, gaze, _ = frame(WALK, "y left")
    (tmp_path / "room.a").mkdir()
    for name in ("a.csv", "b.csv"):
        (tmp_path / "room.a" / name).write_text(alike(eye, gaze))
    output = lambda p: (words := shlex.split(p.command))[words.index("-o") + 1]
    (proposal,) = propose_imports([tmp_path / "room.a"])
    assert output(proposal) == "room.a.npz"
    (proposal,) = propose_imports([tmp_path / "room.a" / "a.csv"])
    assert output(proposal) == "a.npz"
    (tmp_path / "room.a" / "c.csv").write_text(alike(100 * WALK.eye, WALK.gaze))
    assert [output(p) for p in propose_imports([tmp_path / "room.a"])] == ["a.npz", "c.npz"]


def test_a_parent_folder_names_its_subfolders(tmp_path):
    for name in ("empty", "ann", "room"):
        (tmp_path / name).mkdir()
    EXAMPLES["neon"].make(tmp_path / "ann")
    (tmp_path / "room" / "b.csv").write_text("x,y\n1,2\n")
    with pytest.raises(NergError) as refusal:
        propose_imports([tmp_path])
    assert f"nerg rays guess {tmp_path / 'ann'}" in str(refusal.value) and "room" in str(refusal.value)
    # A table that is no recording, next to the recordings.
    (tmp_path / "settings.csv").write_text("name,scale\nroom,2\n")
    lines = run("guess", tmp_path).output
    assert str(tmp_path / "settings.csv") in lines and f"nerg rays guess {tmp_path / 'ann'}" in lines
    assert "ann, room" in lines


def test_directions_of_other_lengths_are_named(tmp_path):
    table = gaze_in_world("z right", 1.0, 1.0)
    (tmp_path / "unit.csv").write_text(csv(**table))
    (tmp_path / "log.csv").write_text(csv(**{k: 3 * v if "direction" in k else v for k, v in table.items()}))
    names = [name for name in table if "direction" in name]
    doubts = [q for q in propose_import(tmp_path / "log.csv").questions if all(name in q for name in names)]
    assert len(doubts) == 1 and "3 to 3" in doubts[0]
    assert not any(names[0] in q for q in propose_import(tmp_path / "unit.csv").questions)


# ---- Evidence from rows ----

OTHER_WALK = walk(3)


@pytest.mark.parametrize("to, up", [("z right", "z"), ("y left", "y"), ("y right", "y")])
@pytest.mark.parametrize("units", ["m", "cm", "mm"])
def test_up_axis_from_head_heights(to, up, units):
    eye, _, _ = frame(OTHER_WALK, to, rows.UNITS[units])
    result = rows.find_up_axis(eye)
    assert result is not None and (result.up, result.units) == (up, units) and abs(result.height - 1.62) < 0.02
    upside_down = rows.find_up_axis(-eye)
    assert upside_down is not None and upside_down.up == "-" + up


def test_rows_without_evidence():
    eye = frame(OTHER_WALK, "z right")[0]
    assert rows.find_up_axis(eye + [0, 0, 40]) is None and rows.find_up_axis(np.full((5, 3), np.nan)) is None
    assert rows.find_up_axis(np.tile([0.0, 0.0, 1.6], (9, 1))) is None  # nothing moves
    # A sitting person at 1.3 m along two axes.
    still = np.array([1.3, 5.0, 1.3]) + np.random.default_rng(0).normal(0, 0.05, (500, 3))
    assert rows.find_up_axis(still) is None


@pytest.mark.parametrize("rate", [30.0, 50.0, 200.0, 1000.0])
@pytest.mark.parametrize("tick", [1.0, 1e-3, 1e-6, 1e-9])
def test_unit_of_time(rate, tick):
    # At 11 to 2,100 Hz only one of two units a factor of thousand apart can match.
    assert rows.find_time_units(np.arange(100) / rate / tick)[0] == tick
    assert rows.find_time_units(np.zeros(9)) == rows.find_time_units(np.array([1.0])) == []
    assert rows.find_time_units(np.arange(9) * 3.6e8) == []


@pytest.mark.parametrize("rate", [50.0, 72.0, 90.0, 120.0, 200.0])
def test_ticks_of_100_ns_are_not_microseconds(rate):
    assert rows.find_time_units(np.arange(100) / rate / 1e-7)[0] == 1e-7  # noqa: RUF069 (one of a table)
    # At 11 Hz in milliseconds there is no other unit.
    assert rows.find_time_units(np.arange(100) / 11 / 1e-3)[0] == 1e-3  # noqa: RUF069 (one of a table)


@pytest.mark.parametrize(
    "start, unit", [(6.37e17, 1e-7), (1.33e17, 1e-7), (1.7e9, 1.0), (1.7e12, 1e-3), (1.7e15, 1e-6), (1.7e18, 1e-9)]
)
def test_clocks_that_count_from_a_date(start, unit):
    clock = rows.find_clock(start + np.arange(50) / 7 / unit)
    assert clock is not None and clock[0] == unit
    for times in (np.arange(50.0), 1e6 + np.arange(50.0), np.full(3, np.nan)):
        assert rows.find_clock(times) is None


@pytest.mark.parametrize("start", [0, 637_134_336_000_000_000])
def test_dotnet_ticks_are_proposed_and_named(tmp_path, monkeypatch, start):
    table = gaze_in_world("y left", 1.0, 1.0) | {"time": start + np.arange(N) * 200_000}
    (tmp_path / "log.csv").write_text(csv(**table))
    proposal = propose_import(tmp_path / "log.csv")
    assert proposal.options["--tick"] == "1e-07" and any("ticks" in line for line in proposal.assumptions)
    rays = imported(tmp_path / "log.csv", monkeypatch)
    assert np.allclose(np.diff(rays.t), 0.02, atol=1e-4)
    if not start:
        assert any("microseconds" in line for line in proposal.assumptions), "the other unit is named"


def test_clocks_of_devices_are_not_dates(tmp_path):
    """Half an hour in microseconds has the values of Unix times in seconds."""
    table = gaze_in_world("y left", 1.0, 1.0) | {"time": 1_800_000_000 + np.arange(N) * 16_667}
    (tmp_path / "log.csv").write_text(csv(**table))
    assert propose_import(tmp_path / "log.csv").options["--tick"] == "1e-06"


@pytest.mark.parametrize("name, step", [("time_s", 5.0), ("time_s", 1e-4), ("time [ns]", 100.0), ("time", 5e4)])
def test_implausible_rates_are_questions(tmp_path, name, step):
    """5 s, 10 kHz and 10 MHz are implausible; 50,000 of an unknown unit are 200 Hz in ticks."""
    table = gaze_in_world("y left", 1.0, 1.0)
    del table["time"]
    (tmp_path / "log.csv").write_text(csv(**{name.replace(" ", "__"): 7 + np.arange(N) * step}, **table))
    proposal = propose_import(tmp_path / "log.csv")
    assert any("sampling rate" in line for line in proposal.questions) == (name != "time")


@pytest.mark.parametrize("to", FORWARD)
def test_forward_axis_from_walking(to):
    eye, gaze, head = frame(OTHER_WALK, to)
    turns, up = head.as_matrix(), "z" if to.startswith("z") else "y"
    name = rows.find_forward_axis(turns, eye, OTHER_WALK.t, up, 1.0)
    assert name is not None and np.allclose(rows.poses.AXES[name], FORWARD[to])
    assert rows.find_forward_axis(turns, eye * 0, OTHER_WALK.t, up, 1.0) is None
    assert rows.find_forward_axis(turns[:20], eye[:20], OTHER_WALK.t[:20], up, 1.0) is None
    assert rows.is_gaze_in_head_frame(head.inv().apply(gaze), turns, name) is True
    assert rows.is_gaze_in_head_frame(gaze, turns, name) is False
    assert rows.is_gaze_in_head_frame(gaze, np.tile(np.eye(3), (len(gaze), 1, 1)), name) is None


def test_unit_vectors():
    assert rows.is_unit(np.eye(3)) and not rows.is_unit(2 * np.eye(3)) and not rows.is_unit(np.zeros((3, 3)))
    assert rows.is_unit(np.array([[np.nan, 0, 0], [0, 0, 0], [0, 0, 1.0]]))


# ---- Presets by names ----


@pytest.mark.parametrize(
    "head", ["gaze_dir_x,gaze_dir_y,gaze_dir_z,gaze_origin_x", "x,y,z", "timestamp [ns]", "ViewIndex"]
)
def test_gaze_columns_alone_match_no_preset(tmp_path, head):
    """Rows, not names, determine the frame."""
    (tmp_path / "a.csv").write_text(head + "\n")
    assert find_preset_by_columns(ColumnFinder(tmp_path / "a.csv")) is None


def test_files_and_first_lines(tmp_path):
    (tmp_path / "a.csv").write_text("a|b|c\n")
    assert find_preset_by_first_line(tmp_path / "a.csv") is None and find_preset_by_files(tmp_path / "a.csv") is None


# ---- The first rows of a table ----

NAMES = ["a", "word", "b", "empty", "late"]

ROWS = [["1", "x", "", "", "7"], ["2.5", "y", "-3e2", "nan", "7"], ["3", "z", "1", "", "7"]]


def test_columns_of_numbers(tmp_path):
    path = tmp_path / "t.csv"
    rows = ROWS + [["1", "x", "1", "", "7"]] * 60 + [["1", "x", "1", "", "word"], ["1"]]
    path.write_text(";".join(NAMES) + "\n" + "\n".join(";".join(r) for r in rows) + "\n")
    sample = TableSample(path, NAMES)
    # Bad cells after the sniffed lines are skipped by line, as is a truncated line.
    assert list(sample.numbers) == ["a", "b", "late"] and sample.rows == 63
    assert np.array_equal(
        sample.stack_columns(["b", "word"])[:3], [[np.nan, np.nan], [-300, np.nan], [1, np.nan]], equal_nan=True
    )


def test_parquet(tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    pq.write_table(pa.table({"a": [1.0, 2.0], "word": ["x", "y"], "k": [3, 4]}), tmp_path / "t.parquet")
    sample = TableSample(tmp_path / "t.parquet", ["a", "word", "k"])
    assert list(sample.numbers) == ["a", "k"] and sample.rows == 2


@pytest.mark.parametrize("text", ["", "a,b\n", "a,b\nx,y\n"])
def test_no_numbers(tmp_path, text):
    path = tmp_path / "t.csv"
    path.write_text(text)
    sample = TableSample(path, ["a", "b"] if text else [])
    assert sample.rows == 0 and sample.stack_columns(["a", "b", "c"]).shape == (0, 3)


# ---- The command ----


def test_the_command_is_printed_and_nothing_is_written(tmp_path):
    w = walk()
    eye, gaze, _ = frame(w, "y left")
    path = tmp_path / "log.csv"
    path.write_text(csv(t=w.t, **xyz("p", eye), **xyz("d", gaze)))
    before = os.listdir(tmp_path)
    done = run("guess", path)
    assert done.exit_code == 0 and os.listdir(tmp_path) == before
    lines = done.output.splitlines()
    assert lines[-1].startswith(f"nerg rays import {path} -o log.npz --map 'origin=px,py,pz direction=dx,dy,dz t=t'")
    assert any(line.startswith("guess  y is up and the unit m") for line in lines)
    path.write_text("a,b\n1,2\n")
    assert run("guess", path).output.splitlines()[-1] == "no command can be proposed"


def test_rows_without_gaze_at_the_beginning(tmp_path, monkeypatch):
    """The proposal is that of the rows with gaze, even in a later block."""
    rng = np.random.default_rng(4)
    values = np.hstack([rng.normal([5, 1.6, 9], [2, 0.03, 2], (400, 3)), rng.normal([0, 0, 1], 0.1, (400, 3))])
    values[:, 3:] /= np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
    header = "timestamp_ms,eye_x,eye_y,eye_z,look_x,look_y,look_z\n"
    write = lambda rows: (tmp_path / "t.csv").write_text(header + "".join(rows))
    rows = [f"{10 * k}," + ",".join(f"{v:.6f}" for v in row) + "\n" for k, row in enumerate(values)]
    write(rows)
    expected = propose_import(tmp_path / "t.csv")
    empty = [f"{10 * (k - 350)},,,,,,\n" for k in range(350)]
    for block_rows in (1 << 16, 100):
        monkeypatch.setattr(tables, "BLOCK_ROWS", block_rows)
        write([*empty, *rows])
        proposal = propose_import(tmp_path / "t.csv")
        assert proposal.command == expected.command and "--up y" in proposal.command


def test_tables_for_excel_and_vectors_in_cells(tmp_path):
    rows = [f'{k / 50:.2f};"(1.0{k % 10}, 1.6, 2.0)";"(0.6, 0.0, 0.8)"' for k in range(60)]
    text = "\n".join(["sep=;", "time;GazeOrigin;GazeDirection", *rows])
    (tmp_path / "t.csv").write_bytes(text.encode("utf-16"))
    proposal = propose_import(tmp_path / "t.csv")
    assert proposal.columns.origin == ("GazeOrigin.x", "GazeOrigin.y", "GazeOrigin.z")
    assert proposal.columns.direction == ("GazeDirection.x", "GazeDirection.y", "GazeDirection.z")
    assert proposal.columns.t == "time" and proposal.options["--up"] == "y"


def test_matrix_with_another_last_row(tmp_path):
    matrices = np.tile(np.eye(4), (60, 1, 1))
    matrices[:, 3, :3] = np.linspace([0, 1.5, 0], [3, 1.6, 2], 60)  # transposed
    names = ",".join(f"m{r}{c}" for r in range(4) for c in range(4))
    np.savetxt(tmp_path / "t.csv", matrices.reshape(60, 16), delimiter=",", header=names, comments="")
    assert any("transposed" in question for question in propose_import(tmp_path / "t.csv").questions)
