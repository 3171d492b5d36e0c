"""Tests of `nerg_mi.tracking.readers.bids` on datasets of others: Motion-BIDS, eye in head, and what is refused."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from tests.refusals import mentions
from tests.tracking.readers.examples import dropped, read

N = 60
T = np.arange(N) / 60
HEAD = np.c_[0.5 * T, 0.2 * np.sin(T), np.full(N, 1.6)]  # in a world with x forward, y left, z up
TURN = Rotation.from_euler("ZY", np.c_[40 * np.sin(2 * T), 10 * np.cos(3 * T)], degrees=True)
GAZE = np.c_[10 * np.sin(3 * T), -8 + 3 * T]  # degrees to the right and up, in the head


def world_gaze() -> np.ndarray:
    """Directions (N, 3) of the gaze in the world, by hand: turn by the elevation, then by the azimuth."""
    a, e = np.radians(GAZE).T
    in_head = np.c_[np.cos(e) * np.cos(a), -np.cos(e) * np.sin(a), np.sin(e)]
    return TURN.apply(in_head)


def table(rows) -> str:
    cell = lambda v: "n/a" if isinstance(v, float) and np.isnan(v) else str(v)
    return "".join("\t".join(map(cell, row)) + "\n" for row in rows)


def to_axes(axes: str) -> np.ndarray:
    """Matrix from x forward, y left, z up to these anatomical axes."""
    directions = {"A": (1, 0, 0), "P": (-1, 0, 0), "L": (0, 1, 0), "R": (0, -1, 0), "S": (0, 0, 1), "I": (0, 0, -1)}
    return np.array([directions[a] for a in axes], float)


class Dataset:
    """A dataset that is written file by file."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.json("dataset_description.json", {"Name": "Test", "BIDSVersion": "1.11.1"})

    def text(self, name: str, text: str) -> None:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())

    def json(self, name: str, value: Any) -> None:
        self.text(name, json.dumps(value))

    def motion(self, axes: str = "ALS", *, euler: str = "", rule: str | None = None, latency: bool = True, **frame):
        """The motion of a head, a hand, and a clock, in ``axes``."""
        m = to_axes(axes)
        matrices = m @ TURN.as_matrix() @ m.T
        mirrored = np.linalg.det(m) < 0
        # A quaternion in left-handed axes turns by the left hand: the same numbers give the same matrix.
        turns = Rotation.from_matrix(matrices)
        if euler:
            angles = turns.as_euler(euler.lower())
            orientation = angles[:, [euler.index(a) for a in "XYZ"]]
            components, units = list("xyz"), "rad"
        else:
            orientation, components, units = turns.as_quat(), [f"quat_{a}" for a in "xyzw"], "n/a"
        rows = [("name", "component", "type", "tracked_point", "units", "reference_frame")]
        rows += [(f"hand_{a}", a, "POS", "RightHand", "m", "world") for a in "xyz"]
        rows += [(f"o{c}", c, "ORNT", "Headset_HMD", units, "world") for c in components]
        rows += [(f"p{a}", a, "POS", "Headset_HMD", "cm", "world") for a in "xyz"]
        rows += [("clock", "n/a", "LATENCY", "n/a", "s", "n/a")] if latency else []
        stem = "sub-01/motion/sub-01_task-walk_tracksys-vr"
        self.text(f"{stem}_channels.tsv", table(rows))
        rule = ("left-hand" if mirrored else "right-hand") if rule is None else rule
        level = {"SpatialAxes": axes, "RotationRule": rule, "RotationOrder": euler or "XYZ"} | frame
        self.json(f"{stem}_channels.json", {"reference_frame": {"Levels": {"world": level}}})
        self.json(f"{stem}_motion.json", {"SamplingFrequency": 60, "TaskName": "walk"})
        values = np.c_[np.zeros((N, 3)), orientation, 100 * HEAD @ m.T]
        values = np.c_[values, T] if latency else values
        self.text(f"{stem}_motion.tsv", table(values.tolist()))

    def gaze(self, columns: dict[str, np.ndarray], name: str = "sub-01/beh/sub-01_task-walk_recording-eye1", **meta):
        units = {"x_coordinate": {"Units": "deg"}, "timestamp": {"Units": "ms"}}
        content = {"PhysioType": "eyetrack", "RecordedEye": "left", "SampleCoordinateSystem": "eye-in-head"}
        content |= {"StartTime": 0.0, "SamplingFrequency": 60, "Columns": list(columns), **units, **meta}
        self.json(f"{name}_physio.json", {k: v for k, v in content.items() if v is not None})
        self.text(f"{name}_physio.tsv.gz", table(np.stack(list(columns.values()), axis=1).tolist()))


