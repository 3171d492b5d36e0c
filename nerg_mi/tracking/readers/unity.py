"""Unity: logs of projects with usual column names, with gaze in the world or in the head's frame, or heads only.

Columns are found by usual names in any spelling (``gazeOrigin_x``, ``GazeOriginX``, ``gaze origin [x]``); bare names
(``origin_x``, ``x``, ``qx``) only if no other is present.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError, parameter, sanitize

from . import columns as names
from .base import FROM_DOCUMENTATION, UNITY, FixedFrameReader, RaysBuilder, Signature, TickOption, valid_option
from .columns import ColumnFinder, ColumnMap, is_validity_column, parse_valid
from .table import TableOptions, add_tables, find_person


@dataclass(frozen=True, kw_only=True)
class UnityOptions(TickOption):
    """Options of Unity logs. Raises `NergError` for an invalid ``valid``."""

    valid: str | None = valid_option()

    def __post_init__(self) -> None:
        super().__post_init__()
        parse_valid(self.valid)


class UnityReader(FixedFrameReader):
    """Tables in Unity's world (y up, left-handed, metres), with columns found by name.

    Optional columns are ``hit_*`` (or ``gaze_hit_*``, ``hit_point_*``), a time, a participant, ``confidence`` and
    columns of validity (``status``, ``isValid``, ``GazeValidity``), whose invalid rows are dropped. Without a
    participant, each file is one participant. ``find_columns`` finds the columns of origin and direction in a table.
    """

    frame_description = "Unity: y up, left, m"
    evidence = FROM_DOCUMENTATION
    fixed_frame = UNITY
    # Usual column names do not tell the frame of the gaze: `nerg rays guess` proposes a column map instead.
    signature = Signature()
    Options = UnityOptions

    def __init__(self, name: str, files: str, find_columns: Callable[[ColumnFinder], dict]) -> None:
        self.name, self.files, self._find_columns = name, files, find_columns

    def read(self, files: Sequence[Path], options: UnityOptions, builder: RaysBuilder) -> None:
        first, *other_tables = (ColumnFinder(path) for path in files)
        columns = self._make_map(first, find_person(first, builder))
        for other in other_tables:
            # All tables must have the same columns.
            if (other_columns := str(self._make_map(other, find_person(other, builder)))) != str(columns):
                raise NergError(
                    f"{other.path} has other columns ({sanitize(other_columns)}) than {first.path} "
                    f"({sanitize(columns)}); import them separately, or with one column map "
                    f"({parameter('columns')})"
                )
        settings = TableOptions(
            columns=columns,
            up=UNITY.up,
            handedness=UNITY.handedness,
            units=UNITY.units,
            forward="z",
            valid=options.valid,
            tick=options.tick,
        )
        add_tables(files, settings, builder, [name for name in first.columns if is_validity_column(name)])

    def _make_map(self, table: ColumnFinder, person: str | None) -> ColumnMap:
        return ColumnMap(
            **self._find_columns(table),
            hit=table.find_vector(*names.HIT_NAMES),
            t=table.find_time(*names.TIME_NAMES),
            person=person,
            confidence=table.find("confidence"),
        )


def _find_gaze_in_world(table: ColumnFinder) -> dict:
    return {
        "direction": table.require_vector(*names.DIRECTION_NAMES, *names.BARE_DIRECTION_NAMES),
        "origin": table.require_vector(*names.EYE_NAMES, *names.BARE_POSITION_NAMES),
        "head": table.find_vector(*names.HEADSET_ROTATION_NAMES, axes="xyzw"),  # for the checks
    }


def _find_gaze_in_head(table: ColumnFinder) -> dict:
    return {
        "direction": table.require_vector(*names.DIRECTION_NAMES, *names.BARE_DIRECTION_NAMES),
        "eye": table.find_vector(*names.EYE_NAMES),
        "origin": table.require_vector(*names.HEADSET_POSITION_NAMES, *names.BARE_POSITION_NAMES),
        "xyzw": table.require_vector(*names.HEADSET_ROTATION_NAMES, *names.BARE_ROTATION_NAMES, axes="xyzw"),
    }


def _find_heads(table: ColumnFinder) -> dict:
    rotation = table.find_vector(*names.HEADSET_ROTATION_NAMES, *names.BARE_ROTATION_NAMES, axes="xyzw")
    if rotation is not None:
        return {
            "origin": table.require_vector(*names.HEADSET_POSITION_NAMES, *names.BARE_POSITION_NAMES),
            "xyzw": rotation,
        }
    # Unity's Euler angles in degrees are pitch, yaw and roll.
    x, y, z = table.require_vector(*names.HEADSET_ROTATION_NAMES, "rot", "rotation")
    return {"origin": table.require_vector(*names.HEADSET_POSITION_NAMES, *names.BARE_POSITION_NAMES), "ypr": (y, x, z)}


READERS = (
    UnityReader(
        "unity",
        "logs of Unity with gaze in the world: `gaze_origin_*`, `gaze_dir_*` (or `gaze_direction_*`, "
        "`gaze_forward_*`), optionally `hit_*`, a time, a participant, a validity (`status`, `isValid`)",
        _find_gaze_in_world,
    ),
    UnityReader(
        "unity_local",
        "logs of Unity with gaze in the head's frame (z forward): as for `unity`, with `head_pos_*` and `head_rot_*` "
        "(x, y, z, w); without `gaze_origin_*` the eye is at the head",
        _find_gaze_in_head,
    ),
    UnityReader(
        "unity_head",
        "logs of Unity with heads only: `head_pos_*`, `head_rot_*` (a quaternion, or Unity's Euler angles)",
        _find_heads,
    ),
)
