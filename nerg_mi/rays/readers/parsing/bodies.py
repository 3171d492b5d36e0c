"""Head poses of 22-keypoint skeletons, and bodies for given head poses.

The paper's proxy for gaze (Section 5.1): a ray from the midpoint of the ears
through the nose. Frame of the tracking data: metres, z up, right-handed.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.errors import NergError

from .skeleton_file import KEYPOINTS

# The keypoints whose meaning is known: columns 6:9, 39:42 and 33:36 of the file.
LEFT_EAR, RIGHT_EAR, NOSE = 2, 13, 11

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
    keypoints: np.ndarray, *, ears: tuple[int, int] = (LEFT_EAR, RIGHT_EAR), nose: int = NOSE, pitch: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Rays of the heads: from the midpoint of the ears through the nose.

    ``keypoints``: (N, 22, 3). ``ears``, ``nose``: which of them. ``pitch``: degrees by which a ray is turned up about
    the line through the ears, since a nose lies below the ears and a level head then seems to look down. Returns
    ``origin`` (N, 3) in the unit given and ``direction`` (N, 3), unit; where an ear or the nose is NaN or the nose lies
    on the midpoint, the direction is NaN. NeRG, Section 5.1.
    """
    keypoints = np.asarray(keypoints, dtype=np.float64)
    if keypoints.ndim != 3 or keypoints.shape[1:] != (KEYPOINTS, 3):
        raise ValueError(f"keypoints have shape {keypoints.shape}, expected (N, {KEYPOINTS}, 3)")
    if len({*ears, nose}) != 3 or not all(0 <= k < KEYPOINTS for k in (*ears, nose)):
        raise NergError(f"ears {ears} and nose {nose} must be three different keypoints of 0 to {KEYPOINTS - 1}")
    left, right = (keypoints[:, k] for k in ears)
    origin = 0.5 * (left + right)
    offset = keypoints[:, nose] - origin
    direction = _unit(offset)
    if pitch:
        # Only the part across the ears turns; the ears' line need not be square to the nose.
        side = _unit(left - right)
        along = np.sum(direction * side, axis=1, keepdims=True) * side
        angle = np.radians(pitch)
        direction = along + np.cos(angle) * (direction - along) + np.sin(angle) * np.cross(direction, side)
    return origin, direction


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
