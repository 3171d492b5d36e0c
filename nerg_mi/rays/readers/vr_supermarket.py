"""Eye gaze of people in a VR supermarket, one CSV a person, 50 Hz.

Recorded with "Fixation-based Self-calibration for Eye Tracking in VR Headsets" (github: ryuryu0226).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.ranges import ValidatedDataclass, Range

from . import poses
from .base import RECORDINGS, UNITY, InFrame, RaysBuilder, Signature, option
from .table import person_from_filename

_MATRIX = [f"ctw_{i}{j}" for i in range(3) for j in range(4)]
_COLUMNS = [
    *_MATRIX,
    *("ray_x", "ray_y", "ray_z", "eye_x", "eye_y", "eye_z"),
    *("xc", "yc", "zc", "opennessl", "opennessr", "time"),
]
# From the eyes' frame, +z forward, to the camera's of the matrix.
_FLIP = np.array([1.0, 1.0, -1.0])


@dataclass(frozen=True, kw_only=True)
class SupermarketOptions(ValidatedDataclass):
    """Which rows are kept."""

    min_openness: float = option(
        0.5, "Drop rows in which an eye is open no more than this, from 0 to 1.", within=Range(0, 1)
    )


class VrSupermarket(InFrame):
    """``ctw_ij`` is camera-to-world in Unity's world (y up, left-handed, metres), whose camera looks along minus
    column 2.

    ``ray`` and ``eye`` are in the camera frame with +z forward, so with R, t of that matrix: direction =
    R (rx, ry, -rz), origin = t + R (ex, ey, -ez). ``xc, yc, zc`` is where the combined gaze met the shop, empty where
    it met nothing. A row is kept when both eyes are open by more than ``min_openness``; the smaller openness becomes
    the confidence. The person is ``userN`` of the file name.
    """

    name = "vr_supermarket"
    files = "one CSV a person of the VR supermarket (github: ryuryu0226)"
    world = "Unity"
    checked_on = RECORDINGS
    fixed = UNITY
    signature = Signature(columns=(("ctw_00", "ctw_23", "ray_x", "eye_x", "opennessl", "opennessr", "xc"),))
    Options = SupermarketOptions

    def read(self, files: Sequence[Path], options: SupermarketOptions, builder: RaysBuilder) -> None:
        least = options.min_openness
        for path in files:
            builder.source(path)
            user = re.search(r"user\d+", path.name)
            for v, _, lines in builder.read_table(path, _COLUMNS):
                pose = v[:, :12].reshape(-1, 3, 4)
                turn, place = pose[:, :, :3], pose[:, :, 3]
                openness = np.minimum(v[:, 21], v[:, 22])
                # In the recordings all are mirrored: Unity's world is left-handed, and the camera's frame is not.
                mirrored = poses.is_mirrored(v[:, :12])
                builder.add(
                    v[:, 23],
                    user.group() if user else person_from_filename(path),
                    place + poses.rotate(turn, v[:, 15:18] * _FLIP),
                    poses.rotate(turn, v[:, 12:15] * _FLIP),
                    rows=lines,
                    confidence=np.clip(openness, 0.0, 1.0),
                    hit=v[:, 18:21],
                    head=-turn[:, :, 2],
                    recorded_direction=v[:, 12:15],
                    drop={
                        f"an eye is closed (openness at most {least:g})": openness <= least,
                        "the head's matrix is mirrored against those of most rows": mirrored != (mirrored.mean() > 0.5),
                    },
                )


READERS = (VrSupermarket(),)
