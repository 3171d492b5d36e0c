"""glassesTools and gazeMapper: the common format of these programs (github: dcnieho/glassesTools).

They convert recordings of AdHawk, Pupil Core, Invisible and Neon, SeeTrue, SMI, Tobii Glasses 2 and 3,
Viewpointsystem and other glasses. Files are ``gazeData.tsv``, ``frameTimestamps.tsv`` and ``calibration.xml``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import read_bytes, resolve_path
from nerg_mi.files.values import parse_float

from .base import FROM_DOCUMENTATION, RaysBuilder, Signature
from .scene_glasses import POSE_OPTIONS, POSE_QUESTION, GazeBlock, Recording, SceneCamera, SceneReader

_MILLISECOND = 1e-3
_MAX_XML_BYTES = 1 << 20  # of a calibration file
# A matrix of OpenCV's FileStorage; other XML is ignored.
_MATRIX = r"<{0}\s[^>]*>\s*<rows>\d+</rows>\s*<cols>\d+</cols>\s*<dt>\w+</dt>\s*<data>([^<]*)</data>\s*</{0}>"


@dataclass(frozen=True, eq=False, kw_only=True)
class _Glasses(Recording):
    camera: SceneCamera


class GlassesTools(SceneReader[_Glasses]):
    """Folders with ``gazeData.tsv``, ``frameTimestamps.tsv`` and ``calibration.xml``.

    A ray starts at the scene camera's centre and passes through the undistorted gaze point in its video. Times are
    milliseconds of the video's clock. Rows without gaze are dropped. The participant is the folder.
    """

    name = "glassestools"
    files = (
        "folders of glassesTools and gazeMapper (or the `gazeData.tsv` in them), with the scene camera's poses; "
        "includes Pupil Invisible, Tobii Glasses 2, SMI, AdHawk, SeeTrue and others"
    )
    evidence = FROM_DOCUMENTATION
    gaze_file = "gazeData.tsv"
    signature = Signature(
        files=(("gazeData.tsv", "calibration.xml"),),
        columns=(("timestamp", "frame_idx", "gaze_pos_vid_x", "gaze_pos_vid_y"),),
        options=POSE_OPTIONS,
        question=POSE_QUESTION,
    )

    def open_recording(self, folder: Path, builder: RaysBuilder) -> _Glasses:
        name = resolve_path(folder).name
        camera = _read_camera(folder, builder)
        return _Glasses(name=name, person=name, frames=_read_frame_times(folder, builder), camera=camera)

    def iterate_gaze(self, gaze: Path, recording: _Glasses, builder: RaysBuilder) -> Iterator[GazeBlock]:
        columns = ["timestamp", "gaze_pos_vid_x", "gaze_pos_vid_y"]
        for v, _, lines in builder.read_table(gaze, columns):
            has_no_gaze = np.asarray(~np.isfinite(v[:, 1:]).all(axis=1))
            direction = recording.camera.compute_directions(v[:, 1:])
            yield GazeBlock(v[:, 0] * _MILLISECOND, direction, lines, {"there is no gaze": has_no_gaze})


READERS = (GlassesTools(),)


def _read_camera(folder: Path, builder: RaysBuilder) -> SceneCamera:
    path = folder / "calibration.xml"
    text = read_bytes(path, "calibration of the scene camera", _MAX_XML_BYTES).decode("utf-8", "replace")
    builder.begin_source(path)
    values = {name: _parse_matrix(text, name, path) for name in ("cameraMatrix", "distCoeff", "resolution")}
    if values["cameraMatrix"] is None or values["distCoeff"] is None:
        raise NergError(
            f'"{path}" lacks the cameraMatrix or the distCoeff of the scene camera; calibrate it with glassesTools'
        )
    size = values["resolution"]
    size = None if size is None or len(size) != 2 else size
    return SceneCamera.from_opencv(values["cameraMatrix"], values["distCoeff"], size, f'the calibration "{path}"')


def _parse_matrix(text: str, name: str, path: Path) -> list[float] | None:
    match = re.search(_MATRIX.format(name), text)
    try:
        return None if match is None else [parse_float(word) for word in match.group(1).split()]
    except ValueError:
        raise NergError(
            f'{name} in "{path}" contains a value that is not a number; calibrate the camera again'
        ) from None


def _read_frame_times(folder: Path, builder: RaysBuilder) -> np.ndarray | None:
    """Seconds of the video's frames by frame number from 0; None without the file."""
    path = folder / "frameTimestamps.tsv"
    if not path.is_file():
        return None
    builder.begin_source(path)
    rows = builder.read_all(path, ["frame_idx", "timestamp"])
    if not np.array_equal(rows[:, 0], np.arange(len(rows))):
        raise NergError(
            f'the frames in "{path}" are not numbered 0, 1, 2, ...; convert the recording with glassesTools again'
        )
    return rows[:, 1] * _MILLISECOND
