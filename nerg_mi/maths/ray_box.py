"""Where a ray is inside an axis-aligned box (slab method)."""

from __future__ import annotations

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike


def intersect_box(o, d, lower, upper):
    """Parameters ``(t_near, t_far)`` at which ``o + t d`` enters and leaves the box.

    ``o``, ``d``: Array3f; ``lower``, ``upper``: sequences of 3 numbers, which kernels are compiled with, or of 3
    Floats, which they read. The ray misses where ``t_near >= t_far``. ``t_near`` is not clamped to 0. A component of
    ``d`` that is zero never divides: such a ray is inside that slab for all t or for none.
    """
    Float = type(o.x)
    lower, upper = ([v if dr.is_array_v(v) else float(v) for v in corner] for corner in (lower, upper))
    near, far = Float(-dr.inf), Float(dr.inf)
    for oc, dc, lo, hi in zip((o.x, o.y, o.z), (d.x, d.y, d.z), lower, upper):
        parallel = dc == 0
        inverse = 1 / dr.select(parallel, 1, dc)
        a, b = (lo - oc) * inverse, (hi - oc) * inverse
        outside = parallel & ((oc < lo) | (oc > hi))
        t_in = dr.select(parallel, -dr.inf, dr.minimum(a, b))
        t_out = dr.select(parallel, dr.select(outside, -dr.inf, dr.inf), dr.maximum(a, b))
        near, far = dr.maximum(near, t_in), dr.minimum(far, t_out)
    return near, far


def box_interval(o: ArrayLike, d: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """The same for NumPy rays: ``o``, ``d`` broadcast to (N, 3); ``t_near`` and ``t_far`` (N,), infinite where no
    component of ``d`` leaves its slab."""
    near, far = -np.inf, np.inf
    # Axis by axis: NumPy's reductions over three numbers take several times as long.
    for oc, dc, lo, hi in zip(*(np.moveaxis(np.asarray(v), -1, 0) for v in (o, d, lower, upper))):
        still = dc == 0
        along = np.where(still, 1, dc)
        with np.errstate(over="ignore"):
            a, b = (lo - oc) / along, (hi - oc) / along
        outside = still & ((oc < lo) | (oc > hi))
        near = np.maximum(near, np.where(still, -np.inf, np.minimum(a, b)))
        far = np.minimum(far, np.where(still, np.where(outside, -np.inf, np.inf), np.maximum(a, b)))
    return np.asarray(near), np.asarray(far)
