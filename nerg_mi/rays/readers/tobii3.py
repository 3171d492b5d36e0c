"""Tobii Pro Glasses 3: a recording's folder as the recording unit writes it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import BadLineCallback, read_line_blocks, parse_json, read_json, resolve_path
from nerg_mi.files.video import read_frame_times

from .base import DESCRIPTION, RaysBuilder, Signature
from .scene_glasses import POSES, WHERE_CAMERA, GazeBlock, Recording, SceneCamera, SceneReader, angles_between

_RECORDING, _VIDEO = "recording.g3", "scenevideo.mp4"
_UNUSED = 100  # parts of samples that are not used and named
_BLOCK = 1 << 14  # lines taken apart at a time
_JSON = 1 << 20  # bytes of recording.g3, at most


@dataclass(frozen=True, eq=False)
class CalibratedGlasses:
    """``camera``, ``size`` of its pictures in pixels, and how the head unit's axes lie in it."""

    camera: SceneCamera
    size: tuple[float, float]
    rotation: np.ndarray  # (3, 3)
    position: np.ndarray  # (3,) millimetres


@dataclass(frozen=True, eq=False, kw_only=True)
class _Tobii(Recording):
    glasses: CalibratedGlasses


class Tobii3(SceneReader[_Tobii]):
    """Folders with ``gazedata.gz`` (JSON, a line a sample) and ``recording.g3``, whose scene camera is calibrated.

    A ray starts at the scene camera's centre, and goes through the undistorted ``gaze2d``. ``gaze3d``, millimetres in
    the head unit's axes, is turned into the camera by the calibration's rotation and compared. Samples without gaze are
    dropped. Seconds count from the recording's start, as those of its video ``scenevideo.mp4``, whose frames have the
    times that its tables tell: some 24.95 a second, with gaps where frames were lost. The person is the folder.
    """

    name = "tobii3"
    files = (
        "folders of Tobii Pro Glasses 3 (or the `gazedata.gz` in them) with their scene video, beside the scene "
        "camera's poses"
    )
    checked_on = DESCRIPTION
    gaze_file = "gazedata.gz"
    signature = Signature(files=(("gazedata.gz", "recording.g3"),), options=POSES, question=WHERE_CAMERA)
    accounts = "gaze2d and gaze3d"

    def open(self, folder: Path, builder: RaysBuilder) -> _Tobii:
        name = resolve_path(folder).name
        camera = _scene_camera(folder, builder)
        return _Tobii(
            name=name, person=name, frames=_frames(folder, camera, builder), glasses=_calibration(folder, camera)
        )

    def blocks(self, gaze: Path, recording: _Tobii, builder: RaysBuilder) -> Iterator[GazeBlock]:
        glasses = recording.glasses
        for rows, lines in _samples(gaze, builder):
            direction = glasses.camera.directions(rows[:, 1:3] * glasses.size)
            other = _seen_from_camera(rows[:, 3:], glasses, direction)
            none = np.asarray(~np.isfinite(rows[:, 1:3]).all(axis=1))
            yield GazeBlock(rows[:, 0], direction, lines, {"there is no gaze": none}, other)


READERS = (Tobii3(),)


def _seen_from_camera(points: np.ndarray, glasses: CalibratedGlasses, direction: np.ndarray) -> np.ndarray:
    """Points (n, 3) of the head unit, millimetres, in the camera. Whether ``position`` is the camera's in the head unit
    or the head unit's in the camera is not documented: what fits the ``direction`` (n, 3) better."""
    turned = points @ glasses.rotation.T
    ways = turned + glasses.position, turned - glasses.rotation @ glasses.position
    with np.errstate(invalid="ignore"):
        off = [np.nan_to_num(angles_between(way, direction)).sum() for way in ways]
    return ways[int(np.argmin(off))]


def _scene_camera(folder: Path, builder: RaysBuilder) -> dict[str, Any]:
    """What the recording says of its scene camera."""
    path = folder / _RECORDING
    recording: Any = read_json(path, "Tobii recording", _JSON)
    builder.source(path)
    camera = recording.get("scenecamera") if isinstance(recording, dict) else None
    return camera if isinstance(camera, dict) else {}


def _frames(folder: Path, camera: dict[str, Any], builder: RaysBuilder) -> np.ndarray | None:
    """Seconds of the scene video's frames on the recording's clock, where the video is there."""
    name = camera.get("file")
    video = folder / (Path(name).name if isinstance(name, str) and Path(name).name else _VIDEO)
    if not video.is_file():
        return None
    builder.source(video)
    return read_frame_times(video, "scene video")


def _calibration(folder: Path, camera: dict[str, Any]) -> CalibratedGlasses:
    path = folder / _RECORDING
    try:
        c = camera["camera-calibration"]
        (fx, fy), (cx, cy), (w, h) = c["focal-length"], c["principal-point"], c["resolution"]
        (k1, k2, k3), (p1, p2) = c["radial-distortion"], c["tangential-distortion"]
        rotation = np.array(c["rotation"], np.float64).reshape(3, 3)
        position = np.array(c["position"], np.float64).reshape(3)
        matrix = [[fx, c["skew"], cx], [0, fy, cy], [0, 0, 1]]
        size = float(w), float(h)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise NergError(
            f'"{path}" has no whole camera calibration of the scene camera; copy the recording again'
        ) from error
    if not (np.isfinite(position).all() and np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-2):
        raise NergError(f'the calibration in "{path}" turns the camera by no rotation; copy the recording again')
    lens = SceneCamera.of_opencv(matrix, [k1, k2, p1, p2, k3], size, f'the calibration in "{path}"')
    return CalibratedGlasses(lens, size, rotation, position)


def _samples(path: Path, builder: RaysBuilder) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Blocks of seconds, gaze2d and gaze3d (n, 6), NaN where there is none, and their lines (n,)."""
    count, unused = 0, dict[str, None]()
    for raw in read_line_blocks(path, "gaze of Tobii glasses", _BLOCK):
        rows, lines = [], []
        for line, text in enumerate(raw, count + 1):
            row = _sample(text, path, line, builder.on_bad, unused) if not text.isspace() else None
            if row is not None:
                rows.append(row)
                lines.append(line)
        count += len(raw)
        builder.note_unused(unused)
        if rows:
            yield np.array(rows, np.float64), np.array(lines)


def _sample(text: str, path: Path, line: int, on_bad: BadLineCallback | None, unused: dict[str, None]) -> list[float] | None:
    """The six numbers of a line; None for one of another type, and for a bad one that ``on_bad`` is told of. What else
    there is goes into ``unused`` by its name."""
    try:
        found: Any = parse_json(text, path, f"line {line} of the gaze")
        if found["type"] != "gaze":
            _name_unused(f"lines of the type {found['type']}", unused)
            return None
        data = found["data"]
        for key in data:
            if key not in ("gaze2d", "gaze3d"):
                _name_unused(key, unused)
        gaze = [float(x) for x in data.get("gaze2d") or (np.nan,) * 2]
        point = [float(x) for x in data.get("gaze3d") or (np.nan,) * 3]
        if len(gaze) != 2 or len(point) != 3:
            raise ValueError
        return [float(found["timestamp"]), *gaze, *point]
    except (NergError, KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        why = ": it is no JSON object of a sample with its type, timestamp and data"
        if on_bad is None:
            raise NergError(
                f"{path}, line {line}{why}; mend it, or leave such lines out with --skip-bad-lines"
            ) from error
        on_bad(line, why)
        return None


def _name_unused(name: str, unused: dict[str, None]) -> None:
    if len(unused) < _UNUSED:
        unused[sanitize(name, 60)] = None