ANGLES = {"timestamp": 5000 + 1000 * T, "x_coordinate": GAZE[:, 0], "y_coordinate": GAZE[:, 1]}


@pytest.fixture
def dataset(tmp_path) -> Dataset:
    return Dataset(tmp_path)


def in_rays_frame(axes: str, v: np.ndarray) -> np.ndarray:
    """Vectors in the frame of rays: z up, and the first axis of the file kept."""
    m = to_axes(axes)
    z = m @ [0, 0, 1.0]
    x = np.eye(3)[1 if abs(z[0]) > 0.5 else 0]
    y = np.cross(z, x) * np.linalg.det(m)
    return v @ m.T @ np.stack([x, y, z]).T


# ---- Eye in head, and heads of Motion-BIDS ----


@pytest.mark.parametrize("axes", ["ALS", "ARS", "RAS", "RSA", "LIA", "SAL"])
@pytest.mark.parametrize("euler", ["", "ZXY", "YXZ"])
def test_eye_in_head(dataset, axes, euler):
    """RSA is that of Unity; all are the same head and gaze in the frame of rays."""
    dataset.motion(axes, euler=euler)
    dataset.gaze(ANGLES)
    rays = read("bids", dataset.folder)
    assert len(rays) == N and rays.persons == ("sub-01",) and rays.metadata["eye"] == "left"
    np.testing.assert_allclose(rays.t, 5 + T)
    np.testing.assert_allclose(rays.origin, in_rays_frame(axes, HEAD), atol=1e-9)
    np.testing.assert_allclose(rays.direction, in_rays_frame(axes, world_gaze()), atol=1e-9)
    assert rays.head is not None
    np.testing.assert_allclose(rays.head, in_rays_frame(axes, TURN.apply([1.0, 0, 0])), atol=1e-6)


def test_a_stated_rule_of_the_other_hand_inverts_rotations(dataset):
    dataset.motion("ALS", rule="left-hand")
    dataset.gaze(ANGLES)
    rays = read("bids", dataset.folder)
    assert rays.head is not None
    np.testing.assert_allclose(rays.head, TURN.inv().apply([1.0, 0, 0]), atol=1e-6)


def test_directions_in_the_head(dataset):
    dataset.motion("ARS")
    local = TURN.inv().apply(world_gaze()) @ to_axes("ARS").T
    vectors = {f"{a}_coordinate": local[:, k] for k, a in enumerate("xyz")}
    dataset.gaze({"timestamp": ANGLES["timestamp"], **vectors})
    rays = read("bids", dataset.folder)
    np.testing.assert_allclose(rays.direction, in_rays_frame("ARS", world_gaze()), atol=1e-9)


def test_points_in_the_world_and_heads(dataset):
    dataset.motion("ALS")
    points = HEAD + 2 * world_gaze()
    columns = {f"{a}_coordinate": 100 * points[:, k] for k, a in enumerate("xyz")}
    system = {"SampleCoordinateSystem": "gaze-in-world", "x_coordinate": {"Units": "cm"}}
    dataset.gaze({"timestamp": ANGLES["timestamp"], **columns}, **system)
    rays = read("bids", dataset.folder)
    np.testing.assert_allclose(rays.direction, world_gaze(), atol=1e-9)
    assert rays.hit is not None
    np.testing.assert_allclose(rays.hit, points, atol=1e-9)


@pytest.mark.parametrize("scans", [False, True])
def test_clocks(dataset, scans):
    """The gaze starts a quarter of a second after the motion, which has no clock of its own."""
    dataset.motion("ALS", latency=False)
    late = {name: values[15:] for name, values in ANGLES.items()}
    dataset.gaze(late, StartTime=None if scans else 0.25)
    if scans:
        times = [
            ("filename", "acq_time"),
            ("beh/sub-01_task-walk_recording-eye1_physio.tsv.gz", "2026-01-01T10:00:00.25"),
        ]
        times += [("motion/sub-01_task-walk_tracksys-vr_motion.tsv", "2026-01-01T10:00:00")]
        dataset.text("sub-01/sub-01_scans.tsv", table(times))
    rays = read("bids", dataset.folder)
    np.testing.assert_allclose(rays.direction, world_gaze()[15:], atol=1e-6)


def test_gaze_without_a_pose_is_dropped(dataset):
    dataset.motion("ALS")
    dataset.gaze({**ANGLES, "timestamp": ANGLES["timestamp"] * 2})
    rays = read("bids", dataset.folder)
    assert 0 < len(rays) < N and "there is no pose of the head at that time" in dropped(rays)


