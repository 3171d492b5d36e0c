"""Depths along many rays at once, outside of any render: where the surfaces are that people look at."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.types import Float, Point3f, Vector3f

from .march.depth import DEPTHS
from .march.settings import MarchSettings, default_growth, default_step, default_stop
from .media.protocol import Medium
from .place import Place, SceneRay, as_place

BATCH = 1 << 19
"""Rays that are marched in one launch."""


def default_settings(subject: Medium | Place) -> MarchSettings:
    """The march of the integrator ``nerg`` with nothing set."""
    medium = as_place(subject).medium
    return MarchSettings(step=default_step(medium), dt_gamma=default_growth(medium), stop=default_stop(medium))


def trace_depth(
    subject: Medium | Place,
    origins: np.ndarray | Point3f,
    directions: np.ndarray | Vector3f,
    settings: MarchSettings | None = None,
    kind: str = "median",
    batch: int = BATCH,
) -> tuple[Any, Any]:
    """Depth of the surface along rays, and the opacity that they meet: a density-only march, and a ray cast.

    ``subject``: a medium, or a ``Place`` (of shapes, which are met exactly, or of both). ``origins``, ``directions``:
    N rays in the scene's frame, directions unit, either as NumPy arrays (N, 3) or as Dr.Jit 3-arrays of N lanes.
    ``settings``: see ``default_settings``. ``kind``: a name in ``march.depth.DEPTHS``. Returns ``(depth, opacity)`` of
    the kind that the rays came in (float32 (N,), or Dr.Jit Floats, evaluated): depth is the distance from the origin in
    scene units, 0 where nothing absorbs; which opacity makes a surface is the caller's to say. At most ``batch`` rays
    are marched in one launch. Carries no derivatives. Raises ``NergError`` for an unknown kind and ``ValueError`` for
    shapes that do not fit.
    """
    DEPTHS.find(kind)
    if batch < 1:
        raise ValueError(f"a batch must hold at least 1 ray, got {batch}")
    place = as_place(subject)
    settings = settings or default_settings(place)
    if dr.is_array_v(origins):
        return _traced_jit(place, origins, directions, settings, kind, batch)
    o, d = (np.asarray(v, np.float32) for v in (origins, directions))
    if o.shape != d.shape or o.ndim != 2 or o.shape[1] != 3:
        raise ValueError(f"origins {o.shape} and directions {d.shape} must both have shape (N, 3)")
    ns, array = _types(place)
    depth, opacity = np.empty((2, len(o)), np.float32)
    for a in range(0, len(o), batch):
        part = slice(a, a + batch)
        start, along = (array(np.ascontiguousarray(v[part].T)) for v in (o, d))
        found = _trace(place, start, along, settings, kind)
        depth[part], opacity[part] = (np.asarray(ns.Float(x)) for x in found)
    return depth, opacity


def _traced_jit(
    place: Place, origins: Point3f, directions: Vector3f, settings: MarchSettings, kind: str, batch: int
) -> tuple[Float, Float]:
    count = max(dr.width(origins), dr.width(directions))
    array, Float = type(origins), type(origins.x)
    ns = namespace(Float)
    if count <= batch:
        return _trace(place, origins, array(directions), settings, kind)
    depth, opacity = dr.empty(Float, count), dr.empty(Float, count)
    origins, directions = (v + dr.zeros(array, count) for v in (origins, array(directions)))
    for a in range(0, count, batch):
        index = dr.arange(ns.UInt32, min(batch, count - a)) + dr.opaque(ns.UInt32, a)
        start, along = (dr.gather(array, v, index) for v in (origins, directions))
        for out, value in zip((depth, opacity), _trace(place, start, along, settings, kind)):
            dr.scatter(out, value, index)
    dr.eval(depth, opacity)
    return depth, opacity


def _types(place: Place) -> tuple[ModuleType, type]:
    """Namespace and 3-array of the backend that a place's arrays belong to."""
    if place.scene is None and place.medium is not None:
        for value in place.medium.parameters():
            if dr.is_array_v(value):
                ns = namespace(value)
                return ns, ns.Array3f
    import mitsuba as mi

    return namespace(mi.Float), mi.Point3f


def _trace(place: Place, o: Point3f, d: Vector3f, settings: MarchSettings, kind: str) -> tuple[Float, Float]:
    Float, count = type(o.x), max(dr.width(o), dr.width(d))
    with dr.suspend_grad():
        ray = SceneRay(o, d, Float(dr.inf))
        if place.scene is not None:
            import mitsuba as mi

            ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))
        view = place.trace(ray, dr.full(dr.mask_t(Float), True, count), settings)
        opacity = view.opacity + dr.zeros(Float, count)
        depth = view.depth(kind, opacity > 0)
    dr.eval(depth, opacity)
    return depth, opacity
