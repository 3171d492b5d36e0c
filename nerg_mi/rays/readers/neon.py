"""Pupil Labs Neon: the "Timeseries" download of Pupil Cloud (github: pupil-labs/pupil-docs), and exports of Neon Player
(github: pupil-labs/neon-player)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import read_json, resolve_path

from .base import DESCRIPTION, RaysBuilder, Signature
from .scene_glasses import POSES, WHERE_CAMERA, GazeBlock, Recording, SceneCamera, SceneReader, directions_from_angles
from .tables import read_table_columns

_TIME = "timestamp [ns]"
_PIXELS = ("gaze x [px]", "gaze y [px]")
_ANGLES = ("azimuth [deg]", "elevation [deg]")
_SIZE = (1600, 1200)  # of Neon's scene camera, pixels
_OFF = re.compile(r"false|0+(\.([0-4]\d*)?)?")  # not worn: a truth, a number, or a share, by the version of the export
_JSON = 1 << 20  # bytes of its JSON files, at most
# Names of the scene camera's matrix and coefficients, in the files of Pupil Cloud and of Neon Player.
_CALIBRATIONS = {
    "scene_camera.json": ("camera_matrix", ("distortion_coefficients", "dist_coefs")),
    "calibration.json": ("scene_camera_matrix", ("scene_distortion_coefficients",)),
}
# A lens of Neon's field of view, 103 by 77 degrees, whose axis meets the middle of the picture.
_NOMINAL = (
    [[891.0, 0, 799.5], [0, 891.0, 599.5], [0, 0, 1]],
    [-0.1306, 0.1089, 0.0, 0.0, -0.0007, 0.1701, 0.0523, 0.0238],
)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Neon(Recording):
    camera: SceneCamera | None  # where its calibration is there


class Neon(SceneReader[_Neon]):
    """Folders with ``gaze.csv``, ``info.json``, ``scene_camera.json`` (Neon Player: ``calibration.json``) and
    ``world_timestamps.csv``.

    A ray starts at the scene camera's centre. Its direction is that of azimuth (right) and elevation (up), or, where
    there are none, of the undistorted pixel; where there are both they are compared. Rows in blinks, and in which the
    glasses were not worn, are dropped. Times count from the recording's start. The person is the wearer that
    ``info.json`` names, or else the folder.

    Exports of Neon Player may lack some of these. Without ``info.json`` times count from the first frame of the scene
    video; without angles and a calibration pixels go through a nominal lens. Both are said.
    """

    name = "neon"
    files = (
        "folders of Pupil Cloud's \"Timeseries\" download of a Neon, or of Neon Player's export (or the `gaze.csv` in "
        "them), beside the scene camera's poses"
    )
    checked_on = DESCRIPTION
    gaze_file = "gaze.csv"
    signature = Signature(
        files=(("gaze.csv", "info.json"), ("gaze.csv", "world_timestamps.csv")),
        columns=(("timestamp [ns]", "gaze x [px]", "gaze y [px]"),),
        options=POSES,
        question=WHERE_CAMERA,
    )
    accounts = "pixels and angles"

    def open(self, folder: Path, builder: RaysBuilder) -> _Neon:
        name = resolve_path(folder).name
        frames = _frame_times(folder, builder)
        start, person = _info(folder, builder)
        starts_with_video = start is None
        if start is None:
            if frames is None or not len(frames):
                raise NergError(
                    f'"{folder}" has neither info.json nor world_timestamps.csv, by which the times of Neon\'s gaze '
                    "count; export them beside the gaze"
                )
            builder.complain(
                f'there is no info.json beside the gaze of "{sanitize(name, 60)}": times count from the first frame of '
                "the scene video, not from the recording's start, and the person is the folder"
            )
            start = float(frames[0])
        return _Neon(
            name=name,
            person=person or name,
            frames=None if frames is None else (frames - start) * 1e-9,
            start=start,
            starts_with_video=starts_with_video,
            camera=_camera(folder, builder),
        )

    def blocks(self, gaze: Path, recording: _Neon, builder: RaysBuilder) -> Iterator[GazeBlock]:
        there = set(read_table_columns(gaze))
        angles = set(_ANGLES) <= there
        camera = recording.camera
        if not angles and camera is None:
            camera = SceneCamera.of_opencv(*_NOMINAL, _SIZE)
            builder.complain(
                f'the gaze of "{sanitize(recording.name, 60)}" has no angles, and no calibration of the scene camera '
                f"({' or '.join(_CALIBRATIONS)}) lies beside it: pixels go through the nominal lens of Neon, some two "
                "degrees off; export either"
            )
        numbers = [_TIME, *_PIXELS, *(_ANGLES if angles else ())]
        texts = [name for name in ("worn", "blink id") if name in there]
        for v, words, lines in builder.read_table(gaze, numbers, texts):
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
        drop["the glasses were not worn"] = np.array([bool(_OFF.fullmatch(w)) for w in word["worn"].tolist()], bool)
    if "blink id" in word:
        drop["a blink"] = ~np.isin(word["blink id"], ["", "nan"])
    return drop


def _info(folder: Path, builder: RaysBuilder) -> tuple[float | None, str]:
    """Nanoseconds at which the recording started, and who wore the glasses; None and "" without the file."""
    path = folder / "info.json"
    if not path.is_file():
        return None, ""
    found: Any = read_json(path, "information of a Neon recording", _JSON)
    builder.source(path)
    start = found.get("start_time") if isinstance(found, dict) else None
    if not isinstance(start, int) or isinstance(start, bool) or not 0 <= start < 1 << 63:
        raise NergError(f'"{path}" says no "start_time" in nanoseconds; download the recording again')
    wearer = found.get("wearer_name")
    return float(start), wearer.strip() if isinstance(wearer, str) else ""


def _camera(folder: Path, builder: RaysBuilder) -> SceneCamera | None:
    """The scene camera, where its calibration is there."""
    for name, (matrix, coefficients) in _CALIBRATIONS.items():
        path = folder / name
        if path.is_file():
            content: Any = read_json(path, "calibration of a Neon scene camera", _JSON)
            builder.source(path)
            content = content if isinstance(content, dict) else {}
            distortion = next((content[key] for key in coefficients if key in content), None)
            return SceneCamera.of_opencv(content.get(matrix), distortion, _SIZE, f'the calibration "{path}"')
    return None


def _frame_times(folder: Path, builder: RaysBuilder) -> np.ndarray | None:
    """Nanoseconds of the scene video's frames, where they are there."""
    path = folder / "world_timestamps.csv"
    if not path.is_file():
        return None
    builder.source(path)
    return builder.read_whole(path, [_TIME])[:, 0]
