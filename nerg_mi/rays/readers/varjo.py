"""The log of Varjo's eye tracking example for Unity."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import BadLineCallback

from . import poses
from .base import DESCRIPTION, UNITY, InFrame, NoOptions, RaysBuilder, Signature
from .table import person_from_filename

_TICK = 1e-9  # seconds: what CaptureTime counts
_STATUS = ("INVALID", "0", "ADJUST", "1", "VALID", "2")
_VECTORS = {"HMDPosition": 3, "HMDRotation": 4, "CombinedGazePosition": 3, "CombinedGazeForward": 3}


class Varjo(InFrame):
    """Semicolons between cells, vectors as ``(x, y, z)``.

    ``HMDPosition`` and ``HMDRotation`` (x, y, z, w) are the camera's pose in Unity's world, ``CombinedGazePosition``
    and ``CombinedGazeForward`` are in the camera's frame with z forward; ``CaptureTime`` counts nanoseconds, and times
    of rays count from a recording's first row; rows whose ``GazeStatus`` is not VALID are dropped. The file is the
    person.
    """

    name = "varjo"
    files = "the log of Varjo's eye tracking example for Unity"
    world = "Unity"
    checked_on = DESCRIPTION
    fixed = UNITY
    signature = Signature(columns=(("CaptureTime", "HMDPosition", "HMDRotation", "CombinedGazeForward", "GazeStatus"),))

    def read(self, files: Sequence[Path], options: NoOptions, builder: RaysBuilder) -> None:
        builder.note(tick=_TICK)
        for path in files:
            builder.source(path)
            first = None
            for block in builder.read_table(path, ["CaptureTime"], [*_VECTORS, "GazeStatus"]):
                values, texts, lines = block
                bad = np.zeros(len(lines), bool)
                vectors = [
                    _parse_vectors(texts[:, i], size, path, name, lines, bad, builder.on_bad)
                    for i, (name, size) in enumerate(_VECTORS.items())
                ]
                if bad.all():
                    continue
                position, rotation, eye, forward = (v[~bad] for v in vectors)
                turn = poses.rotations_from_quaternions(rotation)
                # Nanoseconds since long ago are known to 0.3 us in float64: fine enough, if counted from the first.
                first = values[~bad][0, 0] if first is None else first
                builder.add(
                    (values[~bad, 0] - first) * _TICK,
                    person_from_filename(path),
                    position + poses.rotate(turn, eye),
                    poses.rotate(turn, forward),
                    rows=lines[~bad],
                    head=turn[:, :, 2],
                    drop={"GazeStatus is not VALID": ~_is_valid(path, texts[~bad, 4])},
                    recorded_origin=position,
                    recorded_direction=forward,
                )


READERS = (Varjo(),)


def _is_valid(path: Path, status: np.ndarray) -> np.ndarray:
    """Whether a GazeStatus (n,) is valid, as a word or as the SDK's code. Raises `NergError` for another value."""
    status = np.char.upper(status)
    unknown = ~np.isin(status, [*_STATUS, ""])
    if unknown.any():
        raise NergError(
            f"{path} has the GazeStatus {sanitize(status[unknown][0], 20)!r}, whose meaning is not certain; it is one of "
            f"{', '.join(_STATUS)}: correct the cells, or import with --map and --valid"
        )
    return np.isin(status, _STATUS[-2:])


def _parse_vectors(
    words: np.ndarray, size: int, path: Path, name: str, lines: np.ndarray, bad: np.ndarray, on_bad: BadLineCallback | None
) -> np.ndarray:
    """Vectors written ``(x, y, z)`` in one cell, (n, size); NaN where the cell is empty. Lines in which it is no vector
    are marked in ``bad`` (n,) bool and told to ``on_bad``; without it they raise `NergError`."""
    out = np.full((len(words), size), np.nan)
    for i, word in enumerate(words.tolist()):
        if word and not bad[i]:
            try:
                out[i] = [float(v) for v in word.strip("()").split(",")]
            except ValueError:
                why = f", column {name!r}: {sanitize(word, 60)!r} is not {size} numbers; mend the cell"
                if on_bad is None:
                    raise NergError(
                        f"{path}, line {lines[i]}{why}, or leave such lines out with --skip-bad-lines"
                    ) from None
                on_bad(int(lines[i]), why)
                bad[i] = True
    return out
