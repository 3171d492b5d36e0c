"""Logs of Meta Quest Pro's eyes as Unity projects write them: OVREyeGaze, or the pose of Unity's eye gaze device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.ranges import Range

from . import columns as names
from . import poses
from .base import DESCRIPTION, UNITY, InFrame, RaysBuilder, Signature, TickOption, option
from .columns import ColumnFinder
from .poses import fill_values
from .table import find_person, person_from_filename

_POSITION, _ROTATION = ("position", "pos"), ("rotation", "rot", "orientation")
_ONE = ("eye_gaze_", "eye_", "gaze_pose_", "gaze_", "pose_", "")
_RIG = ("rig_", "camera_rig_", "tracking_space_", "tracking_origin_")


@dataclass(frozen=True, kw_only=True)
class QuestOptions(TickOption):
    """What is kept."""

    min_confidence: float = option(0.5, "Drop rows below this confidence.", within=Range(0, 1))


def _recognize(table: ColumnFinder) -> str | None:
    left = table.find_vector(*(f"left_eye_{word}" for word in (*_ROTATION, "gaze_rotation")), axes="xyzw")
    return f"it has a pose of each eye ({left[0]})" if left else None


class Quest(InFrame):
    """Poses of the eyes in tracking space: Unity's, y up, left-handed, metres, looking along z.

    Of each eye ``left_eye_position_*`` and ``left_eye_rotation_*`` (x, y, z, w; ``right_`` too), or of one gaze
    (``eye_``, ``gaze_``, ``pose_``); ``rig_position_*`` and ``rig_rotation_*``, where there are, lead from tracking
    space into the world. The ray is the mean of the eyes'. ``confidence`` (of each eye: the smaller one) is that of
    OVREyeGaze, below whose usual threshold of ``min_confidence`` rows are dropped.
    """

    name = "quest"
    files = (
        "logs of OVREyeGaze on Quest Pro, or of Unity's eye gaze device: `left_eye_position_*`, `left_eye_rotation_*` "
        "(x, y, z, w), the same of `right_`, or one pose `gaze_*`; if there are, `rig_*`, `confidence`"
    )
    world = "Unity"
    checked_on = DESCRIPTION
    fixed = UNITY
    signature = Signature(table=_recognize)
    Options = QuestOptions

    def read(self, files: Sequence[Path], options: QuestOptions, builder: RaysBuilder) -> None:
        for path in files:
            table = ColumnFinder(path)
            eyes = [_pose(table, _sides(side)) for side in ("left", "right")]
            eyes = [e for e in eyes if e] if all(eyes) else [_needed(table)]
            rig, time, person = _pose(table, _RIG), table.time(*names.TIMES), find_person(table, builder)
            each = [table.find(*(f"{b}confidence" for b in _sides(side))) for side in ("left", "right")]
            one = table.find("confidence", "gaze_confidence", "eye_confidence")
            sure = [c for c in each if c] or [c for c in [one] if c]
            builder.source(path)
            numbers = [time, *(name for pose in (*eyes, *([rig] if rig else [])) for name in pose), *sure]
            texts, clocks = [person] if person else [], {time: options.tick}
            for v, words, lines in builder.read_table(path, numbers, texts, clocks=clocks):
                found = v[:, 1 : 1 + 7 * (len(eyes) + bool(rig))].reshape(len(v), -1, 7)
                origin, direction = _ray(found, len(eyes))
                confidence = v[:, len(numbers) - len(sure) :].min(axis=1) if sure else np.ones(len(v))
                builder.add(
                    v[:, 0] * options.tick,
                    words[:, 0] if person else person_from_filename(path),
                    origin,
                    direction,
                    rows=lines,
                    confidence=confidence,
                    recorded_origin=found[:, : len(eyes), :3].mean(axis=1),
                    drop={f"confidence below {options.min_confidence:g}": confidence < options.min_confidence},
                )


READERS = (Quest(),)


def _ray(found: np.ndarray, eyes: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions (n, 3) of poses (n, P, 7): those of the eyes, and, after them, of the rig."""
    turns = [poses.rotations_from_quaternions(found[:, k, 3:]) for k in range(found.shape[1])]
    looks = np.stack([turn @ poses.axis("z", "forward") for turn in turns[:eyes]], axis=1)
    places = found[:, :eyes, :3].copy()
    # Of two eyes, one at a fill value was lost; both are left to the builder, which knows the other rows.
    filled = np.isfinite(fill_values(places))
    places[filled & ~filled.all(axis=1, keepdims=True)] = np.nan
    origin, direction = places.mean(axis=1), looks.mean(axis=1)
    if found.shape[1] > eyes:
        origin = found[:, -1, :3] + poses.rotate(turns[-1], origin)
        direction = poses.rotate(turns[-1], direction)
    return origin, direction


def _sides(side: str) -> tuple[str, ...]:
    return f"{side}_eye_gaze_", f"{side}_eye_", f"{side}_gaze_", f"{side}_", f"eye_{side}_"


def _pose(table: ColumnFinder, before: Sequence[str]) -> tuple[str, ...] | None:
    """Place and quaternion (7) whose names begin with one of ``before``."""
    place = table.find_vector(*(f"{b}{w}" for b in before for w in _POSITION))
    turn = table.find_vector(*(f"{b}{w}" for b in before for w in _ROTATION), axes="xyzw")
    return None if place is None or turn is None else (*place, *turn)


def _needed(table: ColumnFinder) -> tuple[str, ...]:
    place = table.vector(*(f"{b}{w}" for b in _ONE for w in _POSITION), "")
    return *place, *table.vector(*(f"{b}{w}" for b in _ONE for w in _ROTATION), *names.BARE_ROTATIONS, axes="xyzw")
