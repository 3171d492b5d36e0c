"""Recordings of OpenXR's XR_EXT_eye_gaze_interaction: a pose of the gaze in a reference space."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import columns as names
from . import poses
from .base import DESCRIPTION, OPENGL, InFrame, RaysBuilder, Signature, TickOption, tick_option
from .columns import ColumnFinder, mark_valid, require_valid_values
from .table import find_person, person_from_filename

_PLACES = (
    *("gaze_pose_position", "eye_gaze_position", "gaze_position", "gaze_pos", "gaze_origin", "pose_position"),
    *names.BARE_PLACES,
)
_TURNS = (
    *("gaze_pose_orientation", "eye_gaze_orientation", "gaze_orientation", "gaze_rotation", "gaze_rot"),
    *("pose_orientation", "orientation", *names.BARE_ROTATIONS),
)
_TIMES = ("sample_time", "xr_time", "gaze_time", *names.TIMES, "predicted_display_time")
_FLAGS = ("location_flags", "space_location_flags", "flags")
_ACTIVE = ("is_active", "gaze_is_active", "active")
_KNOWN = 0b11  # XR_SPACE_LOCATION_ORIENTATION_VALID_BIT and XR_SPACE_LOCATION_POSITION_VALID_BIT


@dataclass(frozen=True, kw_only=True)
class OpenXrOptions(TickOption):
    """XrTime counts nanoseconds."""

    tick: float = tick_option(1e-9)


def _recognize(table: ColumnFinder) -> str | None:
    turn = table.find_vector("gaze_orientation", "gaze_pose_orientation", axes="xyzw")
    return "it has gaze_orientation and location_flags" if turn and table.find("location_flags") else None


class OpenXr(InFrame):
    """Tables of the gaze's pose: right-handed, y up, metres, looking along -z.

    A place (``gaze_position_*``, ``pose_position_*``, ``position_*`` or x, y, z) and a quaternion
    (``gaze_orientation_*``, ``orientation_*``, ``q*``: x, y, z, w), each sample's time, and, where there are,
    ``location_flags`` and ``is_active``: rows in which place or orientation is not valid, or nobody looks, are dropped.
    Times count from a recording's first row. What Unity gives for the same pose has been turned into its own
    left-handed frame: that is ``quest``.
    """

    name = "openxr"
    files = (
        "gaze poses of OpenXR (`XR_EXT_eye_gaze_interaction`): `gaze_position_*`, `gaze_orientation_*` (x, y, z, w), "
        "`time`, if there are `location_flags`, `is_active`"
    )
    world = "OpenXR: y up, right, m, forward -z"
    checked_on = DESCRIPTION
    fixed = OPENGL
    signature = Signature(table=_recognize)
    Options = OpenXrOptions

    def read(self, files: Sequence[Path], options: OpenXrOptions, builder: RaysBuilder) -> None:
        for path in files:
            table = ColumnFinder(path)
            place, turn = table.vector(*_PLACES), table.vector(*_TURNS, axes="xyzw")
            time, flags = table.time(*_TIMES), table.find(*_FLAGS)
            active, person = table.find(*_ACTIVE), find_person(table, builder)
            builder.source(path)
            numbers = [time, *place, *turn, *([flags] if flags else [])]
            texts = [name for name in (active, person) if name]
            first = None
            for v, words, lines in builder.read_table(path, numbers, texts, clocks={time: options.tick}):
                word = dict(zip(texts, words.T))
                first = v[0, 0] if first is None else first
                drop = {}
                if flags:
                    known = np.nan_to_num(v[:, 8]).clip(0, 1 << 30).astype(np.int64) & _KNOWN
                    drop["the pose is not valid"] = known != _KNOWN
                if active:
                    counts = Counter(word[active].tolist())
                    values = require_valid_values(path.name, active, counts)
                    drop["the gaze is not active"] = ~mark_valid(word[active], values)
                builder.add(
                    (v[:, 0] - first) * options.tick,
                    word[person] if person else person_from_filename(path),
                    v[:, 1:4],
                    poses.rotations_from_quaternions(v[:, 4:8]) @ poses.axis("-z", "forward"),
                    rows=lines,
                    drop=drop,
                )


READERS = (OpenXr(),)