def test_heads_alone(dataset):
    dataset.motion("RSA")
    rays = read("bids", dataset.folder, task="walk")
    np.testing.assert_allclose(rays.direction, in_rays_frame("RSA", TURN.apply([1.0, 0, 0])), atol=1e-9)
    assert rays.head is None and rays.metadata["floor"] == "unknown"


def test_axes_that_the_dataset_does_not_state(dataset):
    dataset.motion("ALS", SpatialAxes=None)
    dataset.gaze(ANGLES)
    with pytest.raises(NergError, check=mentions("up")):
        read("bids", dataset.folder)
    rays = read("bids", dataset.folder, up="z", forward="x", handedness="right")
    np.testing.assert_allclose(rays.direction, world_gaze(), atol=1e-9)


def test_several_heads(dataset):
    dataset.motion("ALS")
    dataset.gaze(ANGLES)
    path = dataset.folder / "sub-01/motion/sub-01_task-walk_tracksys-vr_channels.tsv"
    path.write_text(path.read_text().replace("Headset_HMD", "Point"))
    assert len(read("bids", dataset.folder)) == N  # the only one with a pose
    for tracksys in "ab":
        for file in list(path.parent.iterdir()):
            (path.parent / file.name.replace("-vr_", f"-{tracksys}_")).write_bytes(file.read_bytes())
    with pytest.raises(NergError, check=mentions("rigid_body")):
        read("bids", dataset.folder)


# ---- Metadata ----

WORLD = {"UpAxis": "z", "Handedness": "right", "FloorHeight": 0}
RAYS = {
    f"{name}_{a}": np.full(N, value[k])
    for name, value in (("origin", (1, 2, 1.6)), ("direction", (0, 1, 0)))
    for k, a in enumerate("xyz")
}
IN_WORLD = {"timestamp": 1000 * T, "x_coordinate": np.full(N, np.nan), "y_coordinate": np.full(N, np.nan), **RAYS}
SYSTEM = {"SampleCoordinateSystem": "custom", "WorldCoordinateSystem": WORLD, "origin_x": {"Units": "m"}}


def test_matrix_to_the_environment(dataset):
    matrix = np.diag([0.01, 0.01, -0.01, 1.0])
    name = "sub-a/beh/sub-a_task-look_recording-eye1"
    save = lambda m: dataset.gaze(
        IN_WORLD, name, **(SYSTEM | {"WorldCoordinateSystem": {**WORLD, "EnvironmentFromWorld": m}})
    )
    save(matrix.tolist())
    assert read("bids", dataset.folder).metadata["place_from_rays"] == matrix.tolist()
    for other in ((matrix + np.eye(4, k=-3)).tolist(), matrix[:3].tolist(), np.diag([1.0, 2, 1, 1]).tolist(), "x", 3):
        save(other)
        with pytest.raises(NergError, match="EnvironmentFromWorld"):
            read("bids", dataset.folder)


def test_metadata_are_inherited(dataset):
    """From the root for all, from a session for its recordings; the file's own come first."""
    dataset.gaze(IN_WORLD, "sub-a/ses-1/beh/sub-a_ses-1_task-look_recording-eye1", **SYSTEM)
    dataset.gaze(IN_WORLD, "sub-a/ses-2/beh/sub-a_ses-2_task-look_recording-eye1", **SYSTEM)
    for k in (1, 2):
        sidecar = dataset.folder / f"sub-a/ses-{k}/beh/sub-a_ses-{k}_task-look_recording-eye1_physio.json"
        content = json.loads(sidecar.read_text())
        del content["timestamp"], content["Columns"]
        sidecar.write_text(json.dumps(content))
    dataset.json("task-look_physio.json", {"timestamp": {"Units": "s"}, "Columns": list(IN_WORLD), "Cohort": "all"})
    dataset.json("sub-a/ses-2/sub-a_ses-2_physio.json", {"timestamp": {"Units": "ms"}, "Cohort": "second"})
    dataset.json("task-other_physio.json", {"Columns": ["timestamp"]})
    rays = read("bids", dataset.folder)
    assert rays.persons == ("sub-a",) and rays.cohorts == ("all", "second")
    np.testing.assert_allclose(rays.t, np.r_[1000 * T, T])


def test_participants(dataset):
    for name in ("b", "a"):
        dataset.gaze(IN_WORLD, f"sub-{name}/beh/sub-{name}_task-look_recording-eye1", **SYSTEM)
    dataset.text("participants.tsv", "participant_id\tgroup\tage\nsub-a\tpatients\t40\nsub-b\tn/a\t41\n")
    rays = read("bids", dataset.folder)
    assert rays.persons == ("sub-a", "sub-b") and rays.cohort is not None
    assert [rays.cohorts[c] for c in rays.cohort] == ["patients"] * N + ["unknown"] * N
    assert len(read("bids", dataset.folder / "sub-b")) == N


