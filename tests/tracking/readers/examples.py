"""A small recording for each reader, used by tests and the fuzzer. A new reader needs one here."""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Callable, Sequence
from csv import DictReader
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nerg_mi.tracking.rays import Rays
from nerg_mi.tracking.readers.columns import ColumnMap
from nerg_mi.tracking.readers.registry import make_options, read_rays
from nerg_mi.tracking.readers.scene_glasses import FrameNames
from nerg_mi.tracking.readers.skeleton import keypoints_from_head, write_skeleton
from tests.files.movies import make_box_table, make_movie


def read(name: str, *files, skip_bad_lines: bool = False, **options) -> Rays:
    """The rays of ``files`` from the reader ``name`` with these options."""
    return read_rays(name, files, make_options(name, options), skip_bad_lines=skip_bad_lines)


def dropped(rays: Rays) -> dict[str, list]:
    """Rows that were dropped, by reason."""
    return {d["reason"]: d["rows"] for d in rays.metadata["dropped"]}


def csv_rows(path: Path) -> list[dict[str, str]]:
    """Rows of a recorded table, read with the standard library."""
    with gzip.open(path, "rt") if path.name.endswith(".gz") else open(path) as file:
        return list(DictReader(file))


# ---- C3D files, written by the format's manual (c3d.org) without the package that reads them ----


def _entry(name: str, number: int, body: bytes) -> bytes:
    return struct.pack("bb", len(name), number) + name.encode() + struct.pack("<h", len(body) + 3) + body + b"\0"


def _words(*texts: str) -> bytes:
    width = max(map(len, texts))
    shape = [width, len(texts)] if len(texts) > 1 else [width]
    return bytes([0xFF, len(shape), *shape]) + "".join(t.ljust(width) for t in texts).encode()


