"""The axis-aligned box in which a field lives, and its map to the unit cube."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import numpy as np

from nerg_mi.ranges import FARTHEST


@dataclass(frozen=True)
class Box:
    """``lower`` and ``upper`` corners, in the field's own units.

    Points map to the unit cube by one uniform scale about the centre (grid cells
    stay cubes), so the longest edge spans [0, 1] and the others a part of it.
    ``bound``: the unit cube is [-bound, bound]³ instead, of which the box is a part, and the map is torch-ngp's
    (p + bound) / (2 bound), rounded as there: in a fine hash grid the last bit of a coordinate can be seen.
    """

    # The three coordinates of either corner; any sequences of numbers become tuples.
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    # Half the edge of the unit cube, where that is not the box's longest.
    bound: float | None = None

    # Whether positions are contracted before they are encoded, and how far then (`contraction.ContractedBox`).
    contracted: ClassVar[bool] = False
    reach: ClassVar[float | None] = None

    def __post_init__(self):
        lower, upper = np.asarray(self.lower, float), np.asarray(self.upper, float)
        if lower.shape != (3,) or upper.shape != (3,) or not (np.abs([lower, upper]) <= FARTHEST).all():
            raise ValueError(
                f"a box needs two finite corners of 3 numbers within {FARTHEST:g}, got {self.lower} and {self.upper}"
            )
        if not np.all(upper > lower):
            raise ValueError(f"the upper corner {self.upper} of a box must exceed its lower corner {self.lower}")
        farthest = max(np.abs(lower).max(), np.abs(upper).max())
        if self.bound is not None and not (np.isfinite(self.bound) and farthest <= self.bound):
            raise ValueError(f"a box of {self.lower} to {self.upper} does not lie within a bound of {self.bound}")
        object.__setattr__(self, "lower", tuple(lower.tolist()))
        object.__setattr__(self, "upper", tuple(upper.tolist()))

    @property
    def side(self) -> float:
        """Length of the unit cube in the field's units: the longest edge, where no ``bound`` is given."""
        return 2 * self.bound if self.bound is not None else max(u - l for l, u in zip(self.lower, self.upper))

    @property
    def cube_side(self) -> float:
        """Length, in the field's units, of the cube that `to_cube` makes the unit cube."""
        return self.side

    @property
    def core(self) -> Box:
        """The part that is resolved best: all of it."""
        return self

    @property
    def center(self) -> tuple[float, ...]:
        """Centre of the unit cube."""
        return (0.0, 0.0, 0.0) if self.bound is not None else tuple((l + u) / 2 for l, u in zip(self.lower, self.upper))

    @property
    def diagonal(self) -> float:
        return float(np.linalg.norm(np.subtract(self.upper, self.lower)))

    def to_unit(self, p):
        """Unit-cube coordinates of ``p`` (Array3f or (N, 3) array)."""
        if self.bound is not None:
            return self._divided(p + self.bound, 2 * self.bound)
        if dr.is_array_v(p):
            return (p - type(p)(*self.center)) / self.side + 0.5
        return (np.asarray(p) - np.asarray(self.center)) / self.side + 0.5

    def from_unit(self, u):
        """The points (Array3f) at ``u`` of the unit cube."""
        return (u - 0.5) * self.side + type(u)(*self.center)

    def to_cube(self, p):
        """``p`` (Array3f) in a unit cube in which straight lines stay straight: as `to_unit` has it."""
        return self.to_unit(p)

    def distance_scale(self, p):
        """How much larger cells of the unit cube are at ``p`` than in the core: they are all alike."""
        return 1.0

    def density_along(self, sigma, p):
        """Density per unit of the field at ``p`` where it is ``sigma`` per unit as positions are encoded: the same."""
        return sigma

    @staticmethod
    def _divided(x, divisor: float):
        """``x / divisor``, correctly rounded: for Dr.Jit a division by a constant is a product with its reciprocal."""
        if not dr.is_array_v(x):
            return np.asarray(x) / np.asarray(x).dtype.type(divisor)
        inverse = float(np.float32(1 / divisor))
        quotient = x * inverse
        if np.frexp(divisor)[0] == 0.5:
            return quotient
        return dr.fma(dr.fma(-quotient, divisor, x), inverse, quotient)

    def contains(self, p):
        """Mask of the points ``p`` (Array3f) inside the box."""
        return dr.all((p >= type(p)(*self.lower)) & (p <= type(p)(*self.upper)))

    def to_dict(self) -> dict:
        corners = {"lower": list(self.lower), "upper": list(self.upper)}
        return corners if self.bound is None else {**corners, "bound": self.bound}
