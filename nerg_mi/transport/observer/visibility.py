"""Whether an observer sees a point: the shadow factor of the paper, with its sign corrected.

The paper's section "Surface Visibility and Gaze Occlusion" compares the depth d_o that the
observer's ray meets with the distance d_o* to the point. s = clip((d_o* - d_o - tol) / d_f, 0, 1)
is 1 where something stands in between; gaze is multiplied by the visibility 1 - s. (The text
multiplies by s, which would show gaze only where it is hidden.)
"""

from __future__ import annotations

import drjit as dr

from nerg_mi.maths.types import Float


def visibility(d_expected: Float, d_met: Float, falloff: Float, tolerance: Float) -> Float:
    """1 visible .. 0 hidden. ``d_expected``: d_o*, ``d_met``: d_o, ``falloff``: d_f >= 0 (0: a step
    function), ``tolerance``: how much nearer than the point a surface may lie and still be it. All in
    scene units."""
    excess = d_expected - d_met - tolerance
    sharp = falloff <= 0
    soft = dr.clip(excess / dr.select(sharp, 1, falloff), 0, 1)
    return 1 - dr.select(sharp, dr.select(excess > 0, 1.0, 0.0), soft)
