"""Skeletons by the names of their keypoints, the head poses that they give, and bodies for given head poses.

The paper's proxy for gaze (Section 5.1): a ray from the midpoint of the ears
through the nose.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError

from .skeleton_file import KEYPOINTS

# Of the paper's skeleton these are documented: columns 6:9, 39:42 and 33:36 of the file.
LEFT_EAR, RIGHT_EAR, NOSE = 2, 13, 11


@dataclass(frozen=True)
class Skeleton:
    """A convention of keypoints: how many there are, and the numbers, from 0, of those by which a body is oriented.

    Left and right are the person's. ``sure``: the confidence from which a keypoint was seen for certain.
    """

    title: str
    keypoints: int
    joints: Mapping[str, int]
    sure: float = 1.0

    def numbers(self, place: int | str) -> list[int]:
        """The keypoints of which ``place`` is the mean: a number, a name, or several of either, joined by "+".

        Raises `NergError` naming those there are.
        """
        words = [self.joints.get(word.strip(), word.strip()) for word in str(place).split("+")]
        numbers = [int(k) if str(k).isdecimal() and len(str(k)) < 9 else self.keypoints for k in words]
        if max(numbers) >= self.keypoints:
            raise NergError(
                f'there is no keypoint "{place}" in {self.title}; name them by their numbers, 0 to '
                f"{self.keypoints - 1}, or as {', '.join(self.joints)} (--keypoints)"
            )
        return numbers


PAPER = "nerg22"
SKELETONS = {
    PAPER: Skeleton(
        "the NeRG paper's skeleton", KEYPOINTS, {"left_ear": LEFT_EAR, "right_ear": RIGHT_EAR, "nose": NOSE}
    ),
    "coco17": Skeleton(
        "COCO-17",
        17,
        {"nose": 0, "left_eye": 1, "right_eye": 2, "left_ear": 3, "right_ear": 4}
        | {"left_shoulder": 5, "right_shoulder": 6, "left_hip": 11, "right_hip": 12},
    ),
    "body25": Skeleton(
        "BODY_25 of OpenPose",
        25,
        {"nose": 0, "right_eye": 15, "left_eye": 16, "right_ear": 17, "left_ear": 18}
        | {"right_shoulder": 2, "left_shoulder": 5, "right_hip": 9, "left_hip": 12},
    ),
    "mediapipe33": Skeleton(
        "the pose of MediaPipe",
        33,
        {"nose": 0, "left_eye": 2, "right_eye": 5, "left_ear": 7, "right_ear": 8}
        | {"left_shoulder": 11, "right_shoulder": 12, "left_hip": 23, "right_hip": 24},
    ),
    "kinect32": Skeleton(
        "Azure Kinect",
        32,
        {"nose": 27, "left_eye": 28, "left_ear": 29, "right_eye": 30, "right_ear": 31, "head": 26, "pelvis": 0}
        | {"left_shoulder": 5, "right_shoulder": 12, "left_hip": 18, "right_hip": 22},
        sure=2.0,
    ),
    "kinect25": Skeleton(
        "Kinect v2",
        25,
        {"head": 3, "pelvis": 0, "left_shoulder": 4, "right_shoulder": 8, "left_hip": 12, "right_hip": 16},
        sure=2.0,
    ),
}
"""By name. Of several with as many keypoints, the first is the one that is meant without a name."""

EAR_DISTANCE = 0.15  # metres between the ears of an adult
NOSE_DISTANCE = 0.12  # metres from the midpoint of the ears to the tip of the nose
EAR_HEIGHT = 1.58  # metres: the height for which _BODY is written

# The other nineteen keypoints are unnamed in the published code. Bodies made
# here fill them as a standing adult: (to the left, forward, height) in metres.
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


def head_poses(
    left: np.ndarray, right: np.ndarray, front: np.ndarray, *, pitch: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Rays of the heads: from midway between their sides, which are the ears, through their front, the nose.

    ``left``, ``right``, ``front``: (N, 3). ``pitch``: degrees by which a ray is turned up about the line through the
    sides, since a nose lies below the ears and a level head then seems to look down. Returns ``origin`` (N, 3) in the
    unit given and ``direction`` (N, 3), unit; where a side or the front is NaN or the front lies midway between the
    sides, the direction is NaN. NeRG, Section 5.1.
    """
    left, right, front = (np.asarray(v, dtype=np.float64) for v in (left, right, front))
    origin = 0.5 * (left + right)
    direction = _unit(front - origin)
    if pitch:
        # Only the part across the sides turns; their line need not be square to the front.
        side = _unit(left - right)
        along = np.sum(direction * side, axis=1, keepdims=True) * side
        angle = np.radians(pitch)
        direction = along + np.cos(angle) * (direction - along) + np.sin(angle) * np.cross(direction, side)
    return origin, direction


