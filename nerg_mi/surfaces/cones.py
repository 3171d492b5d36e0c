r"""Gaze as a cone in place of a line: trackers err by about a degree, and the fovea sees two.

A cone is a Gaussian of the angles to both sides of the line of sight, of standard deviation σ each. Of a density over
directions it is the convolution by a rule of seven directions that is exact to the fifth degree in the tangent plane
(A. H. Stroud, D. Secrest, "Approximate integration formulas for certain spherically symmetric regions", 1963, for the
weight exp(-r²)): half in the middle, a twelfth in each of six at 2σ around it. It turns a spherical harmonic of degree
l into itself times (1 + P_l(cos 2σ)) / 2, and so keeps the integral over the sphere. Of a ray, which is a point among
directions, it is a bundle of rays, each of which ends at what it meets itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from nerg_mi.maths.types import Vector3f

RING = 6
"""Directions around the middle one."""

WIDEST = 30.0
"""Degrees that a cone may measure: the tangent plane is no picture of the sphere beyond."""

_GOLDEN = np.pi * (3 - np.sqrt(5))


def blurred(density: Callable[[Vector3f], Any], directions: Vector3f, sigma: float) -> Any:
    """``density`` along ``directions`` (unit, a lane each), seen through a cone of ``sigma`` radian."""
    import drjit as dr
    import mitsuba as mi

    side, up = mi.coordinate_system(directions)
    found = 0.5 * density(directions)
    sin, cos = dr.sincos(mi.Float(2 * sigma))
    for k in range(RING):
        turn = 2 * math.pi * k / RING
        found += density(cos * directions + sin * (math.cos(turn) * side + math.sin(turn) * up)) / (2 * RING)
    return found


def bundle(directions: np.ndarray, sigma: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """``count`` unit directions (N, count, 3) of equal weight in a cone of ``sigma`` radian around each of
    ``directions`` (N, 3).

    Their angles from the middle are one in each of as many shells of equal weight, their turns steps of the golden
    angle from one that is drawn: bundles are spread evenly, and all of them together without any pattern.
    """
    n = len(directions)
    if sigma == 0:
        return np.repeat(directions[:, None], count, axis=1)
    shell = (np.arange(count) + rng.random((n, 1))) / count
    # The angle of a Gaussian of two dimensions is Rayleigh's.
    angle = np.minimum(sigma * np.sqrt(-2 * np.log1p(-shell)), np.pi)
    turn = 2 * np.pi * rng.random((n, 1)) + _GOLDEN * np.arange(count)
    side, up = _beside(directions)
    around = np.cos(turn)[..., None] * side[:, None] + np.sin(turn)[..., None] * up[:, None]
    out = np.cos(angle)[..., None] * directions[:, None] + np.sin(angle)[..., None] * around
    return out / np.linalg.norm(out, axis=-1, keepdims=True)


def _beside(d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors at right angles to each of ``d`` (N, 3) and to each other (Duff et al. 2017)."""
    sign = np.where(d[:, 2] >= 0, 1.0, -1.0)
    a = -1.0 / (sign + d[:, 2])
    b = d[:, 0] * d[:, 1] * a
    first = np.stack([1 + sign * d[:, 0] ** 2 * a, sign * b, -sign * d[:, 0]], axis=1)
    return first, np.stack([b, sign + d[:, 1] ** 2 * a, -d[:, 1]], axis=1)
