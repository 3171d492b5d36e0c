"""Whether a surface lies before a distance: a question that a march can answer before its end.

An observer's ray towards a point has answered as soon as it has come to the point through almost nothing, or has met
as much as makes a surface well before it. What follows, the surface itself in most cases, cannot change the answer: it
is not evaluated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from nerg_mi.maths.types import Bool, Float

_HALF = math.log(2)


@dataclass(frozen=True)
class Occlusion:
    """Asked of a ray: does its surface lie before ``before``, or even before ``hides`` (distances in scene units)?

    For depths at which half of a ray's own opacity is reached, where a surface takes ``surface_opacity``. Both answers
    are exact: a ray that has absorbed less than half of that opacity has not reached half of what makes it a surface;
    where transmittance 1/2 is passed, half of all that may still be absorbed lies behind.
    """

    before: Float
    hides: Float
    surface_opacity: float

    def clear(self, t: Float, tau: Float) -> Bool:
        """Whether nothing before ``before`` can be the surface, with the optical depth ``tau`` up to ``t``."""
        return (t >= self.before) & (tau < _optical_depth(0.5 * self.surface_opacity))

    def hidden(self, t: Float, tau: Float) -> Bool:
        """Whether the surface lies before ``hides``, with the optical depth ``tau`` up to ``t``."""
        return (t < self.hides) & (tau > max(_HALF, _optical_depth(self.surface_opacity)))


def _optical_depth(opacity: float) -> float:
    return -math.log1p(-opacity) if opacity < 1 else math.inf
