"""HoloLens 2: StreamRecorder (github: microsoft/HoloLens2ForCV) and ARETT (github: AR-Eye-Tracking-Toolkit/ARETT).

Of ARETT, rows without ``gazeHasValue`` or ``isCalibrationValid`` are dropped; ``gazePoint`` is the hit where
``gazePointHit`` is set.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .base import FROM_DOCUMENTATION, OPENGL, UNITY, FixedFrameReader, NoOptions, RaysBuilder, Signature
from .table import person_from_filename
from .tables import iterate_table

_TICK = 1e-7  # seconds
_JOINTS = 26  # per hand, with a 4x4 matrix each
_HAND_VALUES = 2 * (1 + 16 * _JOINTS)
# The files have no header: time, head, hands, then gaze.
_GAZE_COLUMNS = ["seen", *(f"{what}{i}" for what in "od" for i in range(4)), "distance"]
_BACKWARD_COLUMNS = ["head2", "head6", "head10"]  # the third column of the matrix, row by row
_COLUMNS = ["t", *(f"head{i}" for i in range(16)), *(f"hand{i}" for i in range(_HAND_VALUES)), *_GAZE_COLUMNS]


class HoloLens(FixedFrameReader):
    """``*_head_hand_eye.csv`` without a header.

    Each line contains: time in ticks of 100 ns; the head's 4x4 matrix, row by row, whose forward axis is the negated
    third column; for each hand whether it was tracked, and 26 matrices; whether the gaze was tracked, its origin and
    direction (homogeneous) and the distance to the hit point, 0 without a hit. The world is right-handed, y up, metres.
    Rows without tracked eyes are dropped. The participant is the file name before ``_head_hand_eye``; times are
    relative to the recording's first row.
    """

    name = "hololens"
    files = "`*_head_hand_eye.csv` of HoloLens 2's StreamRecorder"
    frame_description = "y up, right, m"
    evidence = FROM_DOCUMENTATION
    fixed_frame = OPENGL
    signature = Signature(ending="_head_hand_eye.csv")

    def read(self, files: Sequence[Path], options: NoOptions, builder: RaysBuilder) -> None:
        builder.add_metadata(tick=_TICK)
        builder.add_unused_columns(["hands"])
        for path in files:
            builder.begin_source(path)
            first = None
            for v, _, lines in iterate_table(
                path, ["t", *_GAZE_COLUMNS, *_BACKWARD_COLUMNS], header=_COLUMNS, on_bad_line=builder.on_bad_line
            ):
                first = v[0, 0] if first is None else first
                origin, direction, distance = v[:, 2:5], v[:, 6:9], v[:, 10:11]
                with np.errstate(invalid="ignore", divide="ignore"):
                    unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
                builder.add(
                    (v[:, 0] - first) * _TICK,
                    person_from_filename(path).removesuffix("_head_hand_eye"),
                    origin,
                    direction,
                    rows=lines,
                    tracking="eye",
                    hit=np.where(distance > 0, origin + distance * unit, np.nan),
                    head=-v[:, 11:],
                    drop={"the eyes were not seen": v[:, 1] != 1},
                )


_MILLISECOND = 1e-3
_VECTOR_COLUMNS = [f"{what}_{axis}" for what in ("gazeOrigin", "gazeDirection", "gazePoint") for axis in "xyz"]
_FLAG_COLUMNS = ["isCalibrationValid", "gazeHasValue", "gazePointHit"]


class Arett(FixedFrameReader):
    """Gaze data of a recording, in Unity's world (y up, left-handed, metres).

    Rows are kept if ``gazeHasValue`` and ``isCalibrationValid`` are true; ``gazePoint`` is the hit point if
    ``gazePointHit`` is true. ``eyeDataTimestamp`` is in milliseconds. The participant is the file name.
    """

    name = "arett"
    files = "gaze data of ARETT on HoloLens 2"
    frame_description = "Unity"
    evidence = FROM_DOCUMENTATION
    fixed_frame = UNITY
    signature = Signature(
        columns=(("eyeDataTimestamp", "gazeHasValue", "isCalibrationValid", "gazeOrigin_x", "gazeDirection_x"),)
    )

    def read(self, files: Sequence[Path], options: NoOptions, builder: RaysBuilder) -> None:
        builder.add_metadata(tick=_MILLISECOND)
        for path in files:
            builder.begin_source(path)
            for block in builder.read_table(path, ["eyeDataTimestamp", *_VECTOR_COLUMNS], _FLAG_COLUMNS):
                v = block.numbers
                is_calibrated, has_gaze, has_hit = (np.char.lower(block.texts) == "true").T
                builder.add(
                    v[:, 0] * _MILLISECOND,
                    person_from_filename(path),
                    v[:, 1:4],
                    v[:, 4:7],
                    rows=block.lines,
                    tracking="eye",
                    hit=np.where(has_hit[:, None], v[:, 7:10], np.nan),
                    drop={"gazeHasValue is not true": ~has_gaze, "isCalibrationValid is not true": ~is_calibrated},
                )


READERS = (HoloLens(), Arett())
