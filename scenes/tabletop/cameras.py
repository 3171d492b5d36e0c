"""Camera positions: three rings around the table, as if taken with a phone."""

from __future__ import annotations

import numpy as np
from nerg_mi.scenes.tabletop.layout import make_random_stream
from nerg_mi.scenes.tabletop.table import OBJECT_CENTER

from nerg_mi.photos.cameras import Intrinsics, PosedCamera

RINGS = ((1.08, 1.42, 0.14), (1.42, 1.62, 0.06), (1.68, 1.58, 0.16))
"""Height of the camera, distance from the axis of the object, and aim above the middle of the object, for each ring;
metres.
"""
PORTRAIT_EVERY = 5
FIELD_OF_VIEW = 60.0
"""Degrees along the longer side of a photo."""
_POSITION_NOISE, _AIM_NOISE, _ROLL_NOISE = 0.05, 0.05, 2.0


def make_cameras(seed: int = 0, count: int = 64, width: int = 320, height: int = 240) -> list[PosedCamera]:
    """Make ``count`` cameras in the order of the photos, ring after ring.

    Every `PORTRAIT_EVERY`-th photo is in portrait format, ``height`` pixels wide and ``width`` high. Positions and aims
    have noise of 5 cm (standard deviation), the horizon of 2 degrees.
    """
    rng = make_random_stream(seed, "walk")
    focal = 0.5 * max(width, height) / np.tan(np.radians(FIELD_OF_VIEW / 2))
    out = []
    for k in range(count):
        ring, index = divmod(k * len(RINGS), count)
        height_above_floor, distance, above = RINGS[ring]
        fraction = (index + 0.5) / count
        angle = 2 * np.pi * fraction + 0.9 * ring
        position = (
            OBJECT_CENTER * (1, 1, 0)
            + (distance * np.cos(angle), distance * np.sin(angle), height_above_floor)
            + rng.normal(0, _POSITION_NOISE, 3)
        )
        aim = OBJECT_CENTER + (0, 0, above) + rng.normal(0, _AIM_NOISE, 3)
        w, h = (height, width) if k % PORTRAIT_EVERY == PORTRAIT_EVERY - 1 else (width, height)
        pose = look_at(position, aim, np.radians(rng.normal(0, _ROLL_NOISE)))
        out.append(PosedCamera(Intrinsics(w, h, focal, focal, w / 2, h / 2), pose))
    return out


def look_at(position, target, roll: float = 0.0) -> np.ndarray:
    """Return the OpenGL camera-to-world (4, 4) at ``position`` that looks at ``target``, rotated by ``roll`` about its
    axis.
    """
    back = np.asarray(position, float) - target
    back /= np.linalg.norm(back)
    right = np.cross((0, 0, 1.0), back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    pose = np.eye(4)
    c, s = np.cos(roll), np.sin(roll)
    pose[:3] = np.stack([c * right + s * up, c * up - s * right, back, position], axis=1)
    return pose
