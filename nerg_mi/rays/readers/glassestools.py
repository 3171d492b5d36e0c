"""The common format of glassesTools and gazeMapper (github: dcnieho/glassesTools), into which they convert a dozen
glasses: AdHawk, Pupil Core, Invisible and Neon, SeeTrue, SMI, Tobii Glasses 2 and 3, Viewpointsystem and others."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import read_bytes, resolve_path

from .base import DESCRIPTION, RaysBuilder, Signature
from .scene_glasses import POSES, WHERE_CAMERA, GazeBlock, Recording, SceneCamera, SceneReader

_MILLISECOND = 1e-3
_XML = 1 << 20  # bytes of a calibration, at most
# A matrix of OpenCV's FileStorage; what else XML can hold is not looked at.
_MATRIX = r"<{0}\s[^>]*>\s*<rows>\d+</rows>\s*<cols>\d+</cols>\s*<dt>\w+</dt>\s*<data>([^<]*)</data>\s*</{0}>"


@dataclass(frozen=True, eq=False, kw_only=True)
class _Glasses(Recording):
    camera: SceneCamera


class GlassesTools(SceneReader[_Glasses]):
    """Folders with ``gazeData.tsv``, ``frameTimestamps.tsv`` and ``calibration.xml``.

    A ray starts at the scene camera's centre and goes through the undistorted point of gaze in its video. Times are
    milliseconds of the video's clock. Rows without gaze are dropped. The person is the folder.
    """

    name = "glassestools"
    files = (
        "folders of glassesTools and gazeMapper (or the `gazeData.tsv` in them), beside the scene camera's poses; with "
        "them Pupil Invisible, Tobii Glasses 2, SMI, AdHawk, SeeTrue and others"
    )
    checked_on = DESCRIPTION
    gaze_file = "gazeData.tsv"
    signature = Signature(
        files=(("gazeData.tsv", "calibration.xml"),),
        columns=(("timestamp", "frame_idx", "gaze_pos_vid_x", "gaze_pos_vid_y"),),
        options=POSES,
        question=WHERE_CAMERA,
    )

    def open(self, folder: Path, builder: RaysBuilder) -> _Glasses:
        name = resolve_path(folder).name
        camera = _camera(folder, builder)
        return _Glasses(name=name, person=name, frames=_frame_times(folder, builder), camera=camera)

    def blocks(self, gaze: Path, recording: _Glasses, builder: RaysBuilder) -> Iterator[GazeBlock]:
        columns = ["timestamp", "gaze_pos_vid_x", "gaze_pos_vid_y"]
        for v, _, lines in builder.read_table(gaze, columns):
            none = np.asarray(~np.isfinite(v[:, 1:]).all(axis=1))
            direction = recording.camera.directions(v[:, 1:])
            yield GazeBlock(v[:, 0] * _MILLISECOND, direction, lines, {"there is no gaze": none})


READERS = (GlassesTools(),)


def _camera(folder: Path, builder: RaysBuilder) -> SceneCamera:
    path = folder / "calibration.xml"
    text = read_bytes(path, "calibration of the scene camera", _XML).decode("utf-8", "replace")
    builder.source(path)
    found = {name: _matrix(text, name, path) for name in ("cameraMatrix", "distCoeff", "resolution")}
    if found["cameraMatrix"] is None or found["distCoeff"] is None:
        raise NergError(
            f'"{path}" lacks the cameraMatrix or the distCoeff of the scene camera; calibrate it with glassesTools'
        )
    size = found["resolution"]
    size = None if size is None or len(size) != 2 else size
    return SceneCamera.of_opencv(found["cameraMatrix"], found["distCoeff"], size, f'the calibration "{path}"')


def _matrix(text: str, name: str, path: Path) -> list[float] | None:
    found = re.search(_MATRIX.format(name), text)
    try:
        return None if found is None else [float(word) for word in found.group(1).split()]
    except ValueError:
        raise NergError(f'{name} in "{path}" holds what is no number; calibrate the camera again') from None


def _frame_times(folder: Path, builder: RaysBuilder) -> np.ndarray | None:
    """Seconds of the video's frames, by their numbers from 0, where they are there."""
    path = folder / "frameTimestamps.tsv"
    if not path.is_file():
        return None
    builder.source(path)
    rows = builder.read_whole(path, ["frame_idx", "timestamp"])
    if not np.array_equal(rows[:, 0], np.arange(len(rows))):
        raise NergError(f'"{path}" does not count its frames 0, 1, 2, ...; convert the recording again')
    return rows[:, 1] * _MILLISECOND
