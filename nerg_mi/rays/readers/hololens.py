"""HoloLens 2: StreamRecorder (github: microsoft/HoloLens2ForCV) and ARETT (github: AR-Eye-Tracking-Toolkit/ARETT)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .base import DESCRIPTION, OPENGL, UNITY, InFrame, NoOptions, RaysBuilder, Signature
from .table import person_from_filename
from .tables import iterate_table

_TICK = 1e-7  # seconds
_JOINTS = 26  # of a hand, a 4x4 matrix each
_HANDS = 2 * (1 + 16 * _JOINTS)
# The files have no header: time, head, hands, and then the gaze.
_GAZE = ["seen", *(f"{what}{i}" for what in "od" for i in range(4)), "distance"]
_BACK = ["head2", "head6", "head10"]  # the third column of the matrix, row by row
_HEADER = ["t", *(f"head{i}" for i in range(16)), *(f"hand{i}" for i in range(_HANDS)), *_GAZE]


class HoloLens(InFrame):
    """``*_head_hand_eye.csv``, which has no header.

    A line: time in ticks of 100 ns; the head's 4x4 matrix, row by row, which looks along minus its third column; for
    each hand whether it is seen and 26 matrices; whether the gaze is, its origin and direction (homogeneous) and the
    distance to what was met, 0 for nothing. The world is right-handed, y up, metres. Rows in which the eyes were not
    seen are dropped. The person is the file's name before ``_head_hand_eye``; times count from the recording's first
    row.
    """

    name = "hololens"
    files = "`*_head_hand_eye.csv` of HoloLens 2's StreamRecorder"
    world = "y up, right, m"
    checked_on = DESCRIPTION
    fixed = OPENGL
    signature = Signature(ending="_head_hand_eye.csv")

    def read(self, files: Sequence[Path], options: NoOptions, builder: RaysBuilder) -> None:
        builder.note(tick=_TICK)
        builder.note_unused(["hands"])
        for path in files:
            builder.source(path)
            first = None
            for v, _, lines in iterate_table(path, ["t", *_GAZE, *_BACK], header=_HEADER, on_bad=builder.on_bad):
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
                    hit=np.where(distance > 0, origin + distance * unit, np.nan),
                    head=-v[:, 11:],
                    drop={"the eyes were not seen": v[:, 1] != 1},
                )


_MILLISECOND = 1e-3
_VECTORS = [f"{what}_{axis}" for what in ("gazeOrigin", "gazeDirection", "gazePoint") for axis in "xyz"]
_TRUTHS = ["isCalibrationValid", "gazeHasValue", "gazePointHit"]


class Arett(InFrame):
    """A recording's gaze data, in Unity's world (y up, left-handed, metres).

    ``gazeOrigin`` and ``gazeDirection`` are kept where ``gazeHasValue`` and ``isCalibrationValid`` are true;
    ``gazePoint`` is the point looked at where ``gazePointHit`` is. ``eyeDataTimestamp`` counts milliseconds. The file
    is the person.
    """

    name = "arett"
    files = "gaze data of ARETT on HoloLens 2"
    world = "Unity"
    checked_on = DESCRIPTION
    fixed = UNITY
    signature = Signature(
        columns=(("eyeDataTimestamp", "gazeHasValue", "isCalibrationValid", "gazeOrigin_x", "gazeDirection_x"),)
    )

    def read(self, files: Sequence[Path], options: NoOptions, builder: RaysBuilder) -> None:
        builder.note(tick=_MILLISECOND)
        for path in files:
            builder.source(path)
            for block in builder.read_table(path, ["eyeDataTimestamp", *_VECTORS], _TRUTHS):
                v = block.numbers
                calibrated, seen, met = (np.char.lower(block.texts) == "true").T
                builder.add(
                    v[:, 0] * _MILLISECOND,
                    person_from_filename(path),
                    v[:, 1:4],
                    v[:, 4:7],
                    rows=block.lines,
                    hit=np.where(met[:, None], v[:, 7:10], np.nan),
                    drop={"gazeHasValue is not true": ~seen, "isCalibrationValid is not true": ~calibrated},
                )


READERS = (HoloLens(), Arett())
