"""Declared frames of tracking data, and the way from them to ours.

Ours is right-handed with z up, in metres.
"""
from __future__ import annotations

import numpy as np

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}


def to_rays_frame(*, up: str = "z", handedness: str = "right", units: str = "m") -> np.ndarray:
    """4x4 matrix from a declared frame to ours (right-handed, z up, metres).

    x is kept. z up, right: nothing. y up, right: (x, -z, y), a rotation.
    y up, left (Unity): (x, z, y), the mirror that makes Unity's forward our y.
    z up, left (Unreal): (x, -y, z). Raises ``ValueError`` for another word.
    """
    axes = {
        ("z", "right"): [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        ("y", "right"): [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        ("y", "left"): [[1, 0, 0], [0, 0, 1], [0, 1, 0]],
        ("z", "left"): [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
    }
    if (up, handedness) not in axes:
        raise ValueError(f'frame "{up} up, {handedness}-handed" is not known; up is y or z, handedness is left or right')
    if units not in UNITS:
        raise ValueError(f'units "{units}" are not known; use one of {", ".join(UNITS)}')
    matrix = np.eye(4)
    matrix[:3, :3] = UNITS[units] * np.array(axes[up, handedness], dtype=np.float64)
    return matrix
