"""Vive Pro Eye: logs of HTC's SRanipal (also Vive Cosmos with the Droolon) in Unity projects.

Millimetres; x of origin and direction is negated, then the head's pose applied. The validity mask is applied, and
both eyes or the combined one are read. ``GetGazeRay`` has negated x already: such logs are ``unity_local``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, parameter

from . import columns as names
from . import poses
from .base import FROM_DOCUMENTATION, UNITY, FixedFrameReader, RaysBuilder, Signature, TickOption, tick_option
from .columns import ColumnFinder
from .poses import find_fill_values
from .table import find_person, person_from_filename

_MILLIMETRE = 1e-3
# The SDK's head frame is right-handed, unlike Unity's: SRanipal_Eye.GetGazeRay negates x of origin and direction.
_TO_UNITY = np.array([-1.0, 1.0, 1.0])
# Bits of the SDK's validity mask for the origin and direction of the gaze.
_VALID_BITS = 0b11
_PREFIXES = ("", "eye_data_", "verbose_data_")
_COMBINED_PREFIXES = tuple(f"{a}{b}" for a in _PREFIXES for b in ("combined_eye_data_", "combined_", ""))
_ORIGIN_NAMES = ("gaze_origin_mm", "gaze_origin")
_DIRECTION_NAMES = ("gaze_direction_normalized", "gaze_direction")
_MASK_NAMES = ("eye_data_validata_bit_mask", "validata_bit_mask", "eye_valid")
_TIME_NAMES = ("time_stamp", "timestamp", "sranipal_timestamp", *names.TIME_NAMES)


@dataclass(frozen=True, kw_only=True)
class SranipalOptions(TickOption):
    """Options with the unit of SRanipal's time, the millisecond."""

    tick: float = tick_option(1e-3)


@dataclass(frozen=True)
class SdkColumns:
    """Names of a table's columns. ``eye_columns``: origin (3), direction (3) and mask (or None) of the combined eye, or
    of the left and the right eye."""

    eye_columns: list[tuple[tuple[str, ...], tuple[str, ...], str | None]]
    head: tuple[str, ...]  # (3,)
    rotation: tuple[str, ...]  # (4,) x, y, z, w
    time: str
    person: str | None


# Names that identify values of the SDK.
_SDK_NAMES = (
    *("gaze_origin_mm", "combined_gaze_origin_mm", "verbose_data_combined_eye_data_gaze_origin_mm"),
    *("combined_eye_data_gaze_origin_mm", "left_gaze_origin_mm", "gaze_origin_l", "gaze_origin_c"),
    "verbose_data_left_gaze_origin_mm",
)


def _recognize(table: ColumnFinder) -> str | None:
    origin, head = table.find_vector(*_SDK_NAMES), table.find_vector(*names.HEADSET_POSITION_NAMES)
    return f"it has {origin[0]} and {head[0]}" if origin and head else None


class Sranipal(FixedFrameReader):
    """Tables with values of the SDK and the head's pose in Unity's world.

    ``gaze_origin_mm`` and ``gaze_direction_normalized`` (of ``combined``, or the mean of ``left`` and ``right``) are in
    a right-handed head frame, in millimetres: x is negated, as the SDK does for Unity. ``head_pos_*`` and
    ``head_rot_*`` (x, y, z, w; also ``hmd_`` and ``camera_``) are the pose in the world. An eye is ignored if its
    ``eye_data_validata_bit_mask`` lacks origin or direction. Values from `GetGazeRay` are already negated: use
    ``unity_local`` for such logs.
    """

    name = "sranipal"
    files = (
        "logs of SRanipal's values (Vive Pro Eye): `gaze_origin_mm`, `gaze_direction_normalized` (of `combined`, "
        "or of `left` and `right`), `eye_data_validata_bit_mask`, with `head_pos_*` and `head_rot_*` (x, y, z, w)"
    )
    frame_description = "Unity; gaze in the right-handed head frame of the SDK"
    evidence = FROM_DOCUMENTATION
    fixed_frame = UNITY
    signature = Signature(table=_recognize)
    Options = SranipalOptions

    def read(self, files: Sequence[Path], options: SranipalOptions, builder: RaysBuilder) -> None:
        for path in files:
            table = ColumnFinder(path)
            columns = _find_columns(table, find_person(table, builder))
            builder.begin_source(path)
            masks = [mask for _, _, mask in columns.eye_columns if mask]
            numbers = [columns.time, *columns.head, *columns.rotation, *masks]
            numbers += [name for origin, direction, _ in columns.eye_columns for name in (*origin, *direction)]
            texts = [columns.person] if columns.person else []
            clocks = {columns.time: options.tick}
            for v, words, lines in builder.read_table(path, numbers, texts, clocks=clocks):
                value = dict(zip(numbers, v.T))
                vector = lambda wanted, value=value: np.stack([value[c] for c in wanted], axis=1)
                origin, direction, is_valid = _average_valid_eyes(columns, vector, value)
                rotation = poses.rotations_from_quaternions(vector(columns.rotation))
                builder.add(
                    value[columns.time] * options.tick,
                    words[:, 0] if columns.person else person_from_filename(path),
                    vector(columns.head) + poses.rotate(rotation, _MILLIMETRE * _TO_UNITY * origin),
                    poses.rotate(rotation, _TO_UNITY * direction),
                    rows=lines,
                    tracking="eye",
                    drop={"no eye is valid": ~is_valid, **poses.find_unusable_quaternions(vector(columns.rotation))},
                    recorded_origin=vector(columns.head),
                )


