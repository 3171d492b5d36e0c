"""Where a ray is inside an axis-aligned box (slab method)."""

from __future__ import annotations

import drjit as dr


def intersect_box(o, d, lower, upper):
    """Parameters ``(t_near, t_far)`` at which ``o + t d`` enters and leaves the box.

    ``o``, ``d``: Array3f; ``lower``, ``upper``: sequences of 3 numbers. The ray misses where
    ``t_near >= t_far``. ``t_near`` is not clamped to 0. A component of ``d`` that is zero
    never divides: such a ray is inside that slab for all t or for none.
    """
    Float = type(o.x)
    near, far = Float(-dr.inf), Float(dr.inf)
    for oc, dc, lo, hi in zip((o.x, o.y, o.z), (d.x, d.y, d.z), map(float, lower), map(float, upper)):
        parallel = dc == 0
        inverse = 1 / dr.select(parallel, 1, dc)
        a, b = (lo - oc) * inverse, (hi - oc) * inverse
        outside = parallel & ((oc < lo) | (oc > hi))
        t_in = dr.select(parallel, -dr.inf, dr.minimum(a, b))
        t_out = dr.select(parallel, dr.select(outside, -dr.inf, dr.inf), dr.maximum(a, b))
        near, far = dr.maximum(near, t_in), dr.minimum(far, t_out)
    return near, far
