"""A roof that is left out of views from above: where rays begin that start over it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError
from nerg_mi.maths.types import Bool, Float, Ray3f

_LEAST_FALL = 1e-9
"""Cosine to straight down below which a ray runs along the plane, and is traced as it is."""


class Ceiling:
    """The plane of the points x with x · up = height; ``up`` (3,) of any length but zero, ``height`` in scene units.

    Rays that start above it and come below it begin there. Both numbers are kept opaque: another height is no other
    kernel. Raises `NergError` for an ``up`` that is no direction.
    """

    def __init__(self, height: float, up: ArrayLike = (0.0, 0.0, 1.0)):
        import drjit as dr
        import mitsuba as mi

        direction = np.asarray(up, float)
        length = float(np.linalg.norm(direction))
        if not (length > 0 and np.isfinite(length)):
            raise NergError(f'"up" must be a direction, three numbers that are not all 0, got {direction.tolist()}')
        self.height, self.up = float(height), direction / length
        self._height, self._up = mi.Float(self.height), mi.Vector3f(*self.up.tolist())
        dr.make_opaque(self._height, self._up)

    def cut(self, ray: Ray3f) -> tuple[Any, Float]:
        """``ray`` (unit direction) from where it comes below the plane, and how far it went until then: 0 where it
        starts below, or never comes there. Differentiable in the ray."""
        import drjit as dr
        import mitsuba as mi

        over, fall = dr.dot(ray.o, self._up) - self._height, -dr.dot(ray.d, self._up)
        cuts: Bool = (over > 0) & (fall > _LEAST_FALL)
        ahead = dr.select(cuts, over / dr.select(cuts, fall, 1), 0)
        moved = type(ray)(ray)
        moved.o = dr.fma(ray.d, ahead, ray.o)
        moved.maxt = ray.maxt - ahead
        if isinstance(ray, mi.RayDifferential3f):
            moved.o_x, moved.o_y = dr.fma(ray.d_x, ahead, ray.o_x), dr.fma(ray.d_y, ahead, ray.o_y)
        return moved, ahead

    def __str__(self) -> str:
        x, y, z = self.up
        return f"{self.height:.6g} along ({x:.6g}, {y:.6g}, {z:.6g})"
