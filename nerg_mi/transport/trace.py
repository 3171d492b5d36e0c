"""Depths along many rays at once, outside of any render: where the surfaces are that people look at."""

from __future__ import annotations

import drjit as dr
import numpy as np

from nerg_mi.field.backend import namespace

from .march.depth import KINDS, surface_depth
from .march.primal import MarchSettings, march
from .place import Place

BATCH = 1 << 19


def default_settings(medium) -> MarchSettings:
    """The march of the integrator ``nerg`` with nothing set: the medium's own step, or a 1024th of its diagonal."""
    if isinstance(medium, Place):
        return default_settings(medium.medium) if medium.medium is not None else MarchSettings(step=1)
    return MarchSettings(step=medium.step or medium.length_scale / 1024)


def trace_depth(
    medium, origins, directions, settings: MarchSettings | None = None, kind: str = "median", batch: int = BATCH
):
    """Depth of the surface along rays through a medium, and the opacity that they meet: a density-only march.

    ``medium``: a ``FieldMedium`` or ``VolumeMedium``, or a ``Place`` (of shapes, whose rays are cast exactly, or of
    both). ``origins``, ``directions``: N rays in the scene's frame, directions unit, either as NumPy arrays (N, 3) or
    as Dr.Jit 3-arrays of N lanes. ``settings``: see ``default_settings``.
    ``kind``: ``median``, ``expected`` or ``refined`` (``transport.march.depth``). Returns ``(depth, opacity)`` of the
    kind that the rays came in (float32 (N,), or Dr.Jit Floats, evaluated): depth is the distance from the origin in
    scene units, 0 where nothing absorbs; which opacity makes a surface is the caller's to say. At most ``batch`` rays
    are marched in one launch. Carries no derivatives. Raises ``ValueError`` for an unknown kind and for shapes that do
    not fit.
    """
    if kind not in KINDS:
        raise ValueError(f'the depth must be one of {", ".join(KINDS)}, got "{kind}"')
    if batch < 1:
        raise ValueError(f"a batch must hold at least 1 ray, got {batch}")
    settings = settings or default_settings(medium)
    if dr.is_array_v(origins):
        return _traced_jit(medium, origins, directions, settings, kind, batch)
    o, d = (np.asarray(v, np.float32) for v in (origins, directions))
    if o.shape != d.shape or o.ndim != 2 or o.shape[1] != 3:
        raise ValueError(f"origins {o.shape} and directions {d.shape} must both have shape (N, 3)")
    ns, array = _types(medium)
    depth, opacity = np.empty((2, len(o)), np.float32)
    for a in range(0, len(o), batch):
        part = slice(a, a + batch)
        found = _trace(
            medium, array(np.ascontiguousarray(o[part].T)), array(np.ascontiguousarray(d[part].T)), settings, kind
        )
        depth[part], opacity[part] = (np.asarray(ns.Float(x)) for x in found)
    return depth, opacity


def _traced_jit(medium, origins, directions, settings, kind, batch):
    count = max(dr.width(origins), dr.width(directions))
    array, Float = type(origins), type(origins.x)
    ns = namespace(Float)
    if count <= batch:
        return _trace(medium, origins, array(directions), settings, kind)
    depth, opacity = dr.empty(Float, count), dr.empty(Float, count)
    origins, directions = (v + dr.zeros(array, count) for v in (origins, array(directions)))
    for a in range(0, count, batch):
        index = dr.arange(ns.UInt32, min(batch, count - a)) + dr.opaque(ns.UInt32, a)
        found = _trace(medium, dr.gather(array, origins, index), dr.gather(array, directions, index), settings, kind)
        for out, value in zip((depth, opacity), found):
            dr.scatter(out, value, index)
    dr.eval(depth, opacity)
    return depth, opacity


def _types(medium):
    """Namespace and 3-array of the backend that a medium's arrays belong to."""
    if isinstance(medium, Place):
        import mitsuba as mi

        return namespace(mi.variant()), mi.Point3f
    ns = namespace(next(v for v in medium.parameters() if dr.is_array_v(v)))
    return ns, ns.Array3f


def _trace(medium, o, d, settings, kind):
    if isinstance(medium, Place):
        return _traced_in(medium, o, d, settings, kind)
    with dr.suspend_grad():
        ray = medium.local(o, d)
        t0, t1 = dr.maximum(ray.t_near, 0), ray.t_far
        active = t0 < t1
        result = march(medium, ray, t0, t1, active, settings)
        depth = surface_depth(kind, result, medium, ray, t0, t1, active, settings)
        opacity = dr.select(active, result.opacity, 0)
        depth = dr.select(active, depth, 0)
    dr.eval(depth, opacity)
    return depth, opacity


def _traced_in(place, o, d, settings, kind):
    import mitsuba as mi

    with dr.suspend_grad():
        everywhere = dr.full(mi.Bool, True, max(dr.width(o), dr.width(d)))
        view = place.trace(mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)), everywhere, settings)
        opacity = view.opacity + dr.zeros(mi.Float, dr.width(everywhere))
        depth = view.depth(kind, opacity > 0)
    dr.eval(depth, opacity)
    return depth, opacity
