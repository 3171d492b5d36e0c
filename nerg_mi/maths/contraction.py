"""A place without an end: a cube at full resolution, and all around it, contracted, out to a far bound.

The map is that of mip-NeRF 360 (Barron et al. 2022, equation 10) with the largest coordinate in the place of the
length: with x the position in half edges of the inner cube and m = max |x_k|,

    contract(x) = x where m <= 1,   (2 - 1 / m) x / m elsewhere,

which fills the cube [-2, 2]^3 as m grows without bound. Only where a field is *encoded* is anything contracted:
positions, distances and densities are those of the scene everywhere, and rays are straight.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import numpy as np

from .box import Box

REACH = 64.0
"""Half edges of the inner cube at which a place ends that knows no end: what lies farther away moves by less than a
pixel as cameras within the cube walk about, and may as well stand there."""


@dataclass(frozen=True)
class ContractedBox:
    """A cube around ``core``, whose edge is ``core``'s longest, and the ``reach`` times larger cube around that.

    It answers what a `Box` answers. ``lower`` and ``upper`` bound everything that may be marched; ``side`` is the
    length by which a scene is measured, the inner cube's edge. ``reach``: a power of two, at least 2. Raises
    ``ValueError`` for another.
    """

    core: Box
    reach: float = REACH

    contracted: ClassVar[bool] = True
    # The unit cube is not the box's own (`Box.bound`).
    bound: ClassVar[float | None] = None

    def __post_init__(self):
        if not (2 <= self.reach <= 2**12 and np.frexp(self.reach)[0] == 0.5):
            raise ValueError(f"the reach of a contracted box must be a power of two from 2 to 4096, got {self.reach}")
        if self.core.bound is not None:
            raise ValueError("a contracted box has a core that is bounded by its own corners")

    @property
    def side(self) -> float:
        """Edge of the inner cube, in the field's units."""
        return self.core.side

    @property
    def cube_side(self) -> float:
        """Edge of the outer cube, in the field's units."""
        return self.core.side * self.reach

    @property
    def center(self) -> tuple[float, ...]:
        return self.core.center

    @property
    def lower(self) -> tuple[float, ...]:
        return tuple(c - self.cube_side / 2 for c in self.center)

    @property
    def upper(self) -> tuple[float, ...]:
        return tuple(c + self.cube_side / 2 for c in self.center)

    @property
    def diagonal(self) -> float:
        """Of the outer cube."""
        return 3**0.5 * self.cube_side

    def _halves(self, p):
        """``p`` (Array3f) in half edges of the inner cube from its centre, and the largest coordinate, at least 1."""
        x = (p - type(p)(*self.center)) * (2 / self.side)
        return x, dr.maximum(dr.maximum(dr.maximum(dr.abs(x.x), dr.abs(x.y)), dr.abs(x.z)), 1)

    def to_unit(self, p):
        """Where ``p`` (Array3f) is encoded, in the unit cube: the inner cube is its middle, half as wide."""
        x, m = self._halves(p)
        inverse = dr.rcp(m)
        return x * ((2 - inverse) * inverse * 0.25) + 0.5

    def from_unit(self, u):
        """The points (Array3f) that are encoded at ``u``; those beyond the outer cube come to lie on its face."""
        y = (u - 0.5) * 4
        n = dr.maximum(dr.maximum(dr.maximum(dr.abs(y.x), dr.abs(y.y)), dr.abs(y.z)), 1)
        scale = dr.rcp(n * dr.maximum(2 - n, 1 / self.reach))
        return y * (scale * (0.5 * self.side)) + type(y)(*self.center)

    def distance_scale(self, p):
        """How many times farther than the inner cube's face ``p`` (Array3f) is from the centre; 1 within the cube."""
        return self._halves(p)[1]

    def density_along(self, sigma, p):
        """Density per unit of the field at ``p`` (Array3f) where it is ``sigma`` per unit as positions are encoded, out
        along the line from the centre: σ / m². A field without structure then absorbs no more outside than within."""
        return sigma * dr.rcp(dr.square(self._halves(p)[1]))

    def to_cube(self, p):
        """``p`` (Array3f) in coordinates in which the outer cube is the unit cube: straight lines stay straight."""
        return (p - type(p)(*self.center)) / self.cube_side + 0.5

    def contains(self, p):
        """Mask of the points ``p`` (Array3f) inside the outer cube."""
        return dr.all((p >= type(p)(*self.lower)) & (p <= type(p)(*self.upper)))

    def to_dict(self) -> dict:
        return {**self.core.to_dict(), "reach": self.reach}


AnyBox = Box | ContractedBox
"""Where a field lives: both kinds answer the same."""


def box_of(about: dict) -> AnyBox:
    """The box whose ``to_dict`` made ``about``. Raises ``ValueError`` or ``TypeError`` for what is none."""
    known = dict(about)
    reach = known.pop("reach", None)
    return Box(**known) if reach is None else ContractedBox(Box(**known), float(reach))
