"""Meta Quest Pro: gaze logs of Unity projects, by OVREyeGaze, or the pose of Unity's eye gaze device.

Poses of OVREyeGaze are in tracking space and are multiplied by the rig's pose (``rig_position_*``,
``rig_rotation_*``) if it is logged; otherwise the motion of a moving rig is missing. The ray is the mean of both
eyes; rows with a ``confidence`` below 0.5 (``--min-confidence``) are dropped. Unity's eye gaze device
(``gaze_position_*``, ``gaze_rotation_*``) is left-handed already.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.ranges import Range

from . import columns as names
from . import poses
from .base import FROM_DOCUMENTATION, UNITY, FixedFrameReader, RaysBuilder, Signature, TickOption, option
from .columns import ColumnFinder
from .poses import find_fill_values
from .table import find_person, person_from_filename

_POSITION_WORDS, _ROTATION_WORDS = ("position", "pos"), ("rotation", "rot", "orientation")
_GAZE_PREFIXES = ("eye_gaze_", "eye_", "gaze_pose_", "gaze_", "pose_", "")
_RIG_PREFIXES = ("rig_", "camera_rig_", "tracking_space_", "tracking_origin_")


@dataclass(frozen=True, kw_only=True)
class QuestOptions(TickOption):
    """Options of Quest Pro."""

    min_confidence: float = option(0.5, "Drop rows below this confidence.", within=Range(0, 1))


def _recognize(table: ColumnFinder) -> str | None:
    left = table.find_vector(*(f"left_eye_{word}" for word in (*_ROTATION_WORDS, "gaze_rotation")), axes="xyzw")
    return f"it has a pose of each eye ({left[0]})" if left else None


class Quest(FixedFrameReader):
    """Poses of the eyes in tracking space: Unity's axes, y up, left-handed, metres, z forward.

    Columns are ``left_eye_position_*`` and ``left_eye_rotation_*`` (x, y, z, w; also with ``right_``), or those of one
    gaze (``eye_``, ``gaze_``, ``pose_``); optionally ``rig_position_*`` and ``rig_rotation_*``, the pose of tracking
    space in the world. The ray is the mean of both eyes. ``confidence`` (of two eyes, the smaller one) is that of
    OVREyeGaze; rows below ``min_confidence``, by default its usual threshold, are dropped.
    """

    name = "quest"
    files = (
        "logs of OVREyeGaze on Quest Pro, or of Unity's eye gaze device: `left_eye_position_*`, `left_eye_rotation_*` "
        "(x, y, z, w), the same with `right_`, or one pose `gaze_*`; optionally `rig_*`, `confidence`"
    )
    frame_description = "Unity"
    evidence = FROM_DOCUMENTATION
    fixed_frame = UNITY
    signature = Signature(table=_recognize)
    Options = QuestOptions

    def read(self, files: Sequence[Path], options: QuestOptions, builder: RaysBuilder) -> None:
        for path in files:
            table = ColumnFinder(path)
            eye_columns = [_find_pose(table, _make_prefixes(side)) for side in ("left", "right")]
            eye_columns = [e for e in eye_columns if e] if all(eye_columns) else [_require_pose(table)]
            rig, time, person = (
                _find_pose(table, _RIG_PREFIXES),
                table.require_time(*names.TIME_NAMES),
                find_person(table, builder),
            )
            eye_confidences = [
                table.find(*(f"{b}confidence" for b in _make_prefixes(side))) for side in ("left", "right")
            ]
            gaze_confidence = table.find("confidence", "gaze_confidence", "eye_confidence")
            confidence_columns = [c for c in eye_confidences if c] or [c for c in [gaze_confidence] if c]
            builder.begin_source(path)
            numbers = [
                time,
                *(name for pose in (*eye_columns, *([rig] if rig else [])) for name in pose),
                *confidence_columns,
            ]
            texts, clocks = [person] if person else [], {time: options.tick}
            for v, words, lines in builder.read_table(path, numbers, texts, clocks=clocks):
                poses_read = v[:, 1 : 1 + 7 * (len(eye_columns) + bool(rig))].reshape(len(v), -1, 7)
                origin, direction = _compute_rays(poses_read, len(eye_columns))
                confidence = (
                    v[:, len(numbers) - len(confidence_columns) :].min(axis=1)
                    if confidence_columns
                    else np.ones(len(v))
                )
                builder.add(
                    v[:, 0] * options.tick,
                    words[:, 0] if person else person_from_filename(path),
                    origin,
                    direction,
                    rows=lines,
                    tracking="eye",
                    confidence=confidence,
                    recorded_origin=poses_read[:, : len(eye_columns), :3].mean(axis=1),
                    drop={
                        f"confidence below {options.min_confidence:g} (option min_confidence)": confidence
                        < options.min_confidence,
                        **_find_unusable(poses_read),
                    },
                )


READERS = (Quest(),)


def _compute_rays(values: np.ndarray, num_eyes: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute origins and directions (n, 3) from poses (n, P, 7) of the eyes, optionally followed by that of the
    rig."""
    rotations = [poses.rotations_from_quaternions(values[:, k, 3:]) for k in range(values.shape[1])]
    directions = np.stack([rotation @ poses.parse_axis("z", "forward") for rotation in rotations[:num_eyes]], axis=1)
    positions = values[:, :num_eyes, :3].copy()
    # If only one eye has a fill value, it was lost. If both have, the builder decides from the other rows.
    is_filled = np.isfinite(find_fill_values(positions))
    positions[is_filled & ~is_filled.all(axis=1, keepdims=True)] = np.nan
    origin, direction = positions.mean(axis=1), directions.mean(axis=1)
    if values.shape[1] > num_eyes:
        origin = values[:, -1, :3] + poses.rotate(rotations[-1], origin)
        direction = poses.rotate(rotations[-1], direction)
    return origin, direction


def _find_unusable(values: np.ndarray) -> dict[str, np.ndarray]:
    """`poses.find_unusable_quaternions` of any of the poses (n, P, 7)."""
    reasons = poses.find_unusable_quaternions(values[:, :, 3:].reshape(-1, 4))
    return {reason: np.asarray(mask.reshape(values.shape[:2]).any(axis=1)) for reason, mask in reasons.items()}


def _make_prefixes(side: str) -> tuple[str, ...]:
    return f"{side}_eye_gaze_", f"{side}_eye_", f"{side}_gaze_", f"{side}_", f"eye_{side}_"


def _find_pose(table: ColumnFinder, prefixes: Sequence[str]) -> tuple[str, ...] | None:
    """Columns of a position and a quaternion (7) with one of the ``prefixes``."""
    position = table.find_vector(*(f"{b}{w}" for b in prefixes for w in _POSITION_WORDS))
    rotation = table.find_vector(*(f"{b}{w}" for b in prefixes for w in _ROTATION_WORDS), axes="xyzw")
    return None if position is None or rotation is None else (*position, *rotation)


def _require_pose(table: ColumnFinder) -> tuple[str, ...]:
    position = table.require_vector(*(f"{b}{w}" for b in _GAZE_PREFIXES for w in _POSITION_WORDS), "")
    return *position, *table.require_vector(
        *(f"{b}{w}" for b in _GAZE_PREFIXES for w in _ROTATION_WORDS), *names.BARE_ROTATION_NAMES, axes="xyzw"
    )