def write_c3d(
    path: Path,
    labels: Sequence[str],
    positions: np.ndarray,
    *,
    rate: float = 100.0,
    units: str | None = "mm",
    up: str | None = "+Z",
    frames: int | None = None,
) -> None:
    """Write ``positions`` (F, M, 3), NaN for missing markers. ``frames`` is the number of frames in the header."""
    count, markers = positions.shape[:2]
    claimed = count if frames is None else frames
    parameters = [
        _entry("POINT", -1, b""),
        _entry("USED", 1, b"\2\0" + struct.pack("<H", markers)),
        _entry("SCALE", 1, b"\4\0" + struct.pack("<f", -1.0)),
        _entry("RATE", 1, b"\4\0" + struct.pack("<f", rate)),
        _entry("FRAMES", 1, b"\2\0" + struct.pack("<H", claimed)),
        _entry("LABELS", 1, _words(*labels)),
    ]
    if units is not None:
        parameters.append(_entry("UNITS", 1, _words(units)))
    if up is not None:
        parameters += [_entry("X_SCREEN", 1, _words("+X")), _entry("Y_SCREEN", 1, _words(up))]
    blocks = -(-(4 + sum(map(len, parameters)) + 2) // 512)
    parameters.append(_entry("DATA_START", 1, b"\2\0" + struct.pack("<H", 2 + blocks)))
    header = struct.pack("<BBHHHHHfHHf", 2, 0x50, markers, 0, 1, claimed, 10, -1.0, 2 + blocks, 0, rate)
    unseen = np.asarray(np.isnan(positions).any(axis=2))
    points = np.concatenate([np.where(unseen[..., None], 0, positions), np.where(unseen, -1.0, 0.0)[..., None]], axis=2)
    body = bytes([1, 0x50, blocks, 84]) + b"".join(parameters)
    path.write_bytes(header.ljust(512, b"\0") + body.ljust(512 * blocks, b"\0") + points.astype("<f4").tobytes())


def write_heads(path: Path) -> None:
    """A head with the four markers of Plug-in Gait that walks and looks along x, and a marker of the trunk."""
    head = np.array([[70, 60, 1700], [70, -60, 1700], [-90, 60, 1700], [-90, -60, 1700], [0, 0, 1300]], float)
    walk = np.arange(20)[:, None, None] * [10.0, 0, 0]
    write_c3d(path, ["LFHD", "RFHD", "LBHD", "RBHD", "C7"], head + walk)


# ---- Logs of headsets in the style of each program ----

ARETT_HEAD = (
    "eyeDataTimestamp,eyeDataRelativeTimestamp,frameTimestamp,isCalibrationValid,gazeHasValue,"
    "gazeOrigin_x,gazeOrigin_y,gazeOrigin_z,gazeDirection_x,gazeDirection_y,gazeDirection_z,"
    "gazePointHit,gazePoint_x,gazePoint_y,gazePoint_z,gazePoint_target_name,infoText"
)


def xyz(stem: str, axes: str = "xyz") -> list[str]:
    return [f"{stem}{axis}" for axis in axes]


def csv(head: list[str] | str, rows) -> str:
    head = head if isinstance(head, str) else ",".join(head)
    return "\n".join([head, *(",".join(map(str, row)) for row in rows)]) + "\n"


def arett(origin, direction, hit, seen, calibrated) -> str:
    """``hit`` (n, 3) is NaN without a hit."""
    rows = []
    for k, (o, d, h) in enumerate(zip(origin, direction, hit)):
        has_hit = bool(np.isfinite(h).all())
        present = [*o, *d] if seen[k] else [""] * 6
        point = [*h, '"wall, left"'] if has_hit else ["", "", "", ""]
        rows.append([1_700_000_000_000 + 33 * k, 33 * k, 33 * k, calibrated[k], seen[k], *present, has_hit, *point, ""])
    return csv(ARETT_HEAD, rows)


def sranipal(t_ms, head, turn: Rotation, both_eyes: dict[str, tuple], style: str = "verbose_data.{}.{}.{}") -> str:
    """``eyes``: origins in mm and directions (n, 3) by side (combined, left, right), and masks (n,) of the SDK."""
    columns, names = [t_ms, *np.transpose(head), *turn.as_quat().T], ["time_stamp(ms)", *xyz("head_pos_")]
    names += xyz("head_rot_", "xyzw")
    for side, (origin, direction, mask) in both_eyes.items():
        part = "combined.eye_data" if side == "combined" and "verbose" in style else side
        names += [style.format(part, "gaze_origin_mm", a) for a in "xyz"]
        names += [style.format(part, "gaze_direction_normalized", a) for a in "xyz"]
        names.append(style.format(part, "eye_data_validata_bit_mask", "").rstrip("._"))
        columns += [*np.transpose(origin), *np.transpose(direction), mask]
    return csv(names, zip(*columns))


def openxr(t_ns, place, turn: Rotation, flags, active) -> str:
    head = ["time", *xyz("gaze_position_"), *xyz("gaze_orientation_", "xyzw"), "location_flags", "is_active"]
    return csv(head, zip(t_ns, *np.transpose(place), *turn.as_quat().T, flags, active))


def quest(t, left, right, turns: tuple[Rotation, Rotation], confidences: tuple, rig: tuple | None = None) -> str:
    """Positions and rotations of both eyes, their confidences, and the pose of the rig."""
    head, columns = ["Time"], [t]
    for side, place, turn, confidence in zip(("Left", "Right"), (left, right), turns, confidences):
        head += [*xyz(f"{side}EyePosition", "XYZ"), *xyz(f"{side}EyeRotation", "XYZW"), f"{side}EyeConfidence"]
        columns += [*np.transpose(place), *turn.as_quat().T, confidence]
    if rig is not None:
        head += [*xyz("RigPosition", "XYZ"), *xyz("RigRotation", "XYZW")]
        columns += [*np.transpose(rig[0]), *rig[1].as_quat().T]
    return csv(head, zip(*columns))


def motive(t, bodies: dict[str, tuple], units="Meters", rotation="Quaternion", space="Global") -> str:
    """Bodies by name, each with positions (n, 3) and rotations, and with a marker and an error."""
    axes = [*(("Rotation", a) for a in "XYZW"), *(("Position", a) for a in "XYZ"), ("Mean Marker Error", "")]
    columns = [("Rigid Body", name, *axis) for name in bodies for axis in axes]
    columns += [("Rigid Body Marker", f"{name}:Marker1", "Position", a) for name in bodies for a in "XYZ"]
    kinds, names, whats, letters = zip(*columns)
    cells = [np.c_[turn.as_quat(), place, np.full(len(t), 1e-4)] for place, turn in bodies.values()]
    rows = np.hstack([*cells, *(place for place, _ in bodies.values())])
    header = f"Format Version,1.23,Take Name,T,Rotation Type,{rotation},Length Units,{units},Coordinate Space,{space}"
    above = [["", "Type", *kinds], ["", "Name", *names], ["", "ID", *["1"] * len(kinds)], ["", "", *whats]]
    samples = ([k, *row] for k, row in enumerate(np.c_[t, rows].tolist()))
    head = [header, "", *map(",".join, above), ",".join(["Frame", "Time (Seconds)", *letters])]
    return csv("\n".join(head), (["" if v != v else v for v in row] for row in samples))


_N = 6
_K = np.arange(_N)
_EYE_POSITIONS = np.c_[0.1 * _K, np.full(_N, 1.6), np.zeros(_N)]
_STILL = Rotation.from_quat(np.tile([0.0, 0, 0, 1], (_N, 1)))
_AHEAD = np.tile([0.0, 0, 1], (_N, 1))

ARETT = {"ann.csv": arett(_EYE_POSITIONS, _AHEAD, _EYE_POSITIONS + 2 * _AHEAD, [True] * _N, [True] * _N)}
SRANIPAL = {
    "ann.csv": sranipal(20 * _K, _EYE_POSITIONS, _STILL, {"combined": (0 * _EYE_POSITIONS, _AHEAD, np.full(_N, 3))})
}
OPENXR = {"ann.csv": openxr(10_000_000 * _K, _EYE_POSITIONS, _STILL, np.full(_N, 15), np.ones(_N, int))}
QUEST = {"ann.csv": quest(0.02 * _K, _EYE_POSITIONS, _EYE_POSITIONS, (_STILL, _STILL), (np.ones(_N), np.ones(_N)))}
MOTIVE = motive(0.01 * _K, {"Head": (_EYE_POSITIONS, _STILL)})


# ---- Glasses with a scene camera, and a model with the poses of frames of their video ----

START = 1_700_000_000_000_000_000  # nanoseconds since 1970
LENS = {"k1": -0.13, "k2": 0.11, "p1": 0.0005, "p2": -0.0004, "k3": 0.01, "k4": 0.17, "k5": 0.05, "k6": 0.02}
"""Approximate calibration of a Neon, in OpenCV's order."""
MATRIX = [[891.0, 0.0, 810.0], [0.0, 890.0, 605.0], [0.0, 0.0, 1.0]]
FRAMES = FrameNames("scene/frame_{frame1}")


def model(count: int = 8, step: float = 0.1) -> str:
    """A transforms file of ``count`` frames that move along x at 1.6 m and look along y (OpenGL), and of a photo."""
    look = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    frames = [
        {
            "file_path": f"scene/frame_{k + 1:05d}.jpg",
            "transform_matrix": np.vstack([np.c_[look, [step * k, 0, 1.6]], [0, 0, 0, 1]]).tolist(),
        }
        for k in range(count)
    ]
    photo = {**frames[0], "file_path": "images/IMG_0001.jpg"}
    return json.dumps({"frames": [photo, *frames]})


def table(head: str, rows: list[list], separator: str = ",") -> str:
    return "\n".join([head, *(separator.join(map(str, row)) for row in rows)]) + "\n"


def frame_ns(count: int = 8, fps: float = 30.0) -> list[int]:
    return [START + 10_000_000 + round(k * 1e9 / fps) for k in range(count)]


NEON = {
    "transforms.json": model(),
    "info.json": json.dumps({"start_time": START, "wearer_name": "ann"}),
    "scene_camera.json": json.dumps({"camera_matrix": MATRIX, "distortion_coefficients": [list(LENS.values())]}),
    "world_timestamps.csv": table("section id,recording id,timestamp [ns]", [["s", "r", t] for t in frame_ns()]),
    "gaze.csv": table(
        "section id,recording id,timestamp [ns],gaze x [px],gaze y [px],worn,fixation id,blink id,"
        "azimuth [deg],elevation [deg]",
        [["s", "r", t + 1_000_000, 810, 605, 1.0, "", "", 0.0, 0.0] for t in frame_ns(7)],
    ),
}

CALIBRATION_G3 = {
    "position": [1.5, 25.0, -8.0],
    "rotation": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "focal-length": [920.0, 921.0],
    "principal-point": [955.0, 540.0],
    "skew": 0.0,
    "resolution": [1920, 1080],
    "radial-distortion": [-0.05, 0.06, -0.02],
    "tangential-distortion": [0.0003, 0.0001],
}


def video(times: np.ndarray, ticks: int = 24_950) -> Callable[[Path], None]:
    """Write a video without images, whose frames are shown at ``times`` (F,) seconds, increasing: the first one by an
    edit with an empty start, the others by the durations of those before them."""
    shown = np.rint(np.asarray(times) * ticks).astype(int)
    durations = np.diff(shown, append=2 * shown[-1:] - shown[-2:-1])
    runs = struct.pack(f">{2 * len(durations)}I", *np.stack([np.ones_like(durations), durations], axis=1).ravel())
    edits = struct.pack(">IiiIii", shown[0], -1, 1 << 16, durations.sum(), 0, 1 << 16)
    data = make_movie(
        ticks, ticks, make_box_table(b"stts", len(durations), runs), edits=make_box_table(b"elst", 2, edits)
    )

    def write(path: Path) -> None:
        path.write_bytes(data)

    return write


def sample_g3(t: float, gaze2d: list | None, gaze3d: list | None) -> str:
    data = {} if gaze2d is None else {"gaze2d": gaze2d, "gaze3d": gaze3d}
    return json.dumps({"type": "gaze", "timestamp": t, "data": data})


TOBII = {
    "transforms.json": model(),
    "recording.g3": json.dumps({"name": "r", "scenecamera": {"camera-calibration": CALIBRATION_G3}}),
    "scenevideo.mp4": video(np.arange(8) / 24.95),
    "gazedata.gz": "\n".join(sample_g3(0.01 + 0.04 * k, [955 / 1920, 0.5], [-1.5, 25.0, -1000.0]) for k in range(7))
    + "\n",
}


def opencv_xml(**matrices: list) -> str:
    """Matrices (rows) as written by OpenCV's FileStorage."""
    out = '<?xml version="1.0"?>\n<opencv_storage>\n'
    for name, m in matrices.items():
        rows = np.atleast_2d(np.array(m, float).T if np.ndim(m) == 1 else np.array(m, float))
        data = " ".join(repr(float(x)) for x in rows.ravel())
        out += (
            f'<{name} type_id="opencv-matrix">\n  <rows>{rows.shape[0]}</rows>\n  <cols>{rows.shape[1]}</cols>\n'
            f"  <dt>d</dt>\n  <data>\n    {data}</data></{name}>\n"
        )
    return out + "</opencv_storage>\n"


GLASSESTOOLS = {
    "transforms.json": model(),
    "calibration.xml": opencv_xml(
        resolution=[1600, 1200], cameraMatrix=MATRIX, distCoeff=list(LENS.values()), rotation=np.eye(3).tolist()
    ),
    "frameTimestamps.tsv": table("frame_idx\ttimestamp", [[k, 40.0 * k] for k in range(8)], "\t"),
    "gazeData.tsv": table(
        "timestamp\tframe_idx\tgaze_pos_vid_x\tgaze_pos_vid_y", [[40.0 * k + 1, k, 810, 605] for k in range(7)], "\t"
    ),
}


# ---- Independent implementation of a scene camera, for comparison ----


def project(d: np.ndarray, matrix, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0) -> np.ndarray:
    """Pixels (n, 2) of directions (n, 3), x right, y down, z forward, by OpenCV's documentation."""
    x, y = d[:, 0] / d[:, 2], d[:, 1] / d[:, 2]
    r = np.hypot(x, y)
    f = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    u = x * f + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)
    v = y * f + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y
    return (np.array(matrix, float) @ np.stack([u, v, np.ones_like(u)])).T[:, :2]


