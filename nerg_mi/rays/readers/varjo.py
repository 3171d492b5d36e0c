"""Logs of Varjo's eye tracking example for Unity."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import BadLineCallback

from . import poses
from .base import GENERATED_FILES, UNITY, FixedFrameReader, NoOptions, RaysBuilder, Signature
from .table import person_from_filename

_TICK = 1e-9  # seconds; unit of CaptureTime
_STATUS_VALUES = ("INVALID", "0", "ADJUST", "1", "VALID", "2")
_VECTOR_SIZES = {"HMDPosition": 3, "HMDRotation": 4, "CombinedGazePosition": 3, "CombinedGazeForward": 3}


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
    validated_on = GENERATED_FILES
    fixed_frame = UNITY
    signature = Signature(columns=(("CaptureTime", "HMDPosition", "HMDRotation", "CombinedGazeForward", "GazeStatus"),))

    def read(self, files: Sequence[Path], options: NoOptions, builder: RaysBuilder) -> None:
        builder.add_metadata(tick=_TICK)
        for path in files:
            builder.begin_source(path)
            first = None
            for block in builder.read_table(path, ["CaptureTime"], [*_VECTOR_SIZES, "GazeStatus"]):
                values, texts, lines = block
                is_bad = np.zeros(len(lines), bool)
                vectors = [
                    _parse_vectors(texts[:, i], size, path, name, lines, is_bad, builder.on_bad_line)
                    for i, (name, size) in enumerate(_VECTOR_SIZES.items())
                ]
                if is_bad.all():
                    continue
                position, rotation, eye, forward = (v[~is_bad] for v in vectors)
                matrices = poses.rotations_from_quaternions(rotation)
                # float64 resolves nanoseconds since 1970 to 0.3 us, which is sufficient after subtracting the first.
                first = values[~is_bad][0, 0] if first is None else first
                builder.add(
                    (values[~is_bad, 0] - first) * _TICK,
                    person_from_filename(path),
                    position + poses.rotate(matrices, eye),
                    poses.rotate(matrices, forward),
                    rows=lines[~is_bad],
                    head=matrices[:, :, 2],
                    drop={
                        "GazeStatus is not VALID": ~_is_valid(path, texts[~is_bad, 4]),
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
            f"{path} has the GazeStatus {sanitize(status[unknown][0], 20)!r}, whose meaning is uncertain; it must be "
            f"one of {', '.join(_STATUS_VALUES)}: correct the cells, or import with --map and --valid"
        )
    return np.isin(status, _STATUS_VALUES[-2:])


def _parse_vectors(
    words: np.ndarray,
    size: int,
    path: Path,
    name: str,
    lines: np.ndarray,
    is_bad: np.ndarray,
    on_bad_line: BadLineCallback | None,
) -> np.ndarray:
    """Parse vectors ``(x, y, z)`` in one cell each, (n, size); NaN for empty cells. Lines with an invalid vector are
    marked in ``is_bad`` (n,) bool and reported to ``on_bad_line``; without it they raise `NergError`."""
    out = np.full((len(words), size), np.nan)
    for i, word in enumerate(words.tolist()):
        if word and not is_bad[i]:
            try:
                out[i] = [float(v) for v in word.strip("()").split(",")]
            except ValueError:
                reason = f", column {name!r}: {sanitize(word, 60)!r} is not {size} numbers; correct the cell"
                if on_bad_line is None:
                    raise NergError(
                        f"{path}, line {lines[i]}{reason}, or skip such lines with --skip-bad-lines"
                    ) from None
                on_bad_line(int(lines[i]), reason)
                is_bad[i] = True
    return out
