"""Declared frames of tracking data, and the way from them to ours.

Ours is right-handed with z up, in metres.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.errors import NergError

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
UPS = ("y", "z", "x", "-y", "-z", "-x")


def to_rays_frame(*, up: str = "z", handedness: str = "right", units: str = "m") -> np.ndarray:
    """4x4 matrix from a declared frame to ours (right-handed, z up, metres).

    ``up``: the axis that points up, x, y or z or one of them negated. x is kept (where x is up, y becomes x). z up,
    right: nothing. y up, right: (x, -z, y), a rotation. y up, left (Unity): (x, z, y), the mirror that makes Unity's
    forward our y. z up, left (Unreal): (x, -y, z). -y up, right (a camera of OpenCV): (x, z, -y). Raises `NergError`
    for another word.
    """
    if up not in UPS or handedness not in ("left", "right"):
        raise NergError(
            f'frame "{up} up, {handedness}-handed" is not known; up is one of {", ".join(UPS)}, handedness is left or right'
        )
    if units not in UNITS:
        raise NergError(f'units "{units}" are not known; use one of {", ".join(UNITS)}')
    z = np.eye(3)["xyz".index(up[-1])] * (-1.0 if up[0] == "-" else 1.0)
    x = np.eye(3)[1 if up[-1] == "x" else 0]
    y = np.cross(z, x) * (1.0 if handedness == "right" else -1.0)
    matrix = np.eye(4)
    matrix[:3, :3] = UNITS[units] * np.stack([x, y, z])
    return matrix + 0.0  # no negative zeros
