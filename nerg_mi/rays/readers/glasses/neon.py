"""Pupil Labs Neon: the "Timeseries" download of Pupil Cloud (github: pupil-labs/pupil-docs)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import read_json
from nerg_mi.rays.readers.builder import RaysBuilder
from nerg_mi.rays.readers.parsing.tables import iterate_table, table_columns
from nerg_mi.rays.readers.protocol import DESCRIPTION

from .scene_camera import SceneCamera, directions_from_angles
from .scene_gaze import GazeBlock, Recording
from .scene_reader import SceneReader

_TIME = "timestamp [ns]"
_PIXELS = ("gaze x [px]", "gaze y [px]")
_ANGLES = ("azimuth [deg]", "elevation [deg]")
_SIZE = (1600, 1200)  # of Neon's scene camera, pixels
_JSON = 1 << 20  # bytes of its JSON files, at most


@dataclass(frozen=True, eq=False, kw_only=True)
class _Neon(Recording):
    camera: SceneCamera | None  # where its calibration is there


class Neon(SceneReader[_Neon]):
    """Folders with ``gaze.csv``, ``info.json``, ``scene_camera.json`` and ``world_timestamps.csv``.

    A ray starts at the scene camera's centre. Its direction is that of azimuth (right) and elevation (up), or, where
    there are none, of the undistorted pixel; where there are both they are compared. Rows in blinks, and in which the
    glasses were not worn, are dropped. Times count from the recording's start. The person is the wearer that
    ``info.json`` names, or else the folder.
    """

    name = "neon"
    files = (
        'folders of Pupil Cloud\'s "Timeseries" download of a Neon (or the `gaze.csv` in them), beside the scene '
        "camera's poses"
    )
    checked_on = DESCRIPTION
    gaze_file = "gaze.csv"
    accounts = "pixels and angles"

    def open(self, folder: Path, builder: RaysBuilder) -> _Neon:
        start, person = _info(folder, builder)
        camera = _camera(folder, builder)
        frames = _frame_times(folder, start, builder)
        return _Neon(name=folder.resolve().name, person=person, frames=frames, start=start, camera=camera)

    def blocks(self, gaze: Path, recording: _Neon, builder: RaysBuilder) -> Iterator[GazeBlock]:
        there = set(table_columns(gaze))
        angles = set(_ANGLES) <= there
        camera = recording.camera
        if not angles and camera is None:
            raise NergError(f"{gaze} has no angles, and pixels need scene_camera.json; download it beside the gaze")
        numbers = [_TIME, *_PIXELS, *(_ANGLES if angles else ())]
        texts = [name for name in ("worn", "blink id") if name in there]
        for v, words, lines in iterate_table(gaze, numbers, texts, on_bad=builder.on_bad):
            found = [directions_from_angles(v[:, 3:5])] if angles else []
            found += [] if camera is None else [camera.directions(v[:, 1:3])]
            t = (v[:, 0] - recording.start) * 1e-9
            drop = _unusable(dict(zip(texts, np.char.lower(words).T)))
            yield GazeBlock(t, found[0], lines, drop, found[1] if len(found) == 2 else None)


READERS = (Neon(),)


def _unusable(word: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Rows that say no gaze, by reason, from the words of a block's columns."""
    drop = {}
    if "worn" in word:
        # Spelt as a truth or as a number, by the version of the export.
        drop["the glasses were not worn"] = np.isin(word["worn"], ["0", "0.0", "false"])
    if "blink id" in word:
        drop["a blink"] = ~np.isin(word["blink id"], ["", "nan"])
    return drop


def _info(folder: Path, builder: RaysBuilder) -> tuple[float, str]:
    """Nanoseconds at which the recording started, and who wore the glasses."""
    path = folder / "info.json"
    found: Any = read_json(path, "information of a Neon recording", _JSON)
    builder.source(path)
    start = found.get("start_time") if isinstance(found, dict) else None
    if not isinstance(start, int) or isinstance(start, bool) or not 0 <= start < 1 << 63:
        raise NergError(f'"{path}" says no "start_time" in nanoseconds; download the recording again')
    wearer = found.get("wearer_name")
    return float(start), wearer.strip() if isinstance(wearer, str) and wearer.strip() else folder.resolve().name


def _camera(folder: Path, builder: RaysBuilder) -> SceneCamera | None:
    """The scene camera, where its calibration is there."""
    path = folder / "scene_camera.json"
    if not path.is_file():
        return None
    found: Any = read_json(path, "calibration of a Neon scene camera", _JSON)
    builder.source(path)
    found = found if isinstance(found, dict) else {}
    bent = found.get("distortion_coefficients", found.get("dist_coefs"))
    return SceneCamera.of_opencv(found.get("camera_matrix"), bent, _SIZE, f'the calibration "{path}"')


def _frame_times(folder: Path, start: float, builder: RaysBuilder) -> np.ndarray | None:
    """Seconds of the scene video's frames since the start, where they are there."""
    path = folder / "world_timestamps.csv"
    if not path.is_file():
        return None
    builder.source(path)
    blocks = iterate_table(path, [_TIME], on_bad=builder.on_bad)
    times = np.concatenate([block.numbers[:, 0] for block in blocks] or [np.empty(0)])
    builder.count_lines(len(times))
    return (times - start) * 1e-9
