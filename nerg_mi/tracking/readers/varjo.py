"""Varjo: logs of its eye tracking example for Unity."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize

from . import poses
from .base import FROM_DOCUMENTATION, UNITY, FixedFrameReader, NoOptions, RaysBuilder, Signature
from .table import person_from_filename

_TICK = 1e-9  # seconds; unit of CaptureTime
_STATUS_VALUES = ("INVALID", "0", "ADJUST", "1", "VALID", "2")
_VECTORS = {"HMDPosition": "xyz", "HMDRotation": "xyzw", "CombinedGazePosition": "xyz", "CombinedGazeForward": "xyz"}


class Varjo(FixedFrameReader):
    """Tables with semicolons as separators, and vectors as ``(x, y, z)``.

    ``HMDPosition`` and ``HMDRotation`` (x, y, z, w) are the camera's pose in Unity's world, ``CombinedGazePosition``
    and ``CombinedGazeForward`` are in the camera's frame with z forward. ``CaptureTime`` is in nanoseconds; times of
    rays are relative to the recording's first row. Rows whose ``GazeStatus`` is not VALID are dropped. The participant
    is the file name.
    """

    name = "varjo"
    files = "the log of Varjo's eye tracking example for Unity"
    frame_description = "Unity"
    evidence = FROM_DOCUMENTATION
    fixed_frame = UNITY
    signature = Signature(columns=(("CaptureTime", "HMDPosition", "HMDRotation", "CombinedGazeForward", "GazeStatus"),))

    def read(self, files: Sequence[Path], options: NoOptions, builder: RaysBuilder) -> None:
        builder.add_metadata(tick=_TICK)
        for path in files:
            builder.begin_source(path)
            first = None
            numbers = ["CaptureTime", *(f"{name}.{axis}" for name, axes in _VECTORS.items() for axis in axes)]
            for v, texts, lines in builder.read_table(path, numbers, ["GazeStatus"]):
                position, rotation, eye, forward = v[:, 1:4], v[:, 4:8], v[:, 8:11], v[:, 11:14]
                matrices = poses.rotations_from_quaternions(rotation)
                # float64 resolves nanoseconds since 1970 to 0.3 us, which is sufficient after subtracting the first.
                first = v[0, 0] if first is None else first
                builder.add(
                    (v[:, 0] - first) * _TICK,
                    person_from_filename(path),
                    position + poses.rotate(matrices, eye),
                    poses.rotate(matrices, forward),
                    rows=lines,
                    tracking="eye",
                    head=matrices[:, :, 2],
                    drop={
                        "GazeStatus is not VALID": ~_is_valid(path, texts[:, 0]),
                        **poses.find_unusable_quaternions(rotation),
                    },
                    recorded_origin=position,
                    recorded_direction=forward,
                )


READERS = (Varjo(),)


def _is_valid(path: Path, status: np.ndarray) -> np.ndarray:
    """Whether a GazeStatus (n,) is valid, as a word or the SDK's code. Raises `NergError` for other values."""
    status = np.char.upper(status)
    unknown = ~np.isin(status, [*_STATUS_VALUES, ""])
    if unknown.any():
        raise NergError(
            f"{path} has the GazeStatus {sanitize(status[unknown][0], 20)!r}, whose meaning is uncertain; it must "
            f"be one of {', '.join(_STATUS_VALUES)}: correct the cells, or import with {parameter('columns')} and "
            f"{parameter('valid')}"
        )
    return np.isin(status, _STATUS_VALUES[-2:])