def of_eye(eye: str, origin, direction, **changes) -> dict[str, np.ndarray]:
    """Columns of an eye at rest, with a hit point two metres ahead."""
    groups = {"": np.add(origin, 2.0 * np.array(direction)), "origin": origin, "direction": direction}
    names = {"": "{}_coordinate", "origin": "origin_{}", "direction": "direction_{}"}
    columns = {names[g].format(a): np.full(N, v[k]) for g, v in groups.items() for k, a in enumerate("xyz")}
    return {"timestamp": 1000 * T, **columns, "confidence": np.full(N, 0.8 if eye == "left" else 0.6)} | changes


def write_eyes(dataset, left: dict, right: dict) -> None:
    for k, (eye, columns) in enumerate((("left", left), ("right", right)), 1):
        dataset.gaze(columns, f"sub-a/beh/sub-a_task-look_recording-eye{k}", **{**SYSTEM, "RecordedEye": eye})


LEFT, RIGHT = ((-0.03, 2, 1.6), (0.6, 0.8, 0)), ((0.03, 2, 1.6), (-0.6, 0.8, 0))


def test_eyes(dataset):
    write_eyes(dataset, of_eye("left", *LEFT), of_eye("right", *RIGHT))
    assert (read("bids", dataset.folder, eye="right").origin == RIGHT[0]).all()
    both = read("bids", dataset.folder)
    assert len(both) == N and both.metadata["eye"] == read("bids", dataset.folder, eye="both").metadata["eye"] == "both"
    np.testing.assert_allclose(both.origin, np.tile([0, 2, 1.6], (N, 1)), atol=1e-12)
    np.testing.assert_allclose(both.direction, np.tile([0, 1, 0], (N, 1)), atol=1e-12)
    np.testing.assert_allclose(both.hit, np.tile([0, 3.6, 1.6], (N, 1)), atol=1e-12)
    np.testing.assert_allclose(both.metadata["eye_distance"]["sub-a"], 0.06, rtol=1e-6)
    assert np.allclose(both.confidence, 0.6)
    dataset.gaze(IN_WORLD, "sub-a/beh/sub-a_task-look_recording-eye3", **{**SYSTEM, "RecordedEye": "cyclopean"})
    assert (read("bids", dataset.folder).origin[:, 0] == 1).all()
    assert len(read("bids", dataset.folder, eye="both")) == N
    with pytest.raises(NergError, check=mentions("eye")):
        read("bids", dataset.folder, eye="third")


def test_an_eye_that_was_not_seen(dataset):
    """Lost samples of an eye are n/a or have no confidence; then the other one is used alone."""
    left, right = of_eye("left", *LEFT), of_eye("right", *RIGHT)
    left["direction_x"][:10] = np.nan
    right["confidence"][20:30] = 0
    left["direction_y"][40:45] = right["direction_y"][40:45] = np.nan
    # A point of the right eye on a farther surface: the mean of both is on none.
    for k, axis in enumerate("xyz"):
        right[f"{axis}_coordinate"][50:] = RIGHT[0][k] + 3 * RIGHT[1][k]
    write_eyes(dataset, left, right)
    rays = read("bids", dataset.folder)
    expected = np.tile([0.0, 1, 0], (N, 1))
    expected[:10], expected[20:30] = RIGHT[1], LEFT[1]
    np.testing.assert_allclose(rays.direction, np.delete(expected, np.s_[40:45], axis=0), atol=1e-12)
    assert [RIGHT[0], LEFT[0]] == [tuple(rays.origin[k]) for k in (0, 20)]
    assert np.allclose(rays.confidence[[0, 20]], [0.6, 0.8])
    assert dropped(rays) == {"no eye was seen": [[41, 45]]}
    assert rays.hit is not None
    assert np.isnan(rays.hit).any(axis=1).tolist() == [False] * 45 + [True] * 10


