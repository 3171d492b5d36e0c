"""Declared frames of tracking data, and the way from them to the frame of rays: the only place where it is converted.

The frame of rays is right-handed with z up, in metres.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from nerg_mi.errors import NergError

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Units of length by name, in metres."""

UPS = ("y", "z", "x", "-y", "-z", "-x")
HANDS = ("right", "left")


@dataclass(frozen=True)
class Frame:
    """The frame of tracking data. Raises `NergError` for a word that is not known."""

    up: str = "z"  # the axis that points up: x, y, z, -x, -y or -z
    handedness: str = "right"  # right or left
    units: str = "m"  # of length: m, cm or mm

    def __post_init__(self) -> None:
        if self.up not in UPS or self.handedness not in HANDS:
            raise NergError(
                f'frame "{self.up} up, {self.handedness}-handed" is not known; '
                f"up is one of {', '.join(UPS)}, handedness is left or right"
            )
        if self.units not in UNITS:
            raise NergError(f'units "{self.units}" are not known; use one of {", ".join(UNITS)}')

    def __str__(self) -> str:
        return f"{self.up} up, {self.handedness}-handed, {self.units}"

    def to_dict(self) -> dict[str, str]:
        """As it stands in the metadata of rays: ``up``, ``handedness`` and ``units``."""
        return asdict(self)

    def to_rays(self) -> np.ndarray:
        """4x4 matrix from this frame to that of rays (right-handed, z up, metres).

        x is kept (where x is up, y becomes x). z up, right: nothing. y up, right: (x, -z, y), a rotation. y up, left
        (Unity): (x, z, y), the mirror that makes Unity's forward our y. z up, left (Unreal): (x, -y, z). -y up, right
        (a camera of OpenCV): (x, z, -y).
        """
        z = np.eye(3)["xyz".index(self.up[-1])] * (-1.0 if self.up[0] == "-" else 1.0)
        x = np.eye(3)[1 if self.up[-1] == "x" else 0]
        y = np.cross(z, x) * (1.0 if self.handedness == "right" else -1.0)
        matrix = np.eye(4)
        matrix[:3, :3] = UNITS[self.units] * np.stack([x, y, z])
        return matrix + 0.0  # no negative zeros


RAYS = Frame()
"""The frame of rays."""

UNITY = Frame(up="y", handedness="left")
"""Unity's world."""

OPENGL = Frame(up="y")
"""A world with y up as OpenGL, OpenXR and HoloLens have it."""
