"""Pupil Labs Neon: the "Timeseries" download of Pupil Cloud, and exports of Neon Player (github: pupil-labs).

Files are ``gaze.csv``, ``info.json``, ``scene_camera.json`` and ``world_timestamps.csv``. Exports of Neon Player may
lack ``info.json``, and angles together with a calibration: times then count from the first frame, pixels go through
a nominal lens (some two degrees off), and the report says so.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import read_json, resolve_path

from .base import FROM_DOCUMENTATION, RaysBuilder, Signature
from .scene_glasses import (
    POSE_OPTIONS,
    POSE_QUESTION,
    GazeBlock,
    Recording,
    SceneCamera,
    SceneReader,
    directions_from_angles,
)
from .tables import read_table_columns

_TIME = "timestamp [ns]"
_PIXEL_COLUMNS = ("gaze x [px]", "gaze y [px]")
_ANGLE_COLUMNS = ("azimuth [deg]", "elevation [deg]")
_IMAGE_SIZE = (1600, 1200)  # of Neon's scene camera, pixels
_NOT_WORN = re.compile(
    r"false|0+(\.([0-4]\d*)?)?"
)  # not worn: a boolean, a number, or a fraction, depending on the version of the export
_MAX_JSON_BYTES = 1 << 20  # of its JSON files
# Keys of the scene camera's matrix and coefficients, in the files of Pupil Cloud and of Neon Player.
_CALIBRATIONS = {
    "scene_camera.json": ("camera_matrix", ("distortion_coefficients", "dist_coefs")),
    "calibration.json": ("scene_camera_matrix", ("scene_distortion_coefficients",)),
}
# A lens with Neon's field of view, 103 by 77 degrees, centred in the image.
_NOMINAL_LENS = (
    [[891.0, 0, 799.5], [0, 891.0, 599.5], [0, 0, 1]],
    [-0.1306, 0.1089, 0.0, 0.0, -0.0007, 0.1701, 0.0523, 0.0238],
)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Neon(Recording):
    camera: SceneCamera | None  # None without its calibration


class Neon(SceneReader[_Neon]):
    """Folders with ``gaze.csv``, ``info.json``, ``scene_camera.json`` (Neon Player: ``calibration.json``) and
    ``world_timestamps.csv``.

    A ray starts at the scene camera's centre. Its direction is that of azimuth (right) and elevation (up), or, without
    these, that of the undistorted pixel; if both exist they are compared. Rows during blinks, and rows in which the
    glasses were not worn, are dropped. Times are relative to the recording's start. The participant is the wearer in
    ``info.json``, otherwise the folder.

    Exports of Neon Player may be incomplete. Without ``info.json``, times are relative to the first frame of the scene
    video; without angles and calibration, pixels are converted with a nominal lens. Both give a warning.
    """

    name = "neon"
    files = (
        "folders of Pupil Cloud's \"Timeseries\" download of a Neon, or of Neon Player's export (or the `gaze.csv` in "
        "them), with the scene camera's poses"
    )
    evidence = FROM_DOCUMENTATION
    gaze_file = "gaze.csv"
    signature = Signature(
        files=(("gaze.csv", "info.json"), ("gaze.csv", "world_timestamps.csv")),
        columns=(("timestamp [ns]", "gaze x [px]", "gaze y [px]"),),
        options=POSE_OPTIONS,
        question=POSE_QUESTION,
    )
    compared = "pixels and angles"

    def open_recording(self, folder: Path, builder: RaysBuilder) -> _Neon:
        name = resolve_path(folder).name
        frames = _read_frame_times(folder, builder)
        start, person = _read_info(folder, builder)
        starts_with_video = start is None
        if start is None:
            if frames is None or not len(frames):
                raise NergError(
                    f'"{folder}" has neither info.json nor world_timestamps.csv, which are needed for the times of '
                    "Neon's gaze; export them next to the gaze"
                )
            builder.add_warning(
                f'there is no info.json next to the gaze of "{sanitize(name, 60)}": times are relative to the first '
                "frame of the scene video instead of the recording's start, and the participant is the folder"
            )
            start = float(frames[0])
        return _Neon(
            name=name,
            person=person or name,
            frames=None if frames is None else (frames - start) * 1e-9,
            start=start,
            starts_with_video=starts_with_video,
            camera=_read_camera(folder, builder),
        )

    def iterate_gaze(self, gaze: Path, recording: _Neon, builder: RaysBuilder) -> Iterator[GazeBlock]:
        available = set(read_table_columns(gaze))
        has_angles = set(_ANGLE_COLUMNS) <= available
        camera = recording.camera
        if not has_angles and camera is None:
            camera = SceneCamera.from_opencv(*_NOMINAL_LENS, _IMAGE_SIZE)
            builder.add_warning(
                f'the gaze of "{sanitize(recording.name, 60)}" has no angles, and there is no calibration of the scene '
                f"camera ({' or '.join(_CALIBRATIONS)}) next to it: pixels are converted with the nominal lens of "
                "Neon, with an error of about two degrees; export either"
            )
        numbers = [_TIME, *_PIXEL_COLUMNS, *(_ANGLE_COLUMNS if has_angles else ())]
        texts = [name for name in ("worn", "blink id") if name in available]
        for v, words, lines in builder.read_table(gaze, numbers, texts):
            directions = [directions_from_angles(v[:, 3:5])] if has_angles else []
            directions += [] if camera is None else [camera.compute_directions(v[:, 1:3])]
            t = (v[:, 0] - recording.start) * 1e-9
            drop = _find_unusable_rows(dict(zip(texts, np.char.lower(words).T)))
            yield GazeBlock(t, directions[0], lines, drop, directions[1] if len(directions) == 2 else None)


READERS = (Neon(),)


def _find_unusable_rows(word: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Find rows without valid gaze, by reason, from the texts of a block's columns."""
    drop = {}
    if "worn" in word:
        drop["the glasses were not worn"] = np.array(
            [bool(_NOT_WORN.fullmatch(w)) for w in word["worn"].tolist()], bool
        )
    if "blink id" in word:
        drop["a blink"] = ~np.isin(word["blink id"], ["", "nan"])
    return drop