def test_rows_of_both_eyes_are_paired_by_time(dataset):
    """The right eye is sampled a little later; each eye lacks rows, so that the files have different lengths."""
    keep = lambda columns, rows: {name: values[rows] for name, values in columns.items()}
    left = keep(of_eye("left", *LEFT), np.r_[5:N])
    right = keep(of_eye("right", *RIGHT, timestamp=1000 * T + 5), np.r_[0:20, 30:N])
    write_eyes(dataset, left, right)
    rays = read("bids", dataset.folder)
    order = np.argsort(rays.t)
    np.testing.assert_allclose(rays.t[order], np.r_[T[:5] + 0.005, T[5:]])
    expected = np.tile([0.0, 1, 0], (N, 1))
    expected[:5], expected[20:30] = RIGHT[1], LEFT[1]
    np.testing.assert_allclose(rays.direction[order], expected, atol=1e-12)
    assert rays.metadata["rows_read"] == len(left["timestamp"]) + len(right["timestamp"]) - (N - 15)


def test_both_eyes_in_the_head(dataset):
    dataset.motion("ALS")
    for k, (eye, angle) in enumerate((("left", 3.0), ("right", -3.0)), 1):
        columns = {**ANGLES, "x_coordinate": GAZE[:, 0] + angle}
        dataset.gaze(columns, f"sub-01/beh/sub-01_task-walk_recording-eye{k}", RecordedEye=eye)
    rays = read("bids", dataset.folder)
    # The mean of two directions of one elevation is a little higher than these.
    np.testing.assert_allclose(rays.direction, world_gaze(), atol=2e-3)
    np.testing.assert_allclose(rays.origin, HEAD, atol=1e-9)
    assert sum("motion.tsv" in source["file"] for source in rays.metadata["sources"]) == 1


def test_two_files_of_one_eye_are_refused(dataset):
    write_eyes(dataset, of_eye("left", *LEFT), of_eye("right", *RIGHT))
    dataset.gaze(IN_WORLD, "sub-a/beh/sub-a_task-look_recording-eye3", **{**SYSTEM, "RecordedEye": "left"})
    with pytest.raises(NergError, match="RecordedEye"):
        read("bids", dataset.folder)
    assert len(read("bids", dataset.folder / "sub-a/beh/sub-a_task-look_recording-eye3_physio.tsv.gz")) == N


# ---- Refusals ----


@pytest.mark.parametrize(
    "change, message",
    [
        ({"SampleCoordinateSystem": "gaze-on-screen"}, "screen in the world"),
        ({"WorldCoordinateSystem": None}, "custom"),
        ({"SampleCoordinateSystem": "eye-in-head"}, "pose of the head"),
        ({"Columns": [*IN_WORLD][:-1]}, "custom"),
        ({"SampleCoordinateSystem": "gaze-in-world", "WorldCoordinateSystem": None}, "up, handedness"),
        ({"timestamp": {}}, "set it .tick"),
        ({"origin_x": {"Units": "pixel"}}, "scene camera"),
        ({"Columns": None}, "Columns"),
        ({"Columns": ["x", "y"]}, "timestamp"),
        ({"PhysioType": "generic"}, "eye tracking"),
    ],
)
def test_refused_metadata(dataset, change, message):
    dataset.gaze(IN_WORLD, **{**SYSTEM, **change})
    with pytest.raises(NergError, match=message):
        read("bids", dataset.folder)


def test_pixels_of_a_scene_camera_are_refused(dataset):
    """Some programs write these as gaze-in-world."""
    dataset.motion("ALS")
    columns = {name: ANGLES[name] for name in ANGLES}
    dataset.gaze(columns, SampleCoordinateSystem="gaze-in-world", x_coordinate={"Units": "pixel"})
    with pytest.raises(NergError, match="scene camera"):
        read("bids", dataset.folder)


def test_tick(dataset):
    dataset.gaze(IN_WORLD, **{**SYSTEM, "timestamp": {}})
    np.testing.assert_allclose(read("bids", dataset.folder, tick=1e-3).t, T)


def test_folders_that_are_no_dataset(tmp_path):
    with pytest.raises(NergError, match="BIDS dataset"):
        read("bids", tmp_path)
    (tmp_path / "dataset_description.json").write_text("[1]")
    with pytest.raises(NergError, match="JSON object"):
        read("bids", tmp_path)
    (tmp_path / "dataset_description.json").write_text("{}")
    with pytest.raises(NergError, match="eye tracking"):
        read("bids", tmp_path)


def test_frames_that_differ_are_refused(dataset):
    dataset.gaze(IN_WORLD, "sub-a/beh/sub-a_task-one_recording-eye1", **SYSTEM)
    other = {**SYSTEM, "WorldCoordinateSystem": {**WORLD, "UpAxis": "y"}}
    dataset.gaze(IN_WORLD, "sub-a/beh/sub-a_task-two_recording-eye1", **other)
    with pytest.raises(NergError, check=mentions("task")):
        read("bids", dataset.folder)
    assert len(read("bids", dataset.folder, task="two")) == N
