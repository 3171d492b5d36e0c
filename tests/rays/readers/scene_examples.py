"""Small recordings of glasses with a scene camera, beside a model that holds the poses of frames of their video."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from nerg_mi.rays.readers.scene_glasses import FrameNames
from tests.files.movies import box_table, movie

START = 1_700_000_000_000_000_000  # nanoseconds: what times of day look like
LENS = {"k1": -0.13, "k2": 0.11, "p1": 0.0005, "p2": -0.0004, "k3": 0.01, "k4": 0.17, "k5": 0.05, "k6": 0.02}
"""Of about a Neon, in OpenCV's order."""
MATRIX = [[891.0, 0.0, 810.0], [0.0, 890.0, 605.0], [0.0, 0.0, 1.0]]
FRAMES = FrameNames("scene/frame_{frame1}")


def model(count: int = 8, step: float = 0.1) -> str:
    """A transforms file of ``count`` frames that go along x at 1.6 m and look along y (OpenGL), and of a photo."""
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
    """Writes a video without pictures, whose frames are shown at ``times`` (F,), seconds, rising: the first one by an
    edit that shows nothing before it, the others by the durations of those before them."""
    shown = np.rint(np.asarray(times) * ticks).astype(int)
    durations = np.diff(shown, append=2 * shown[-1:] - shown[-2:-1])
    runs = struct.pack(f">{2 * len(durations)}I", *np.stack([np.ones_like(durations), durations], axis=1).ravel())
    edits = struct.pack(">IiiIii", shown[0], -1, 1 << 16, durations.sum(), 0, 1 << 16)
    data = movie(ticks, ticks, box_table(b"stts", len(durations), runs), edits=box_table(b"elst", 2, edits))

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
    """Matrices (rows) as OpenCV's FileStorage writes them."""
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
