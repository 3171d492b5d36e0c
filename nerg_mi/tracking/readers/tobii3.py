"""Tobii Pro Glasses 3: a recording's folder from the recording unit.

Files are ``gazedata.gz``, ``recording.g3`` and ``scenevideo.mp4``, whose frames have times of their own (about 24.95
per second, with gaps).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.safe_read import BadLineCallback, parse_json, read_json, read_line_blocks, resolve_path
from nerg_mi.files.video import read_frame_times

from .base import FROM_DOCUMENTATION, RaysBuilder, Signature
from .scene_glasses import POSE_OPTIONS, POSE_QUESTION, GazeBlock, Recording, SceneCamera, SceneReader, angles_between

_RECORDING, _VIDEO = "recording.g3", "scenevideo.mp4"
_MAX_UNUSED_NAMES = 100  # names of unused parts of samples
_BLOCK = 1 << 14  # lines parsed at a time
_MAX_JSON_BYTES = 1 << 20  # of recording.g3


@dataclass(frozen=True, eq=False)
class CalibratedGlasses:
    """Scene camera, ``size`` of its images in pixels, and the pose of the head unit's axes relative to the camera."""

    camera: SceneCamera
    size: tuple[float, float]
    rotation: np.ndarray  # (3, 3)
    position: np.ndarray  # (3,) millimetres


@dataclass(frozen=True, eq=False, kw_only=True)
class _Tobii(Recording):
    glasses: CalibratedGlasses


class Tobii3(SceneReader[_Tobii]):
    """Folders with ``gazedata.gz`` (JSON, one line per sample) and ``recording.g3`` with the scene camera's
    calibration.

    A ray starts at the scene camera's centre and passes through the undistorted ``gaze2d``. ``gaze3d``, millimetres in
    the head unit's axes, is rotated to the camera with the calibration and compared. Samples without gaze are dropped.
    Times are seconds from the recording's start, like those of its video ``scenevideo.mp4``, whose frames have the
    times in its tables: about 24.95 per second, with gaps for lost frames. The participant is the folder.
    """

    name = "tobii3"
    files = (
        "folders of Tobii Pro Glasses 3 (or the `gazedata.gz` in them) with their scene video, and with the scene "
        "camera's poses"
    )
    evidence = FROM_DOCUMENTATION
    gaze_file = "gazedata.gz"
    signature = Signature(files=(("gazedata.gz", "recording.g3"),), options=POSE_OPTIONS, question=POSE_QUESTION)
    compared = "gaze2d and gaze3d"

    def open_recording(self, folder: Path, builder: RaysBuilder) -> _Tobii:
        name = resolve_path(folder).name
        camera = _read_scene_camera(folder, builder)
        return _Tobii(
            name=name,
            person=name,
            frames=_read_frame_times(folder, camera, builder),
            glasses=_parse_calibration(folder, camera),
        )

    def iterate_gaze(self, gaze: Path, recording: _Tobii, builder: RaysBuilder) -> Iterator[GazeBlock]:
        glasses = recording.glasses
        for rows, lines in _iterate_samples(gaze, builder):
            direction = glasses.camera.compute_directions(rows[:, 1:3] * glasses.size)
            other = _transform_to_camera(rows[:, 3:], glasses, direction)
            has_no_gaze = np.asarray(~np.isfinite(rows[:, 1:3]).all(axis=1))
            yield GazeBlock(rows[:, 0], direction, lines, {"there is no gaze": has_no_gaze}, other)


READERS = (Tobii3(),)


def _transform_to_camera(points: np.ndarray, glasses: CalibratedGlasses, direction: np.ndarray) -> np.ndarray:
    """Transform points (n, 3) of the head unit, millimetres, to the camera. It is not documented whether ``position``
    is that of the camera in the head unit or vice versa: the variant that better fits ``direction`` (n, 3) is used."""
    rotated = points @ glasses.rotation.T
    candidates = rotated + glasses.position, rotated - glasses.rotation @ glasses.position
    with np.errstate(invalid="ignore"):
        errors = [np.nan_to_num(angles_between(candidate, direction)).sum() for candidate in candidates]
    return candidates[int(np.argmin(errors))]


def _read_scene_camera(folder: Path, builder: RaysBuilder) -> dict[str, Any]:
    """Read the entry of the scene camera in the recording."""
    path = folder / _RECORDING
    recording: Any = read_json(path, "Tobii recording", _MAX_JSON_BYTES)
    builder.begin_source(path)
    camera = recording.get("scenecamera") if isinstance(recording, dict) else None
    return camera if isinstance(camera, dict) else {}


def _read_frame_times(folder: Path, camera: dict[str, Any], builder: RaysBuilder) -> np.ndarray | None:
    """Times of the scene video's frames in seconds on the recording's clock; None without the video."""
    name = camera.get("file")
    video = folder / (Path(name).name if isinstance(name, str) and Path(name).name else _VIDEO)
    if not video.is_file():
        return None
    builder.begin_source(video)
    return read_frame_times(video, "scene video")


def _parse_calibration(folder: Path, camera: dict[str, Any]) -> CalibratedGlasses:
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
            f'"{path}" has no complete calibration of the scene camera; copy the recording again'
        ) from error
    if not (np.isfinite(position).all() and np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-2):
        raise NergError(f'the rotation in the calibration in "{path}" is invalid; copy the recording again')
    lens = SceneCamera.from_opencv(matrix, [k1, k2, p1, p2, k3], size, f'the calibration in "{path}"')
    return CalibratedGlasses(lens, size, rotation, position)


def _iterate_samples(path: Path, builder: RaysBuilder) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Iterate over blocks of seconds, gaze2d and gaze3d (n, 6), NaN without gaze, and line numbers (n,)."""
    count, unused = 0, dict[str, None]()
    for raw in read_line_blocks(path, "gaze of Tobii glasses", _BLOCK):
        rows, lines = [], []
        for line, text in enumerate(raw, count + 1):
            row = _parse_sample(text, path, line, builder.on_bad_line, unused) if not text.isspace() else None
            if row is not None:
                rows.append(row)
                lines.append(line)
        count += len(raw)
        builder.add_unused_columns(unused)
        if rows:
            yield np.array(rows, np.float64), np.array(lines)


def _parse_sample(
    text: str, path: Path, line: int, on_bad_line: BadLineCallback | None, unused: dict[str, None]
) -> list[float] | None:
    """Parse a line to six numbers; None for a line of another type, and for a bad line, which ``on_bad_line`` reports.
    Names of other data are added to ``unused``."""
    try:
        content: Any = parse_json(text, path, f"line {line} of the gaze")
        if content["type"] != "gaze":
            _add_unused_name(f"lines of the type {content['type']}", unused)
            return None
        data = content["data"]
        for key in data:
            if key not in ("gaze2d", "gaze3d"):
                _add_unused_name(key, unused)
        gaze = [float(x) for x in data.get("gaze2d") or (np.nan,) * 2]
        point = [float(x) for x in data.get("gaze3d") or (np.nan,) * 3]
        if len(gaze) != 2 or len(point) != 3:
            raise ValueError
        return [float(content["timestamp"]), *gaze, *point]
    except (NergError, KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        reason = ": it is not a JSON object of a sample with type, timestamp and data"
        if on_bad_line is None:
            raise NergError(
                f"{path}, line {line}{reason}; correct it, or skip such lines with {parameter('skip_bad_lines', True)}"
            ) from error
        on_bad_line(line, reason)
        return None


def _add_unused_name(name: str, unused: dict[str, None]) -> None:
    if len(unused) < _MAX_UNUSED_NAMES:
        unused[sanitize(name, 60)] = None
