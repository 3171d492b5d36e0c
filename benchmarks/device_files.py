"""What people in the store would have left behind, had they worn each kind of device: its files, in its own frame.

A writer for each device is given a `Walk` a person, and writes their recordings into a folder. The frames are right for
the device (`Device.frame`): glasses begin their own world, Unity's is left-handed with y up, motion capture counts
millimetres from the laboratory's corner.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.alignment.umeyama import move
from nerg_mi.rays.readers.frames import UNITY
from nerg_mi.rays.readers.glasses.aria_gaze import cpf_in_device

import numpy as np
from scipy.spatial.transform import Rotation

EYES = 0.063  # metres between the eyes
START = 1_700_000_000_000_000_000  # nanoseconds: what times of day look like
TO_UNITY = np.linalg.inv(UNITY.to_rays())[:3, :3]


@dataclass(frozen=True)
class Walk:
    """A person's n samples in the store's frame, z up, metres: seconds ``t`` from the recording's start, ``eye``,
    ``gaze`` and ``hit`` (n, 3), and the ``head``, whose x is right, y ahead and z up."""

    name: str
    t: np.ndarray
    eye: np.ndarray
    gaze: np.ndarray
    hit: np.ndarray
    head: Rotation

    def moved(self, matrix: np.ndarray) -> Walk:
        """As seen from a frame into which the rigid ``matrix`` (4, 4) takes the store's."""
        turn = Rotation.from_matrix(matrix[:3, :3])
        return Walk(
            self.name, self.t, move(matrix, self.eye), turn.apply(self.gaze), move(matrix, self.hit), turn * self.head
        )


def make_walks(people: int, seed: int) -> list[Walk]:
    """Shoppers of the store who look as its law has it; heads point where the eyes do, to some 8 degrees."""
    from nerg_mi.jobs.backend import select_backend
    from nerg_mi.scenes.store import twin
    from nerg_mi.scenes.store.layout import build
    from nerg_mi.scenes.store.shoppers import simulate

    select_backend("llvm_ad_rgb")
    ids, times, eye, gaze = simulate(build(0), shoppers=people, seed=seed)
    hit = eye + gaze * twin.cast(eye, gaze)[:, None]
    rng = np.random.default_rng(seed)
    walks = []
    for name in np.unique(ids):
        at = np.flatnonzero(ids == name)
        ahead = gaze[at] + rng.normal(0, 0.1, (len(at), 3))
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        right = np.cross(ahead, [0, 0, 1])
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        head = Rotation.from_matrix(np.stack([right, ahead, np.cross(right, ahead)], axis=2))
        t = (times[at] - times[at][0]) / 1000
        walks.append(Walk(str(name), t, eye[at], gaze[at], hit[at], head))
    return walks


def table(path: Path, columns: dict[str, np.ndarray | Sequence], separator: str = ",") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = zip(*columns.values())
    text = "\n".join([separator.join(columns), *(separator.join(map(str, row)) for row in rows)]) + "\n"
    path.write_bytes(gzip.compress(text.encode(), mtime=0) if path.suffix == ".gz" else text.encode())


def xyz(stem: str, values: np.ndarray, axes: str = "xyz") -> dict[str, np.ndarray]:
    return {stem.format(axis): column for axis, column in zip(axes, np.round(values, 7).T)}


def aria(walks: Sequence[Walk], folder: Path) -> None:
    """Folders with ``eye_gaze`` and ``slam`` of the first generation's glasses."""
    turn, origin = cpf_in_device("DVT-L")
    to_cpf = Rotation.from_matrix([[-1, 0, 0], [0, 0, 1], [0, 1, 0]])  # x left, y up, z ahead, from right, ahead, up
    for walk in walks:
        us = np.round(walk.t * 1e6).astype(np.int64)
        cpf = walk.head * to_cpf.inv()
        seen = cpf.inv().apply(walk.gaze)
        device = cpf * Rotation.from_matrix(turn).inv()
        place = walk.eye - device.apply(origin)
        one = np.ones(len(us))
        angles = np.arctan(seen[:, :2] / seen[:, 2:])
        gaze = {"tracking_timestamp_us": us, "yaw_rads_cpf": angles[:, 0], "pitch_rads_cpf": angles[:, 1]}
        table(folder / walk.name / "eye_gaze" / "general_eye_gaze.csv", gaze | {"depth_m": 0 * one})
        pose = {"graph_uid": ["shop"] * len(us), "tracking_timestamp_us": us, "utc_timestamp_ns": -one}
        pose |= xyz("t{}_world_device", place) | xyz("q{}_world_device", device.as_quat(), "xyzw")
        pose |= xyz("gravity_{}_world", np.tile([0, 0, -9.81], (len(us), 1))) | {"quality_score": one}
        table(folder / walk.name / "slam" / "closed_loop_trajectory.csv", pose)


def points(of: np.ndarray, path: Path) -> None:
    """``semidense_points.csv.gz``: points (n, 3) of the place in the glasses' world, known to a centimetre."""
    small = np.full(len(of), 0.005)
    known = {"uid": np.arange(len(of)), "graph_uid": ["shop"] * len(of)} | xyz("p{}_world", of)
    table(path, known | {"inv_dist_std": small, "dist_std": small})


