"""Which distance along a ray is "the surface": expected or median depth."""
from __future__ import annotations

import drjit as dr

from .elementary import log1p
from .march import MarchResult, MarchSettings, march

KINDS = ("expected", "median")


def surface_depth(kind: str, result: MarchResult, medium, ray, t0, t1, active, settings: MarchSettings):
    """Depth of ``kind`` from a march's result, 0 where nothing absorbs.

    The median is where half of this ray's own accumulated opacity is reached, which is the crossing
    of transmittance 1/2 for rays that became opaque. The others (few) are marched again for theirs.
    """
    if kind == "expected":
        return result.expected_depth
    opaque = result.tau >= settings.opaque
    alpha = result.opacity
    rest = active & ~opaque & (alpha > 0)
    goal = -log1p(-0.5 * alpha)
    again = march(medium, ray, t0, t1, rest, settings, until=dr.select(rest, goal, 1))
    # Rounding can leave the second march a hair short of its goal: the crossing is then the far end.
    crossing = dr.minimum(again.half, t1)
    return dr.select(rest, crossing, dr.select(opaque & active, result.half, 0))
