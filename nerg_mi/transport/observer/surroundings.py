"""What an observer meets in every direction: over which a gaze field is integrated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import numpy as np

from nerg_mi.field.gaze.protocol import AnyGazeField
from nerg_mi.maths.ray_box import intersect_box
from nerg_mi.maths.similarity import Similarity
from nerg_mi.maths.sphere import fibonacci_vectors
from nerg_mi.maths.types import Bool, Float, Point3f, Vector3f
from nerg_mi.transport.place import Place

from .settings import ObserverSettings

_FILL = 1 << 14
"""Directions whose depths fill those that escape. Always the same: filled from its own directions, an integral of more
of them would be another one, by up to some per cent where half of them escape."""


@dataclass(frozen=True)
class Surroundings:
    """Unit ``directions`` of equal area, the ``distance`` (scene units) to what is met along each, and whether no
    surface is met there (``escaped``). Evaluated, without derivatives."""

    directions: Vector3f
    distance: Float
    escaped: Bool


def trace_surroundings(
    field: AnyGazeField, to_world: Similarity, place: Place, center: Point3f, settings: ObserverSettings
) -> Surroundings:
    """Those of the observer at ``center`` (one lane) in ``settings.directions``, for ``field`` in ``place``."""
    with dr.suspend_grad():
        directions = fibonacci_vectors(settings.directions)
        distance, escaped = distance_along(field, to_world, place, center, directions, settings)
        dr.eval(directions, distance, escaped)
    return Surroundings(directions, distance, escaped)


def distance_along(
    field: AnyGazeField,
    to_world: Similarity,
    place: Place,
    center: Point3f,
    directions: Vector3f,
    settings: ObserverSettings,
) -> tuple[Float, Bool]:
    """``(distance, escaped)`` as of ``Surroundings`` along unit ``directions``: where ``field`` is to be
    evaluated, also where there is no surface. What escapes ends on the field's box, or at the depth of the nearest
    directions that do not, as the field wants it."""
    import mitsuba as mi

    width = dr.width(directions)
    if not field.config.needs_surfaces:
        return dr.ones(mi.Float, width), dr.full(mi.Bool, False, width)
    beyond = lambda directions: _beyond(field, to_world, center, directions)
    met, depth = _trace(place, center, directions, settings, beyond)
    if field.config.fills_escaped:
        escaped = ~np.array(met)
        if escaped.any():
            few = fibonacci_vectors(_FILL)
            known, distance = (np.array(v) for v in _trace(place, center, few, settings, beyond))
            if known.any():
                depth = np.array(depth)
                depth[escaped] = nearest_depth(np.array(few).T[known], distance[known], np.array(directions).T[escaped])
                depth = mi.Float(depth)
    return depth, ~met


def nearest_depth(known: np.ndarray, depth: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Depth in directions ``wanted`` (M, 3) from that of the up to eight nearest of ``known`` (N, 3): the mean of its
    logarithm, weighted by the inverse square of the distance."""
    from scipy.spatial import KDTree

    # The leaf decides which of directions that are equally far are among the eight.
    apart, which = KDTree(known, leafsize=16).query(wanted, k=np.arange(1, min(8, len(known)) + 1))  # pyright: ignore[reportArgumentType] SciPy takes several
    weight = 1 / (apart**2 + 1e-3)
    log = np.log(np.maximum(depth, 1e-6))[which]
    return np.exp((weight * log).sum(axis=1) / weight.sum(axis=1)).astype(np.float32)


def _trace(
    place: Place, center: Point3f, directions: Vector3f, settings: ObserverSettings, beyond: Callable[[Vector3f], Float]
) -> tuple[Bool, Float]:
    """Whether a surface is met along ``directions``, and where; ``beyond(directions)`` where none is."""
    import mitsuba as mi

    everywhere = dr.full(mi.Bool, True, dr.width(directions))
    view = place.trace(mi.Ray3f(center, directions), everywhere, settings.march)
    met = everywhere & view.meets(settings.surface_opacity)
    return met, dr.select(met, view.depth(settings.depth, met), beyond(directions))


def _beyond(field: AnyGazeField, to_world: Similarity, center: Point3f, directions: Vector3f) -> Float:
    """Where a ray that meets nothing ends: on the gaze field's box, or its diagonal away."""
    box = field.box
    near, far = intersect_box(
        to_world.point_to_local(center), to_world.vector_to_local(directions), box.lower, box.upper
    )
    return dr.select((near < far) & (far > 0) & dr.isfinite(far), far, box.diagonal * to_world.scale)