def quest(walks: Sequence[Walk], folder: Path) -> None:
    """Logs of OVREyeGaze: places and rotations of both eyes in Unity's frame."""
    for walk in walks:
        right = walk.head.apply([1, 0, 0])
        side = np.cross(walk.gaze, [0, 0, 1])
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        eye = np.stack([side, walk.gaze, np.cross(side, walk.gaze)], axis=2)
        turn = Rotation.from_matrix(TO_UNITY @ eye @ TO_UNITY.T).as_quat()
        columns = {"time": walk.t}
        for name, sign in (("left", -1), ("right", 1)):
            place = (walk.eye + sign * EYES / 2 * right) @ TO_UNITY.T
            columns |= xyz(f"{name}_eye_position_{{}}", place) | xyz(f"{name}_eye_rotation_{{}}", turn, "xyzw")
            columns[f"{name}_eye_confidence"] = np.ones(len(place))
        table(folder / f"{walk.name}.csv", columns)


def neon(walks: Sequence[Walk], folder: Path) -> None:
    """Folders of Pupil Cloud's download, and beside them the model in which the frames of the videos are posed."""
    focal, size = 890.0, np.array([1600, 1200])
    to_camera = Rotation.from_matrix([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # x right, y down, z ahead
    flip = np.diag([1.0, -1.0, -1.0])  # to OpenGL's axes of a transforms file
    frames = []
    for walk in walks:
        at = folder / walk.name
        ns = START + np.round(walk.t * 1e9).astype(np.int64)
        camera = walk.head * to_camera.inv()
        seen = camera.inv().apply(walk.gaze)
        pixel = size / 2 + focal * seen[:, :2] / seen[:, 2:]
        angles = np.degrees([np.arctan2(seen[:, 0], seen[:, 2]), np.arcsin(-seen[:, 1])])
        words = {"section id": ["s"] * len(ns), "recording id": ["r"] * len(ns)}
        time = {"timestamp [ns]": ns}
        gaze = {
            "gaze x [px]": pixel[:, 0],
            "gaze y [px]": pixel[:, 1],
            "worn": [1] * len(ns),
            "blink id": [""] * len(ns),
        }
        table(at / "gaze.csv", words | time | gaze | {"azimuth [deg]": angles[0], "elevation [deg]": angles[1]})
        table(at / "world_timestamps.csv", words | time)
        (at / "info.json").write_text(json.dumps({"start_time": START, "wearer_name": walk.name}))
        lens = [[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]]
        (at / "scene_camera.json").write_text(
            json.dumps({"camera_matrix": lens, "distortion_coefficients": [[0.0] * 8]}, default=float)
        )
        for k, (turn, place) in enumerate(zip(camera.as_matrix() @ flip, walk.eye)):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = turn, place
            frames.append({"file_path": f"{walk.name}/frame_{k + 1:05d}.jpg", "transform_matrix": pose.tolist()})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))


def arett(walks: Sequence[Walk], folder: Path) -> None:
    """Logs of ARETT on a HoloLens 2, which meets the mesh that it has made of the place."""
    for walk in walks:
        ms = np.round(walk.t * 1000).astype(np.int64)
        yes = ["True"] * len(ms)
        times = {"eyeDataTimestamp": START // 10**6 + ms, "eyeDataRelativeTimestamp": ms, "frameTimestamp": ms}
        gaze = {"isCalibrationValid": yes, "gazeHasValue": yes} | xyz("gazeOrigin_{}", walk.eye @ TO_UNITY.T)
        gaze |= xyz("gazeDirection_{}", walk.gaze @ TO_UNITY.T) | {"gazePointHit": yes}
        gaze |= xyz("gazePoint_{}", walk.hit @ TO_UNITY.T)
        table(folder / f"{walk.name}.csv", times | gaze)


def qualisys(walks: Sequence[Walk], folder: Path) -> None:
    """Two files a person, of an eye each, millimetres."""
    for walk in walks:
        right = walk.head.apply([1, 0, 0])
        for eye, sign in ((1, -1), (2, 1)):
            path = folder / f"{walk.name}_g_{eye}.tsv"
            place = 1000 * (walk.eye + sign * EYES / 2 * right)
            times = {"Sample": np.arange(len(place)) + 1, "Time": walk.t}
            columns = times | xyz("{} Pos", place, "XYZ") | xyz("{} Vec", walk.gaze, "XYZ")
            table(path, columns, "\t")
            head = f"FILE_VERSION\t2.0.0\nGAZE_VECTOR_NAME\t{walk.name} ({eye})\nNO_OF_SAMPLES\t{len(place)}\n"
            path.write_text(head + "FREQUENCY\t5\n" + path.read_text())


def angles(walks: Sequence[Walk], folder: Path) -> None:
    """One table of a program of one's own in Unity: gaze as angles in the head's frame, nanoseconds."""
    parts = []
    for walk in walks:
        seen = walk.head.inv().apply(walk.gaze)
        turn = TO_UNITY @ walk.head.as_matrix() @ TO_UNITY.T
        columns = {"id": [walk.name] * len(walk.t), "timestamp [ns]": np.round(walk.t * 1e9).astype(np.int64)}
        columns |= xyz("h{}", walk.eye @ TO_UNITY.T) | xyz("q{}", Rotation.from_matrix(turn).as_quat(), "xyzw")
        columns["azimuth [deg]"] = np.degrees(np.arctan2(seen[:, 0], seen[:, 1]))
        columns["elevation [deg]"] = np.degrees(np.arcsin(np.clip(seen[:, 2], -1, 1)))
        parts.append(columns)
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    table(folder / "log.csv", whole)


Writer = Callable[[Sequence[Walk], Path], None]
