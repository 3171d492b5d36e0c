"""Skeleton files of synthetic bodies."""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerg_mi.tracking.readers import skeleton

EAR_DISTANCE = 0.15  # metres between the ears of an adult
NOSE_DISTANCE = 0.12  # metres from the midpoint of the ears to the tip of the nose
EAR_HEIGHT = 1.58  # metres; height of the ears in _BODY

# The other nineteen keypoints of a standing adult: (to the left, forward, height) in metres.
_BODY = {
    0: (0.10, 0.00, 0.08),
    1: (0.12, 0.17, 0.02),
    3: (0.25, 0.02, 1.05),  # left ankle, toe, elbow
    5: (0.10, -0.06, 0.03),
    6: (0.10, 0.00, 0.90),
    7: (0.10, 0.03, 0.48),  # left heel, hip, knee
    8: (0.19, 0.00, 1.36),
    9: (0.26, 0.15, 0.88),
    10: (0.00, 0.00, 1.40),  # left shoulder, wrist; neck
    12: (-0.10, 0.00, 0.08),
    14: (-0.25, 0.02, 1.05),
    16: (-0.10, -0.06, 0.03),  # right ankle, elbow, heel
    17: (-0.10, 0.00, 0.90),
    18: (-0.10, 0.03, 0.48),
    19: (-0.19, 0.00, 1.36),  # right hip, knee, shoulder
    20: (-0.26, 0.15, 0.88),
    21: (0.00, 0.00, 1.15),  # right wrist; chest
}
_LEFT_EYE, _RIGHT_EYE = 4, 15


def write_skeleton(path: Path, ids: Sequence[str], times: np.ndarray, keypoints: np.ndarray, decimals: int = 6) -> None:
    """Write poses (N, K, 3), or (N, K, 4) with confidences; files with a name ending in ``.gz`` are compressed."""
    with gzip.open(path, "wt") if path.name.endswith(".gz") else path.open("w") as out:
        for name, time, values in zip(ids, times, np.reshape(keypoints, (len(ids), -1))):
            out.write(f"{name}|{int(time)}|[{', '.join(f'{v:.{decimals}f}' for v in values)}]\n")


def keypoints_from_head(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Make standing bodies (N, 22, 3) whose ears and nose have exactly the given head poses (N, 3), in metres, z up.

    The head has no roll; the body faces in the direction of the head, and is scaled to its height.
    """
    origin, direction = np.asarray(origin, float), np.asarray(direction, float)
    forward = direction / np.linalg.norm(direction, axis=1, keepdims=True)

    # The left direction is horizontal; a head that looks straight up or down is assumed to face +x.
    flat = forward * (1.0, 1.0, 0.0)
    flat_length = np.linalg.norm(flat, axis=1, keepdims=True)
    heading = np.where(flat_length > 1e-9, flat / np.maximum(flat_length, 1e-9), (1.0, 0.0, 0.0))
    left = np.stack([-heading[:, 1], heading[:, 0], np.zeros(len(heading))], axis=1)
    crown = np.cross(forward, left)

    out = np.empty((len(origin), skeleton.NUM_KEYPOINTS, 3))
    out[:, skeleton.LEFT_EAR] = origin + 0.5 * EAR_DISTANCE * left
    out[:, skeleton.RIGHT_EAR] = origin - 0.5 * EAR_DISTANCE * left
    out[:, skeleton.NOSE] = origin + NOSE_DISTANCE * forward
    eye_centre = origin + 0.75 * NOSE_DISTANCE * forward + 0.25 * NOSE_DISTANCE * crown
    out[:, _LEFT_EYE] = eye_centre + 0.2 * EAR_DISTANCE * left
    out[:, _RIGHT_EYE] = eye_centre - 0.2 * EAR_DISTANCE * left

    scale = origin[:, 2:] / EAR_HEIGHT
    foot = np.concatenate([origin[:, :2], np.zeros((len(origin), 1))], axis=1)
    for k, (aside, ahead, height) in _BODY.items():
        out[:, k] = foot + scale * (aside * left + ahead * heading) + scale * height * np.array([0.0, 0.0, 1.0])
    return out
