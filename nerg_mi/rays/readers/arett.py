"""ARETT, the Augmented Reality Eye Tracking Toolkit for HoloLens 2 (github: AR-Eye-Tracking-Toolkit/ARETT)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .base import DESCRIPTION, UNITY, Frame, NoOptions, RaysBuilder, Signature
from .table import person_from_filename

_MILLISECOND = 1e-3
_VECTORS = [f"{what}_{axis}" for what in ("gazeOrigin", "gazeDirection", "gazePoint") for axis in "xyz"]
_TRUTHS = ["isCalibrationValid", "gazeHasValue", "gazePointHit"]


class Arett:
    """A recording's gaze data, in Unity's world (y up, left-handed, metres).

    ``gazeOrigin`` and ``gazeDirection`` are kept where ``gazeHasValue`` and ``isCalibrationValid`` are true;
    ``gazePoint`` is the point looked at where ``gazePointHit`` is. ``eyeDataTimestamp`` counts milliseconds. The file
    is the person.
    """

    name = "arett"
    files = "gaze data of ARETT on HoloLens 2"
    world = "Unity"
    checked_on = DESCRIPTION
    signature = Signature(
        columns=(("eyeDataTimestamp", "gazeHasValue", "isCalibrationValid", "gazeOrigin_x", "gazeDirection_x"),)
    )
    Options = NoOptions

    def frame(self, files: Sequence[Path], options: NoOptions) -> Frame:
        return UNITY

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


READERS = (Arett(),)