READERS = (Sranipal(),)


def _average_valid_eyes(columns: SdkColumns, vector, value) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean origin and direction (n, 3) of the valid eyes in the SDK's frame, and whether there is one, (n,) bool."""
    rays_by_eye, valid_by_eye = [], []
    for origin, direction, mask in columns.eye_columns:
        o, d = vector(origin), vector(direction)
        is_valid = np.ones(len(o), bool)
        if mask is not None:
            is_valid = (np.nan_to_num(value[mask]).clip(0, 1 << 30).astype(np.int64) & _VALID_BITS) == _VALID_BITS
        # Lost eyes are zero in older versions, and fill values in logs of some projects.
        is_valid &= np.isnan(find_fill_values(d))
        rays_by_eye.append(np.where(is_valid[:, None, None], np.stack([o, d], axis=1), np.nan))
        valid_by_eye.append(is_valid)
    both = [rays_by_eye[0], rays_by_eye[-1]]
    origin, direction = (poses.average_eyes(np.stack([eye[:, i] for eye in both], axis=1)) for i in (0, 1))
    return origin, direction, np.any(valid_by_eye, axis=0)


def _find_columns(table: ColumnFinder, person: str | None) -> SdkColumns:
    """Find the columns of a table. Raises `NergError` for missing ones."""
    eye_columns = [_find_eye(table, _COMBINED_PREFIXES, "c")]
    if eye_columns[0] is None:
        eye_columns = [_find_eye(table, tuple(f"{a}{side}_" for a in _PREFIXES), side[0]) for side in ("left", "right")]
    complete = [eye for eye in eye_columns if eye is not None]
    if len(complete) < len(eye_columns):
        raise NergError(
            f"{table.path} has no gaze_origin_mm_{{x,y,z}} or no gaze_direction_normalized_{{x,y,z}}; name its "
            f"columns with {parameter('columns')}, or is it a log of another device?"
        )
    head, rotation = (
        table.require_vector(*names.HEADSET_POSITION_NAMES),
        table.require_vector(*names.HEADSET_ROTATION_NAMES, axes="xyzw"),
    )
    return SdkColumns(complete, head, rotation, table.require_time(*_TIME_NAMES), person)


def _find_eye(
    table: ColumnFinder, prefixes: Sequence[str], letter: str
) -> tuple[tuple[str, ...], tuple[str, ...], str | None] | None:
    """Columns of an eye with one of the ``prefixes``, or with its letter as a suffix (``gaze_origin_L.x(mm)``)."""
    stems = lambda words: [*(f"{b}{w}" for w in words for b in prefixes), *(f"{w}_{letter}" for w in words)]
    origin = table.find_vector(*stems(_ORIGIN_NAMES))
    direction = table.find_vector(*stems((*_DIRECTION_NAMES, "gaze_direct")))
    if origin is None or direction is None:
        return None
    return origin, direction, table.find(*stems(_MASK_NAMES))
