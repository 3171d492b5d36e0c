"""OpenXR: gaze poses of XR_EXT_eye_gaze_interaction in a reference space.

Right-handed, y up, forward -z, nanoseconds. Poses whose ``location_flags`` lack position or orientation are dropped.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import columns as names
from . import poses
from .base import FROM_DOCUMENTATION, OPENGL, FixedFrameReader, RaysBuilder, Signature, TickOption, tick_option
from .columns import ColumnFinder, mark_valid, require_valid_values
from .table import find_person, person_from_filename

_POSITION_NAMES = (
    *("gaze_pose_position", "eye_gaze_position", "gaze_position", "gaze_pos", "gaze_origin", "pose_position"),
    *names.BARE_POSITION_NAMES,
)
_ORIENTATION_NAMES = (
    *("gaze_pose_orientation", "eye_gaze_orientation", "gaze_orientation", "gaze_rotation", "gaze_rot"),
    *("pose_orientation", "orientation", *names.BARE_ROTATION_NAMES),
)
_TIME_NAMES = ("sample_time", "xr_time", "gaze_time", *names.TIME_NAMES, "predicted_display_time")
_FLAG_NAMES = ("location_flags", "space_location_flags", "flags")
_ACTIVE_NAMES = ("is_active", "gaze_is_active", "active")
_VALID_POSE = 0b11  # XR_SPACE_LOCATION_ORIENTATION_VALID_BIT and XR_SPACE_LOCATION_POSITION_VALID_BIT


@dataclass(frozen=True, kw_only=True)
class OpenXrOptions(TickOption):
    """Options with the unit of XrTime, the nanosecond."""

    tick: float = tick_option(1e-9)


def _recognize(table: ColumnFinder) -> str | None:
    orientation = table.find_vector("gaze_orientation", "gaze_pose_orientation", axes="xyzw")
    return "it has gaze_orientation and location_flags" if orientation and table.find("location_flags") else None


class OpenXr(FixedFrameReader):
    """Tables of gaze poses: right-handed, y up, metres, -z forward.

    Columns are a position (``gaze_position_*``, ``pose_position_*``, ``position_*`` or x, y, z), a quaternion
    (``gaze_orientation_*``, ``orientation_*``, ``q*``: x, y, z, w), the time of the sample, and optionally
    ``location_flags`` and ``is_active``: rows with an invalid position or orientation, or inactive gaze, are dropped.
    Times are relative to the recording's first row. Unity converts the same pose to its left-handed frame; use
    ``quest`` for such logs.
    """

    name = "openxr"
    files = (
        "gaze poses of OpenXR (`XR_EXT_eye_gaze_interaction`): `gaze_position_*`, `gaze_orientation_*` (x, y, z, w), "
        "`time`, optionally `location_flags`, `is_active`"
    )
    frame_description = "OpenXR: y up, right, m, forward -z"
    evidence = FROM_DOCUMENTATION
    fixed_frame = OPENGL
    signature = Signature(table=_recognize)
    Options = OpenXrOptions

    def read(self, files: Sequence[Path], options: OpenXrOptions, builder: RaysBuilder) -> None:
        for path in files:
            table = ColumnFinder(path)
            position, orientation = (
                table.require_vector(*_POSITION_NAMES),
                table.require_vector(*_ORIENTATION_NAMES, axes="xyzw"),
            )
            time, flags = table.require_time(*_TIME_NAMES), table.find(*_FLAG_NAMES)
            active, person = table.find(*_ACTIVE_NAMES), find_person(table, builder)
            builder.begin_source(path)
            numbers = [time, *position, *orientation, *([flags] if flags else [])]
            texts = [name for name in (active, person) if name]
            first = None
            for v, words, lines in builder.read_table(path, numbers, texts, clocks={time: options.tick}):
                word = dict(zip(texts, words.T))
                first = v[0, 0] if first is None else first
                drop = poses.find_unusable_quaternions(v[:, 4:8])
                if flags:
                    flag_bits = np.nan_to_num(v[:, 8]).clip(0, 1 << 30).astype(np.int64) & _VALID_POSE
                    drop["the pose is not valid"] = flag_bits != _VALID_POSE
                if active:
                    counts = Counter(word[active].tolist())
                    values = require_valid_values(path.name, active, counts)
                    drop["the gaze is not active"] = ~mark_valid(word[active], values)
                builder.add(
                    (v[:, 0] - first) * options.tick,
                    word[person] if person else person_from_filename(path),
                    v[:, 1:4],
                    poses.rotations_from_quaternions(v[:, 4:8]) @ poses.parse_axis("-z", "forward"),
                    rows=lines,
                    tracking="eye",
                    drop=drop,
                )


READERS = (OpenXr(),)