def _read_info(folder: Path, builder: RaysBuilder) -> tuple[float | None, str]:
    """Start of the recording in nanoseconds, and its wearer; None and "" without the file."""
    path = folder / "info.json"
    if not path.is_file():
        return None, ""
    content: Any = read_json(path, "information of a Neon recording", _MAX_JSON_BYTES)
    builder.begin_source(path)
    start = content.get("start_time") if isinstance(content, dict) else None
    if not isinstance(start, int) or isinstance(start, bool) or not 0 <= start < 1 << 63:
        raise NergError(f'"{path}" has no "start_time" in nanoseconds; download the recording again')
    wearer = content.get("wearer_name")
    return float(start), wearer.strip() if isinstance(wearer, str) else ""


def _read_camera(folder: Path, builder: RaysBuilder) -> SceneCamera | None:
    """Read the scene camera; None without its calibration."""
    for name, (matrix, coefficients) in _CALIBRATIONS.items():
        path = folder / name
        if path.is_file():
            content: Any = read_json(path, "calibration of a Neon scene camera", _MAX_JSON_BYTES)
            builder.begin_source(path)
            content = content if isinstance(content, dict) else {}
            distortion = next((content[key] for key in coefficients if key in content), None)
            return SceneCamera.from_opencv(content.get(matrix), distortion, _IMAGE_SIZE, f'the calibration "{path}"')
    return None


def _read_frame_times(folder: Path, builder: RaysBuilder) -> np.ndarray | None:
    """Nanoseconds of the scene video's frames; None without the file."""
    path = folder / "world_timestamps.csv"
    if not path.is_file():
        return None
    builder.begin_source(path)
    return builder.read_all(path, [_TIME])[:, 0]
