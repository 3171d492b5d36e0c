"""Poses of a scene camera with their times, as tag-aligner and Pupil Cloud's Reference Image Mapper write them.

Both are of each interval of the recording the camera-to-world pose, in OpenCV's axes and in the unit of a tag, or of no
known unit. Seconds count from the recording's start. ``poses.p``, which the same tools keep, runs code when it is
opened, and is never read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import read_json
from nerg_mi.files.line_blocks import OnBadLine
from nerg_mi.rays.readers.parsing.pose_track import PoseTrack
from nerg_mi.rays.readers.parsing.tables import iterate_table

_PLACE = tuple(f"translation_{a}" for a in "xyz")
_QUATERNION = tuple(f"rotation_{a}" for a in "xyzw")
_VECTOR = _QUATERNION[:3]


def is_timed(path: Path) -> bool:
    """Whether the name is that of poses with times, and not of a model's."""
    return path.suffix.lower() in (".csv", ".p") or path.name == "camera_pose.json"


def read_timed_poses(path: Path, on_bad: OnBadLine | None = None) -> tuple[PoseTrack, int]:
    """The track in ``aligned_poses.csv`` or ``camera_pose.json``, and how many poses the file lists.

    A pose holds from ``start_timestamp``, when its frame was taken. Raises `NergError` for a file that is neither, or
    holds fewer than two poses.
    """
    if path.suffix.lower() == ".p":
        raise NergError(f"{path} is a pickle, which may run code, and is not read; give aligned_poses.csv beside it")
    times, vectors, places = _of_csv(path, on_bad) if path.suffix.lower() == ".csv" else _of_json(path)
    track = PoseTrack.of_samples(times, vectors, places)
    if track is None:
        raise NergError(f"{path} holds {len(times)} poses; two that are whole are needed to interpolate between")
    return track, len(times)


def _of_csv(path: Path, on_bad: OnBadLine | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    from scipy.spatial.transform import Rotation

    blocks = iterate_table(path, ["start_timestamp", *_PLACE, *_QUATERNION], on_bad=on_bad)
    rows = np.concatenate([block.numbers for block in blocks] or [np.empty((0, 8))])
    length = np.linalg.norm(rows[:, 4:], axis=1)
    good = np.isfinite(length) & (length > 1e-12)
    vectors = np.full((len(rows), 3), np.nan)
    if good.any():
        vectors[good] = Rotation.from_quat(rows[good, 4:]).as_rotvec()
    return rows[:, 0], vectors, rows[:, 1:4]


def _of_json(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    found: Any = read_json(path, "file of camera poses")
    if isinstance(found, dict):
        found = found.get("result")
    try:
        rows = np.array(
            [[float(pose[key]) for key in ("start_timestamp", *_VECTOR, *_PLACE)] for pose in found], np.float64
        ).reshape(-1, 7)
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise NergError(
            f'"{path}" is no list of camera poses with start_timestamp, translation_x, y, z and rotation_x, y, z; '
            "download camera_pose.json again"
        ) from error
    return rows[:, 0], rows[:, 1:4], rows[:, 4:]
