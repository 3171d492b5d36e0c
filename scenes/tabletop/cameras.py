"""Where the photos are taken: three rings around the table, as somebody walks who holds a phone."""

from __future__ import annotations

import numpy as np
from nerg_mi.scenes.tabletop.layout import make_random_stream
from nerg_mi.scenes.tabletop.table import OBJECT_CENTER

from nerg_mi.photos.cameras import Intrinsics, PosedCamera

RINGS = ((1.08, 1.42, 0.14), (1.42, 1.62, 0.06), (1.68, 1.58, 0.16))
"""Of each ring: height of the camera, distance from the object's axis, and how far above the object's middle it aims;
metres."""
PORTRAIT_EVERY = 5
FIELD_OF_VIEW = 60.0
"""Degrees along a photo's longer side."""
_STEP, _AIM, _ROLL = 0.05, 0.05, 2.0


def make_cameras(seed: int = 0, count: int = 64, width: int = 320, height: int = 240) -> list[PosedCamera]:
    """``count`` cameras in the order in which the photos are taken, ring after ring.

    Every `PORTRAIT_EVERY`-th photo is ``height`` pixels wide and ``width`` high. Hands shake: positions and aims
    by 5 cm (standard deviation), the horizon by 2 degrees.
    """
    rng = make_random_stream(seed, "walk")
    focal = 0.5 * max(width, height) / np.tan(np.radians(FIELD_OF_VIEW / 2))
    out = []
    for k in range(count):
        ring, place = divmod(k * len(RINGS), count)
        tall, far, above = RINGS[ring]
        share = (place + 0.5) / count
        angle = 2 * np.pi * share + 0.9 * ring
        position = OBJECT_CENTER * (1, 1, 0) + (far * np.cos(angle), far * np.sin(angle), tall) + rng.normal(0, _STEP, 3)
        aim = OBJECT_CENTER + (0, 0, above) + rng.normal(0, _AIM, 3)
        w, h = (height, width) if k % PORTRAIT_EVERY == PORTRAIT_EVERY - 1 else (width, height)
        pose = look_at(position, aim, np.radians(rng.normal(0, _ROLL)))
        out.append(PosedCamera(Intrinsics(w, h, focal, focal, w / 2, h / 2), pose))
    return out


def look_at(position, target, roll: float = 0.0) -> np.ndarray:
    """OpenGL camera-to-world (4, 4) at a ``position`` that looks at a ``target``, turned by ``roll`` about its axis."""
    back = np.asarray(position, float) - target
    back /= np.linalg.norm(back)
    right = np.cross((0, 0, 1.0), back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    pose = np.eye(4)
    c, s = np.cos(roll), np.sin(roll)
    pose[:3] = np.stack([c * right + s * up, c * up - s * right, back, position], axis=1)
    return pose
