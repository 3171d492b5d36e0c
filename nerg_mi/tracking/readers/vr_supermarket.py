"""VR supermarket: gaze of participants in virtual reality, one CSV per participant, 50 Hz.

Recorded with "Fixation-based Self-calibration for Eye Tracking in VR Headsets" (github: ryuryu0226).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.ranges import Range, ValidatedDataclass

from . import poses
from .base import FROM_RECORDINGS, UNITY, FixedFrameReader, RaysBuilder, Signature, option
from .table import person_from_filename

_MATRIX = [f"ctw_{i}{j}" for i in range(3) for j in range(4)]
_COLUMNS = [
    *_MATRIX,
    *("ray_x", "ray_y", "ray_z", "eye_x", "eye_y", "eye_z"),
    *("xc", "yc", "zc", "opennessl", "opennessr", "time"),
]
# From the eyes' frame, +z forward, to the camera frame of the matrix.
_FLIP = np.array([1.0, 1.0, -1.0])


@dataclass(frozen=True, kw_only=True)
class SupermarketOptions(ValidatedDataclass):
    """Options of the VR supermarket."""

    min_openness: float = option(
        0.5, "Drop rows in which an eye is not more open than this, from 0 to 1.", flag="", within=Range(0, 1)
    )


class VrSupermarket(FixedFrameReader):
    """``ctw_ij`` is the camera-to-world matrix in Unity's world (y up, left-handed, metres), with the camera's forward
    axis opposite to column 2.

    ``ray`` and ``eye`` are in the camera frame with +z forward; with R, t of the matrix, direction = R (rx, ry, -rz)
    and origin = t + R (ex, ey, -ez). ``xc, yc, zc`` is the hit point of the combined gaze, empty without a hit. A row
    is kept if both eyes are open by more than ``min_openness``; the smaller openness is the confidence. The participant
    is ``userN`` of the file name.
    """

    name = "vr_supermarket"
    files = "one CSV per participant of the VR supermarket (github: ryuryu0226)"
    frame_description = "Unity"
    evidence = FROM_RECORDINGS
    fixed_frame = UNITY
    signature = Signature(columns=(("ctw_00", "ctw_23", "ray_x", "eye_x", "opennessl", "opennessr", "xc"),))
    Options = SupermarketOptions

    def read(self, files: Sequence[Path], options: SupermarketOptions, builder: RaysBuilder) -> None:
        min_openness = options.min_openness
        for path in files:
            builder.begin_source(path)
            user = re.search(r"user\d+", path.name)
            for v, _, lines in builder.read_table(path, _COLUMNS):
                pose = v[:, :12].reshape(-1, 3, 4)
                rotation, position = pose[:, :, :3], pose[:, :, 3]
                openness = np.minimum(v[:, 21], v[:, 22])
                # All matrices of these recordings are mirrored: Unity's world is left-handed, the camera frame is not.
                is_mirrored = poses.is_mirrored(v[:, :12])
                builder.add(
                    v[:, 23],
                    user.group() if user else person_from_filename(path),
                    position + poses.rotate(rotation, v[:, 15:18] * _FLIP),
                    poses.rotate(rotation, v[:, 12:15] * _FLIP),
                    rows=lines,
                    tracking="eye",
                    # Slightly above 1 is open; percent are no confidences.
                    confidence=np.where(openness < 2, np.minimum(openness, 1.0), openness),
                    hit=v[:, 18:21],
                    head=-rotation[:, :, 2],
                    recorded_direction=v[:, 12:15],
                    drop={
                        f"an eye is closed: openness at most {min_openness:g} (option min_openness)": openness
                        <= min_openness,
                        "the head's matrix is mirrored against those of most rows": is_mirrored
                        != (is_mirrored.mean() > 0.5),
                        **poses.find_no_rotations(v[:, :12]),
                    },
                )


READERS = (VrSupermarket(),)
