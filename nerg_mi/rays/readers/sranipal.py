"""Logs of HTC's SRanipal (Vive Pro Eye, Vive Cosmos with the Droolon), as Unity projects write them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError

from . import columns as names
from . import poses
from .base import DESCRIPTION, UNITY, InFrame, RaysBuilder, Signature, TickOption, tick_option
from .columns import ColumnFinder
from .poses import fill_values
from .table import find_person, person_from_filename

_MILLIMETRE = 1e-3
# The SDK's head frame is right-handed, Unity's is not: SRanipal_Eye.GetGazeRay negates x of both.
_TO_UNITY = np.array([-1.0, 1.0, 1.0])
# Bits of the SDK's mask of what is valid: origin and direction of the gaze.
_SEEN = 0b11
_WITHIN = ("", "eye_data_", "verbose_data_")
_COMBINED = tuple(f"{a}{b}" for a in _WITHIN for b in ("combined_eye_data_", "combined_", ""))
_ORIGIN = ("gaze_origin_mm", "gaze_origin")
_DIRECTION = ("gaze_direction_normalized", "gaze_direction")
_MASK = ("eye_data_validata_bit_mask", "validata_bit_mask", "eye_valid")
_TIMES = ("time_stamp", "timestamp", "sranipal_timestamp", *names.TIMES)


@dataclass(frozen=True, kw_only=True)
class SranipalOptions(TickOption):
    """SRanipal counts milliseconds."""

    tick: float = tick_option(1e-3)


@dataclass(frozen=True)
class SdkColumns:
    """Names of a table's columns. ``eyes``: of the combined eye, or of the left and the right one, origin (3),
    direction (3) and mask (or None)."""

    eyes: list[tuple[tuple[str, ...], tuple[str, ...], str | None]]
    head: tuple[str, ...]  # (3,)
    turn: tuple[str, ...]  # (4,) x, y, z, w
    time: str
    person: str | None


# By which the SDK's own values are known.
_NAMES = (
    *("gaze_origin_mm", "combined_gaze_origin_mm", "verbose_data_combined_eye_data_gaze_origin_mm"),
    *("combined_eye_data_gaze_origin_mm", "left_gaze_origin_mm", "gaze_origin_l", "gaze_origin_c"),
    "verbose_data_left_gaze_origin_mm",
)


def _recognize(table: ColumnFinder) -> str | None:
    origin, head = table.find_vector(*_NAMES), table.find_vector(*names.MORE_HEADS)
    return f"it has {origin[0]} beside {head[0]}" if origin and head else None


class Sranipal(InFrame):
    """Tables with the SDK's own values beside the head's pose in Unity's world.

    ``gaze_origin_mm`` and ``gaze_direction_normalized`` (of ``combined``, or the mean of ``left`` and ``right``) are in
    a right-handed head frame, in millimetres: x is negated, as the SDK does for Unity. ``head_pos_*`` and
    ``head_rot_*`` (x, y, z, w; ``hmd_`` and ``camera_`` too) lead into the world. An eye whose
    ``eye_data_validata_bit_mask`` lacks origin or direction does not count. Values that `GetGazeRay` gave have been
    negated already: those logs are ``unity_local``.
    """

    name = "sranipal"
    files = (
        "logs of SRanipal's own values (Vive Pro Eye): `gaze_origin_mm`, `gaze_direction_normalized` (of `combined`, "
        "or of `left` and `right`), `eye_data_validata_bit_mask`, beside `head_pos_*` and `head_rot_*` (x, y, z, w)"
    )
    world = "Unity; gaze in the right-handed head frame of the SDK"
    checked_on = DESCRIPTION
    fixed = UNITY
    signature = Signature(table=_recognize)
    Options = SranipalOptions

    def read(self, files: Sequence[Path], options: SranipalOptions, builder: RaysBuilder) -> None:
        for path in files:
            table = ColumnFinder(path)
            columns = _find(table, find_person(table, builder))
            builder.source(path)
            masks = [mask for _, _, mask in columns.eyes if mask]
            numbers = [columns.time, *columns.head, *columns.turn, *masks]
            numbers += [name for origin, direction, _ in columns.eyes for name in (*origin, *direction)]
            texts = [columns.person] if columns.person else []
            clocks = {columns.time: options.tick}
            for v, words, lines in builder.read_table(path, numbers, texts, clocks=clocks):
                value = dict(zip(numbers, v.T))
                vector = lambda wanted, value=value: np.stack([value[c] for c in wanted], axis=1)
                origin, direction, seen = _eyes(columns, vector, value)
                turn = poses.rotations_from_quaternions(vector(columns.turn))
                builder.add(
                    value[columns.time] * options.tick,
                    words[:, 0] if columns.person else person_from_filename(path),
                    vector(columns.head) + poses.rotate(turn, _MILLIMETRE * _TO_UNITY * origin),
                    poses.rotate(turn, _TO_UNITY * direction),
                    rows=lines,
                    drop={"no eye is valid": ~seen},
                    recorded_origin=vector(columns.head),
                )


READERS = (Sranipal(),)


def _eyes(columns: SdkColumns, vector, value) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origin and direction (n, 3) in the SDK's frame, the mean of the eyes that are valid, and where one is, (n,)."""
    found, seen = [], []
    for origin, direction, mask in columns.eyes:
        o, d = vector(origin), vector(direction)
        good = np.ones(len(o), bool)
        if mask is not None:
            good = (np.nan_to_num(value[mask]).clip(0, 1 << 30).astype(np.int64) & _SEEN) == _SEEN
        # Eyes that were lost are zeros in older versions, and fill values in logs of some projects.
        good &= np.isnan(fill_values(d))
        found.append(np.where(good[:, None, None], np.stack([o, d], axis=1), np.nan))
        seen.append(good)
    both = [found[0], found[-1]]
    origin, direction = (poses.mean_of_two(np.stack([eye[:, i] for eye in both], axis=1)) for i in (0, 1))
    return origin, direction, np.any(seen, axis=0)


def _find(table: ColumnFinder, person: str | None) -> SdkColumns:
    """The columns of a table; `NergError` for those that are missing."""
    eyes = [_eye(table, _COMBINED, "c")]
    if eyes[0] is None:
        eyes = [_eye(table, tuple(f"{a}{side}_" for a in _WITHIN), side[0]) for side in ("left", "right")]
    whole = [eye for eye in eyes if eye is not None]
    if len(whole) < len(eyes):
        raise NergError(
            f"{table.path} has no gaze_origin_mm_{{x,y,z}} or no gaze_direction_normalized_{{x,y,z}}; name its columns "
            "with --map, or is it a log of another device?"
        )
    head, turn = table.vector(*names.MORE_HEADS), table.vector(*names.MORE_ROTATIONS, axes="xyzw")
    return SdkColumns(whole, head, turn, table.time(*_TIMES), person)


def _eye(
    table: ColumnFinder, before: Sequence[str], letter: str
) -> tuple[tuple[str, ...], tuple[str, ...], str | None] | None:
    """Columns of an eye whose names begin with one of ``before``, or end with its letter (``gaze_origin_L.x(mm)``)."""
    stems = lambda words: [*(f"{b}{w}" for w in words for b in before), *(f"{w}_{letter}" for w in words)]
    origin = table.find_vector(*stems(_ORIGIN))
    direction = table.find_vector(*stems((*_DIRECTION, "gaze_direct")))
    if origin is None or direction is None:
        return None
    return origin, direction, table.find(*stems(_MASK))
