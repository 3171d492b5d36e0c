"""Rays as a medium sees them: handed over once, so that no sample has to be transformed."""

from __future__ import annotations

from dataclasses import dataclass

from nerg_mi.maths.types import Float, Point3f, Vector3f


@dataclass
class LocalRay:
    """A ray in a medium's coordinates: the point at scene distance ``t`` is ``o + t d``."""

    # Origin.
    o: Point3f
    # Displacement that one scene unit along the ray makes: of any length.
    d: Vector3f
    # Unit direction.
    w: Vector3f
    # Scene distances at which the ray enters and leaves the medium's box; it misses where `t_near >= t_far`. `t_near`
    # may be negative.
    t_near: Float
    t_far: Float