def trunk_directions(left: np.ndarray, right: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Where trunks face, (N, 3) unit: square to the line of the shoulders ``left``, ``right`` (N, 3) and to ``up``
    (N, 3), along the spine; NaN where that is nowhere."""
    return _unit(np.cross(left - right, up))


def _unit(v: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(v, axis=1, keepdims=True)
    return np.divide(v, length, out=np.full_like(v, np.nan), where=length > 0)


def keypoints_from_head(
    origin: np.ndarray,
    direction: np.ndarray,
    *,
    floor: float = 0.0,
    ear_distance: float = EAR_DISTANCE,
    nose_distance: float = NOSE_DISTANCE,
) -> np.ndarray:
    """Standing bodies whose ears and nose give exactly these head poses.

    ``origin``: (N, 3) metres, z up, the midpoint of the ears. ``direction``:
    (N, 3), need not be unit. ``floor``: height of the floor in metres. Returns
    keypoints (N, 22, 3) with :func:`head_poses` of them equal to the input to
    rounding. The head is not tilted sideways; the body faces where the head
    faces and is scaled to its height. Raises ``ValueError`` for a zero or
    non-finite direction.
    """
    origin = np.atleast_2d(np.asarray(origin, dtype=np.float64))
    direction = np.atleast_2d(np.asarray(direction, dtype=np.float64))
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    bad = np.flatnonzero(~(np.isfinite(length[:, 0]) & (length[:, 0] > 0) & np.isfinite(origin).all(axis=1)))
    if bad.size:
        raise ValueError(f"head pose {bad[0]} has a zero or non-finite direction or origin; drop it first")
    forward = direction / length

    # Left is horizontal; a head that looks straight up or down has no heading of
    # its own, and faces +x.
    flat = forward * (1.0, 1.0, 0.0)
    flat_length = np.linalg.norm(flat, axis=1, keepdims=True)
    heading = np.where(flat_length > 1e-9, flat / np.maximum(flat_length, 1e-9), (1.0, 0.0, 0.0))
    left = np.stack([-heading[:, 1], heading[:, 0], np.zeros(len(heading))], axis=1)
    crown = np.cross(forward, left)

    out = np.empty((len(origin), KEYPOINTS, 3))
    out[:, LEFT_EAR] = origin + 0.5 * ear_distance * left
    out[:, RIGHT_EAR] = origin - 0.5 * ear_distance * left
    out[:, NOSE] = origin + nose_distance * forward
    eyes = origin + 0.75 * nose_distance * forward + 0.25 * nose_distance * crown
    out[:, _LEFT_EYE] = eyes + 0.2 * ear_distance * left
    out[:, _RIGHT_EYE] = eyes - 0.2 * ear_distance * left

    scale = (origin[:, 2:] - floor) / EAR_HEIGHT
    foot = np.concatenate([origin[:, :2], np.full((len(origin), 1), float(floor))], axis=1)
    for k, (aside, ahead, height) in _BODY.items():
        out[:, k] = foot + scale * (aside * left + ahead * heading) + scale * height * np.array([0.0, 0.0, 1.0])
    return out