def camera_angles(d: np.ndarray) -> np.ndarray:
    """Azimuth to the right and elevation up of the same directions, (n, 2) in degrees."""
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    return np.degrees(np.stack([np.arctan2(d[:, 0], d[:, 2]), -np.arcsin(d[:, 1])], axis=1))


def gaze_in_camera(n: int, seed: int = 0, max_angle: float = 0.55) -> np.ndarray:
    """Unit directions (n, 3) within a scene camera's image."""
    xy = np.random.default_rng(seed).uniform(-max_angle, max_angle, (n, 2))
    d = np.c_[xy, np.ones(n)]
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def slerp(a: np.ndarray, b: np.ndarray, u: float) -> np.ndarray:
    b = b if a @ b >= 0 else -b
    angle = max(np.arccos(min(a @ b, 1.0)), 1e-9)
    return (np.sin((1 - u) * angle) * a + np.sin(u * angle) * b) / np.sin(angle)


def rays_at(t: np.ndarray, times: np.ndarray, poses: np.ndarray, gaze: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions (n, 3) in the world of ``gaze`` (n, 3) at ``t`` (n,), between OpenGL ``poses``."""
    origin, direction = [], []
    quaternions = [Rotation.from_matrix(p[:3, :3]).as_quat() for p in poses]
    for now, (x, y, z) in zip(t, gaze):
        k = min(max(int(np.sum(times <= now)) - 1, 0), len(times) - 2)
        u = (now - times[k]) / (times[k + 1] - times[k])
        q = slerp(quaternions[k], quaternions[k + 1], u)
        origin.append((1 - u) * poses[k][:3, 3] + u * poses[k + 1][:3, 3])
        direction.append(Rotation.from_quat(q).apply([x, -y, -z]))
    return np.array(origin), np.array(direction)


# ---- An example of each reader ----


@dataclass(frozen=True)
class Example:
    """Files by name, as text or as a function that writes one; the last one is passed to the reader."""

    files: dict[str, str | Callable[[Path], None]]
    options: dict[str, Any] = field(default_factory=dict)

    def make(self, folder: Path) -> Path:
        """Write the files to ``folder``; returns the path for the reader."""
        for name, content in self.files.items():
            if callable(content):
                content(folder / name)
            elif name.endswith(".gz"):
                (folder / name).write_bytes(gzip.compress(content.encode(), mtime=0))
            else:
                (folder / name).write_text(content)
        return self.path_in(folder)

    def path_in(self, folder: Path) -> Path:
        """The path for the reader, of files in ``folder``."""
        return folder / list(self.files)[-1]

    def options_in(self, folder: Path) -> dict[str, Any]:
        """The options, with paths of files in ``folder``."""
        return {name: folder / v if isinstance(v, Path) else v for name, v in self.options.items()}


def lines(head: list[str] | None, row: Callable[[int], list], separator: str = ",", count: int = 8) -> str:
    """A table of ``count`` rows, with or without a header."""
    rows = [separator.join(map(str, row(k))) for k in range(count)]
    return "\n".join([*([separator.join(head)] if head else []), *rows]) + "\n"


def write_walk(path: Path) -> None:
    """Skeletons of two people."""
    body = keypoints_from_head(np.array([[0.1 * k, 0, 1.65] for k in range(6)]), np.tile([0.0, 1.0, 0.0], (6, 1)))
    write_skeleton(path, ["ann", "bo"] * 3, np.arange(6), body, decimals=2)


BIDS_RAY = [f"{name}_{axis}" for name in ("origin", "direction") for axis in "xyz"]
MAP = "origin=x,y,z direction=a,b,c t=t person=who confidence=conf hit=h,i,j"
TABLE = lines(
    "t,who,x,y,z,a,b,c,conf,h,i,j".split(","),
    lambda k: [f"{0.02 * k},{'ann' if k % 2 else 'bo'},0.{k},1,1.6,1,0.{k},0,1,{k},2,{'' if k % 3 else k}"],
    count=20,
)

SUPERMARKET = [f"ctw_{i}{j}" for i in range(3) for j in range(4)]
SUPERMARKET += "ray_x ray_y ray_z eye_x eye_y eye_z xc yc zc opennessl opennessr time".split()
_UNITY = "time id gaze_origin_x gaze_origin_y gaze_origin_z gaze_dir_x gaze_dir_y gaze_dir_z status".split()
_LOCAL = ["time", *(f"head_pos_{a}" for a in "xyz"), *(f"head_rot_{a}" for a in "xyzw")]
_LOCAL += [f"gaze_dir_{a}" for a in "xyz"]
_VARJO = "CaptureTime HMDPosition HMDRotation CombinedGazePosition CombinedGazeForward GazeStatus".split()
_POSES = ["timestamp", *(f"{what}_{axis}" for what in ("rotation", "translation") for axis in "xyz")]
_GAZE = ["gaze_timestamp", "confidence", *(f"gaze_normal{e}_{a}" for e in "01" for a in "xyz")]
_GAZE += [f"eye_center{e}_3d_{a}" for e in "01" for a in "xyz"]

ARIA_POSES = ["graph_uid", "tracking_timestamp_us", "utc_timestamp_ns", *(f"t{a}_world_device" for a in "xyz")]
ARIA_POSES += [f"q{a}_world_device" for a in "xyzw"] + [f"gravity_{a}_world" for a in "xyz"] + ["quality_score"]
_ARIA_GAZE = "tracking_timestamp_us yaw_rads_cpf pitch_rads_cpf depth_m".split()
_NAVGS = [
    f"{what}{a}" for what in ("Position", "Quaternion", "GazeQ") for a in ("XYZ" if what == "Position" else "XYZW")
]


def aria_pose(us: int, world: str = "w", place=(0, 0, 1.6), gravity=(0, 0, -9.81), turn=(0.5, 0.5, -0.5, 0.5)) -> list:
    """A row of an Aria trajectory; by default the wearer is upright."""
    return [world, us, -1, *place, *turn, *gravity, 1.0]


_ARIA_EYES = [f"{what}_{side}_eye_cpf" for side in ("left", "right") for what in ("tx", "ty", "tz")]
_ARIA_POSES = {"aria_trajectory.csv": lines(ARIA_POSES, lambda k: aria_pose(10_000 * k, world=f"w{k > 6}"))}
_ARIA_GEN2 = "tracking_timestamp_us yaw_rads_cpf pitch_rads_cpf left_pitch_rads_cpf right_pitch_rads_cpf".split()
_ARIA_VERGENCE = "tracking_timestamp_us left_yaw_rads_cpf right_yaw_rads_cpf pitch_rads_cpf depth_m".split()

_ARIA_VARIANTS = {
    "generalized_gaze.csv": lines(_ARIA_VERGENCE, lambda k: [9000 * k, 0.1, 0.12, -0.2, 1.5]),
    "eyegaze.csv": lines(
        [*_ARIA_GEN2, *_ARIA_EYES], lambda k: [9000 * k, 0.1, -0.2, -0.2, -0.2, 0.03, 0, 0, -0.03, 0, 0]
    ),
}
_BIDS_GAZE = {
    "PhysioType": "eyetrack",
    "RecordedEye": "cyclopean",
    "SampleCoordinateSystem": "custom",
    "WorldCoordinateSystem": {"UpAxis": "y", "Handedness": "left", "FloorHeight": 0},
    "timestamp": {"Units": "ms"},
    "origin_x": {"Units": "mm"},
    "Columns": ["timestamp", "x_coordinate", "y_coordinate", *BIDS_RAY, "confidence", "pupil_size"],
}
BIDS = {
    "dataset_description.json": json.dumps({"Name": "Walk", "BIDSVersion": "1.11.1"}),
    "task-walk_physio.json": json.dumps(_BIDS_GAZE),
    "sub-ann_task-walk_recording-eye1_physio.tsv.gz": lines(
        None, lambda k: [20 * k, "n/a", "n/a", 10 * k, 1600, 0, 0, 0.1, 1, 0.9, "n/a"], "\t"
    ),
}
_MOTION = "sub-ann_task-walk_tracksys-vr"
_CHANNELS = [("x", "POS", "m"), ("y", "POS", "m"), ("z", "POS", "m"), *((f"quat_{a}", "ORNT", "n/a") for a in "xyzw")]
_MOTION_FILES = {
    "dataset_description.json": BIDS["dataset_description.json"],
    f"{_MOTION}_channels.json": json.dumps({"reference_frame": {"Levels": {"w": {"SpatialAxes": "RSA"}}}}),
    f"{_MOTION}_channels.tsv": lines(
        "name component type tracked_point units reference_frame".split(),
        lambda k: [f"c{k}", *_CHANNELS[k][:2], "Head", _CHANNELS[k][2], "w"],
        "\t",
        len(_CHANNELS),
    ),
    f"{_MOTION}_motion.json": json.dumps({"SamplingFrequency": 50}),
    f"{_MOTION}_motion.tsv": lines(None, lambda k: [0.01 * k, 1.6, 0, 0, 0, 0, 1], "\t"),
}
_EYE_IN_HEAD = {
    "PhysioType": "eyetrack",
    "RecordedEye": "left",
    "SampleCoordinateSystem": "eye-in-head",
    "StartTime": 0.0,
    "timestamp": {"Units": "ms"},
    "x_coordinate": {"Units": "deg"},
    "Columns": ["timestamp", "x_coordinate", "y_coordinate"],
}
_BIDS_VARIANT = {
    **_MOTION_FILES,
    "sub-ann_scans.tsv": "filename\tacq_time\na.tsv\t2026-01-01T10:00:00\n",
    "participants.tsv": "participant_id\tgroup\nsub-ann\tfirst\n",
    "task-walk_physio.json": json.dumps(_EYE_IN_HEAD),
    "sub-ann_task-walk_recording-eye1_physio.tsv.gz": lines(None, lambda k: [20 * k, 0.5 * k, -5], "\t"),
}
VARIANTS = {
    "aria": [Example(_ARIA_POSES | {name: text}) for name, text in _ARIA_VARIANTS.items()],
    "bids": [Example(_BIDS_VARIANT)],
}
"""Further recordings that readers distinguish by their content, for the fuzzer in addition to `EXAMPLES`."""

_SCENE = {"poses": Path("transforms.json"), "frames": FRAMES}

EXAMPLES = {
    "skeleton": Example({"day.csv": write_walk}, {"tick": 0.1}),
    "c3d": Example({"ann.c3d": write_heads}),
    "unity": Example({"ann.csv": lines(_UNITY, lambda k: [0.02 * k, "ann", 0, 1.6, k, 0, 0, 1, "VALID"])}),
    "unity_local": Example({"ann.csv": lines(_LOCAL, lambda k: [0.02 * k, 0, 1.6, k, 0, 0, 0, 1, 0, 0.1, 1])}),
    "unity_head": Example({"ann.csv": lines(_LOCAL[:8], lambda k: [0.02 * k, 0, 1.6, k, 0, 0, 0, 1])}),
    "varjo": Example(
        {
            "ann.csv": lines(
                _VARJO, lambda k: [k * 10**7, "(0, 1.6, 0)", "(0, 0, 0, 1)", "(0, 0, 0)", "(0, 0, 1)", "VALID"], ";"
            )
        }
    ),
    "hololens": Example(
        {"a_head_hand_eye.csv": lines(None, lambda k: [k * 10**5, *[0] * 850, 1, 0, 1.6, 0, 1, 0, 0, 1, 0, 2])}
    ),
    "arett": Example(ARETT),
    "sranipal": Example(SRANIPAL),
    "openxr": Example(OPENXR),
    "quest": Example(QUEST),
    "pupil": Example(
        {
            "head_pose_tracker_poses.csv": lines(_POSES, lambda k: [0.02 * k, 0, 0, 0.1, k, 1, 1]),
            "gaze_positions.csv": lines(_GAZE, lambda k: [0.02 * k, 0.9, *[0, 0.1, 1] * 4]),
        },
        {"marker": 0.05},
    ),
    "qualisys": Example(
        {
            "ann_g.tsv": lines(
                ["X Pos", "Y Pos", "Z Pos", "X Vec", "Y Vec", "Z Vec"],
                lambda k: [10 * k, "" if k == 3 else 0, 1600, 0.1 * k, 1, -0.2],
                "\t",
            ).join(["GAZE_VECTOR_NAME\tann\nNO_OF_SAMPLES\t8\nFREQUENCY\t100\nSTART_OFFSET\t0.5\n", ""])
        }
    ),
    "motive": Example({"ann.csv": MOTIVE}),
    "neon_mocap": Example(
        {
            "gaze_in_mocap_space.csv": lines(
                ["", "timestamp [ns]", *(f"gaze_{what}_{a}" for what in ("origin", "dir") for a in "XYZ")],
                lambda k: [k, 1_700_000_000_000_000_000 + 10**7 * k, 0, 10 * k, 1600, 0.1, 1, -0.2],
            )
        },
        {"up": "z"},
    ),
    "aria": Example(
        {
            "closed_loop_trajectory.csv": lines(ARIA_POSES, lambda k: aria_pose(10_000 * k, place=(0.01 * k, 0, 1.6))),
            "general_eye_gaze.csv": lines(_ARIA_GAZE, lambda k: [10_000 * k + 500, 0.1, -0.2, "" if k % 2 else 1.5]),
        }
    ),
    "eyenavgs": Example(
        {
            "scene_setting.csv": 'Scene_Name,Quaternion,Scale,Initial_Position\nroom,"0, 0, 0, 1",2,"0, 0.8, 0"\n',
            "user1_room.csv": lines(
                ["ViewIndex", *_NAVGS, "Timestamp"],
                lambda k: [k % 2, 0.1 * k, 0.8, 0, 0, 0.1 * (k // 2), 0, 1, 0.1, 0.02 * k, 0, 1, 14 * (k // 2)],
            ),
        }
    ),
    "vr_supermarket": Example(
        {
            "user1.csv.gz": lines(
                SUPERMARKET,
                lambda k: [1, 0, 0, k, 0, 1, 0, 1.6, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 1, k, 0.9, 0.8, 0.02 * k],
            )
        }
    ),
    "bids": Example(BIDS),
    "neon": Example(NEON, _SCENE),
    "tobii3": Example(TOBII, _SCENE),
    "glassestools": Example(GLASSESTOOLS, _SCENE),
    "table": Example({"gaze.csv": TABLE}, {"columns": ColumnMap.parse(MAP)}),
}
