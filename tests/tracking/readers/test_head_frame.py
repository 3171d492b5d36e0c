"""Tests of `nerg_mi.tracking.readers.head_frame`: gaze in the head's frame that is read as gaze in the world."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.tracking.guess import propose_import
from nerg_mi.tracking.quality import summarise
from nerg_mi.tracking.rays import Rays
from nerg_mi.tracking.readers.columns import ColumnMap
from tests.tracking.readers.examples import read

COUNT = 400


def make_walk(turn_range=2.0):
    """Positions, yaw, pitch and roll in Unity's frame, and gaze in the head's frame."""
    rng, s = np.random.default_rng(3), np.linspace(0, 1, COUNT)
    position = np.stack([3 * np.sin(4 * s), 1.6 + 0.02 * np.sin(30 * s), 5 * s], axis=1)
    angles = np.stack([turn_range * np.sin(9 * s), 0.2 * np.sin(7 * s), 0.05 * np.sin(5 * s)], axis=1)
    gaze = np.stack([*rng.normal(0, 0.15, (2, COUNT)), np.ones(COUNT)], axis=1)
    return position, angles, gaze / np.linalg.norm(gaze, axis=1, keepdims=True)


def write(path, columns):
    names = ["time", *(f"{stem}_{axis}" for stem, values in columns.items() for axis in "xyzw"[: values.shape[1]])]
    rows = np.column_stack([np.arange(COUNT) / 100, *columns.values()])
    np.savetxt(path, rows, delimiter=",", header=",".join(names), comments="", fmt="%.8f")
    return path


def read_warnings(path, preset="unity", **options):
    rays = read(preset, path, **options)
    return [w for w in summarise(rays).warnings if "head's frame" in w or "unit" in w or "height" in w]


@pytest.mark.parametrize("eye", [(0, 0, 0), (0.03, -0.02, 0.06)])
@pytest.mark.parametrize("jitter", [0.0, 0.002])
@pytest.mark.parametrize("head", ["HMD_position", "Head Pos", "camera_position", "Position"])
def test_origins_that_stay_while_the_head_moves(tmp_path, eye, jitter, head):
    position, angles, gaze = make_walk()
    origin = np.array(eye) + np.random.default_rng(1).uniform(-jitter, jitter, (COUNT, 3))
    columns = {head: position, "HMD_rotation": angles[:, [1, 0, 2]], "gaze_origin": origin, "gaze_forward": gaze}
    path = write(tmp_path / "t.csv", columns)
    (warning,) = read_warnings(path)
    assert f"{head}_x, {head}_y, {head}_z move" in warning and "guess" in warning
    mapping = "origin=gaze_origin_x,gaze_origin_y,gaze_origin_z direction=gaze_forward_x,gaze_forward_y,gaze_forward_z"
    (warning,) = read_warnings(path, "table", columns=ColumnMap.parse(mapping), up="y", handedness="left")
    assert f"{head}_x, {head}_y, {head}_z move" in warning


@pytest.mark.parametrize("library", ["pandas", "polars", "pyarrow"])
def test_data_frames_are_compared_with_their_unused_columns(library):
    position, angles, gaze = make_walk()
    turned = Rotation.from_euler("YXZ", angles).apply(gaze)
    make = {"pandas": "DataFrame", "polars": "DataFrame", "pyarrow": "table"}[library]
    table = getattr(pytest.importorskip(library), make)
    for origin, direction, expected in (
        (np.full((COUNT, 3), 0.01), gaze, ["HMD_position_x, HMD_position_y, HMD_position_z move"]),
        (position, gaze, ["HMD_rotation_x, HMD_rotation_y, HMD_rotation_z turn"]),
        (position, turned, []),
    ):
        vectors = {"HMD_position": position, "HMD_rotation": angles, "origin": origin, "direction": direction}
        columns = {f"{stem}_{axis}": values for stem, m in vectors.items() for axis, values in zip("xyz", m.T)}
        other = {"Head_position_x": ["seated"] * COUNT, "time": np.arange(COUNT) / 100}
        rays = Rays.from_dataframe(table(columns | other))
        warnings = [w for w in summarise(rays).warnings if "the gaze is in the head's frame" in w]
        assert len(warnings) == len(expected) and all(e in w for e, w in zip(expected, warnings))


def test_files_with_fixed_origins_are_named(tmp_path):
    position, angles, gaze = make_walk()
    columns = {"HMD_position": position, "gaze_origin": np.zeros((COUNT, 3)), "gaze_forward": gaze}
    local = write(tmp_path / "local.csv", columns)
    world = write(tmp_path / "world.csv", {**columns, "gaze_origin": position + 0.01})
    rays = read("unity", local, world)
    (warning,) = [w for w in summarise(rays).warnings if "head's frame" in w]
    assert "origins of local.csv are 0, 0, 0" in warning and "world.csv" not in warning


def test_gaze_in_the_world_is_not_reported(tmp_path):
    position, angles, gaze = make_walk()
    rotation = Rotation.from_euler("YXZ", angles)
    columns = {"HMD_position": position, "HMD_rotation": angles[:, [1, 0, 2]]}
    columns |= {"gaze_origin": position + rotation.apply([0, 0, 0.05]), "gaze_forward": rotation.apply(gaze)}
    assert read_warnings(write(tmp_path / "t.csv", columns)) == []
    seated = np.array([0, 1.2, 0]) + 0.01 * position
    columns |= {"HMD_position": seated, "gaze_origin": seated + rotation.apply([0, 0, 0.05])}
    assert [w for w in read_warnings(write(tmp_path / "t.csv", columns)) if "head's frame" in w] == []


def test_origins_that_never_move(tmp_path):
    gaze = make_walk()[2]
    path = write(tmp_path / "t.csv", {"gaze_origin": np.zeros((COUNT, 3)), "gaze_forward": gaze})
    (warning,) = read_warnings(path)
    assert "all origins are 0, 0, 0 m" in warning and "units" not in warning


@pytest.mark.parametrize("kind", ["quaternion", "radians", "degrees"])
def test_directions_that_stay_while_the_head_turns(tmp_path, kind):
    position, angles, gaze = make_walk()
    rotation = Rotation.from_euler("YXZ", angles)
    euler = angles[:, [1, 0, 2]] * (180 / np.pi if kind == "degrees" else 1)
    columns = {"eye": position, "look": gaze, "head_rot": rotation.as_quat() if kind == "quaternion" else euler}
    mapping = ColumnMap.parse("origin=eye_x,eye_y,eye_z direction=look_x,look_y,look_z t=time")
    frame = {"columns": mapping, "up": "y", "handedness": "left"}
    (warning,) = read_warnings(write(tmp_path / "t.csv", columns), "table", **frame)
    assert "head_rot_x" in warning and "turn" in warning
    columns["look"] = rotation.apply(gaze)
    assert read_warnings(write(tmp_path / "t.csv", columns), "table", **frame) == []


@pytest.mark.parametrize("kind", ["quaternion", "radians", "degrees"])
def test_proposal_combines_local_gaze_with_the_head(tmp_path, kind):
    position, angles, gaze = make_walk()
    rotation = Rotation.from_euler("YXZ", angles)
    euler = angles[:, [1, 0, 2]] * (180 / np.pi if kind == "degrees" else 1)
    columns = {"gaze_origin": np.zeros((COUNT, 3)), "gaze_forward": gaze, "HMD_position": position}
    columns["HMD_rotation"] = rotation.as_quat() if kind == "quaternion" else euler
    path = write(tmp_path / "t.csv", columns)
    proposal = propose_import(path)
    assert proposal.columns is not None and proposal.columns.origin == tuple(f"HMD_position_{a}" for a in "xyz")
    assert ("--radians" in proposal.options) == (kind == "radians")
    options = {"up": proposal.options["--up"], "handedness": proposal.options["--hand"], "radians": kind == "radians"}
    forward = proposal.options.get("--forward")
    assert forward in (None, "z")
    rays = read("table", path, columns=proposal.columns, **options)
    np.testing.assert_allclose(rays.origin, position[:, [0, 2, 1]], atol=1e-6)
    np.testing.assert_allclose(rays.direction, rotation.apply(gaze)[:, [0, 2, 1]], atol=1e-6)
    assert not any("head's frame" in w for w in summarise(rays).warnings)


def test_local_gaze_without_a_rotation_is_not_proposed(tmp_path):
    position, _, gaze = make_walk()
    columns = {"gaze_origin": np.zeros((COUNT, 3)), "gaze_forward": gaze, "HMD_position": position}
    proposal = propose_import(write(tmp_path / "t.csv", columns))
    assert proposal.command is None and any("rotation" in question for question in proposal.questions)
