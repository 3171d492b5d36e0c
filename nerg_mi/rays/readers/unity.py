"""Logs of Unity projects, by the names that their columns usually have: gaze in the world, in the head, or heads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError, sanitize

from . import columns as names
from .base import DESCRIPTION, UNITY, InFrame, RaysBuilder, Signature, TickOption, valid_option
from .columns import ColumnFinder, ColumnMap, is_validity, parse_valid
from .table import TableOptions, add_tables, find_person


@dataclass(frozen=True, kw_only=True)
class UnityOptions(TickOption):
    """What names do not say. Raises `NergError` for a text that names no column with values."""

    valid: str | None = valid_option()

    def __post_init__(self) -> None:
        super().__post_init__()
        parse_valid(self.valid)


class UnityReader(InFrame):
    """Tables of Unity's world (y up, left-handed, metres), whose columns are found by name.

    Where there are, ``hit_*`` (or ``gaze_hit_*``, ``hit_point_*``), a time, a person, ``confidence`` and columns of
    validity (``status``, ``isValid``, ``GazeValidity``: rows that are not valid are dropped) are read too. Without a
    person the file is the person. ``columns_of``: the columns that say where from and whereto.
    """

    world = "Unity: y up, left, m"
    checked_on = DESCRIPTION
    fixed = UNITY
    # What projects call the gaze does not say of which frame it is: a column map is proposed.
    signature = Signature()
    Options = UnityOptions

    def __init__(self, name: str, files: str, columns_of: Callable[[ColumnFinder], dict]) -> None:
        self.name, self.files, self._columns_of = name, files, columns_of

    def read(self, files: Sequence[Path], options: UnityOptions, builder: RaysBuilder) -> None:
        first, *others = (ColumnFinder(path) for path in files)
        columns = self._map(first, find_person(first, builder))
        for other in others:
            # Tables of one recording have the same columns.
            if (found := str(self._map(other, find_person(other, builder)))) != str(columns):
                raise NergError(
                    f"{other.path} has other columns ({sanitize(found)}) than {first.path} ({sanitize(columns)}); "
                    "import them apart, or with one column map (--map)"
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
        add_tables(files, settings, builder, [name for name in first.columns if is_validity(name)])

    def _map(self, table: ColumnFinder, person: str | None) -> ColumnMap:
        return ColumnMap(
            **self._columns_of(table),
            hit=table.find_vector(*names.HITS),
            t=table.find(*names.TIMES),
            person=person,
            confidence=table.find("confidence"),
        )


def _gaze_in_world(table: ColumnFinder) -> dict:
    return {
        "direction": table.vector(*names.DIRECTIONS, *names.BARE_DIRECTIONS),
        "origin": table.vector(*names.EYES, *names.BARE_PLACES),
        "head": table.find_vector(*names.ROTATIONS, axes="xyzw"),  # for the checks
    }


def _gaze_in_head(table: ColumnFinder) -> dict:
    return {
        "direction": table.vector(*names.DIRECTIONS, *names.BARE_DIRECTIONS),
        "eye": table.find_vector(*names.EYES),
        "origin": table.vector(*names.HEADS, *names.BARE_PLACES),
        "xyzw": table.vector(*names.ROTATIONS, *names.BARE_ROTATIONS, axes="xyzw"),
    }


def _heads(table: ColumnFinder) -> dict:
    rotation = table.find_vector(*names.ROTATIONS, *names.BARE_ROTATIONS, axes="xyzw")
    if rotation is not None:
        return {"origin": table.vector(*names.HEADS, *names.BARE_PLACES), "xyzw": rotation}
    # Unity's Euler angles in degrees are pitch, yaw and roll.
    x, y, z = table.vector(*names.ROTATIONS, "rot", "rotation")
    return {"origin": table.vector(*names.HEADS, *names.BARE_PLACES), "ypr": (y, x, z)}


READERS = (
    UnityReader(
        "unity",
        "logs of gaze in the world: `gaze_origin_*`, `gaze_dir_*` (or `gaze_direction_*`, `gaze_forward_*`), if there "
        "are: `hit_*`, a time, a person, a validity (`status`, `isValid`)",
        _gaze_in_world,
    ),
    UnityReader(
        "unity_local",
        "the same in the head's frame (z forward), beside `head_pos_*` and `head_rot_*` (x, y, z, w); without "
        "`gaze_origin_*` the eye is the head",
        _gaze_in_head,
    ),
    UnityReader(
        "unity_head", "heads alone: `head_pos_*`, `head_rot_*` (a quaternion, or Unity's Euler angles)", _heads
    ),
)
