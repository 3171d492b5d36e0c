"""The axis-aligned box in which a field lives, and its map to the unit cube."""
from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np


@dataclass(frozen=True)
class Box:
    """``lower`` and ``upper`` corners, in the field's own units.

    Points map to the unit cube by one uniform scale about the centre (grid cells
    stay cubes), so the longest edge spans [0, 1] and the others a part of it.
    """

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]

    def __post_init__(self):
        lower, upper = np.asarray(self.lower, float), np.asarray(self.upper, float)
        if lower.shape != (3,) or upper.shape != (3,) or not np.all(np.isfinite(lower) & np.isfinite(upper)):
            raise ValueError(f"a box needs two finite corners of 3 numbers, got {self.lower} and {self.upper}")
        if not np.all(upper > lower):
            raise ValueError(f"the upper corner {self.upper} of a box must exceed its lower corner {self.lower}")
        object.__setattr__(self, "lower", tuple(lower.tolist()))
        object.__setattr__(self, "upper", tuple(upper.tolist()))

    @property
    def side(self) -> float:
        """Longest edge: the length of the unit cube in the field's units."""
        return max(u - l for l, u in zip(self.lower, self.upper))

    @property
    def center(self) -> tuple[float, float, float]:
        return tuple((l + u) / 2 for l, u in zip(self.lower, self.upper))

    @property
    def diagonal(self) -> float:
        return float(np.linalg.norm(np.subtract(self.upper, self.lower)))

    def to_unit(self, p):
        """Unit-cube coordinates of ``p`` (Array3f or (N, 3) array)."""
        if dr.is_array_v(p):
            return (p - type(p)(*self.center)) / self.side + 0.5
        return (np.asarray(p) - np.asarray(self.center)) / self.side + 0.5

    def contains(self, p):
        """Mask of the points ``p`` (Array3f) inside the box."""
        return dr.all((p >= type(p)(*self.lower)) & (p <= type(p)(*self.upper)))

    def to_dict(self) -> dict:
        return {"lower": list(self.lower), "upper": list(self.upper)}
