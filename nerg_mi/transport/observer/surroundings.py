"""What an observer meets in every direction: over which a gaze field is integrated."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np

from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.maths.geometry import Similarity, intersect_box
from nerg_mi.maths.sphere import fibonacci_vectors, neighbourly_order
from nerg_mi.maths.types import Bool, Float, Point3f, Vector3f
from nerg_mi.transport.freezing import recording
from nerg_mi.transport.place import Place

from .settings import ObserverSettings

_FILL = 1 << 14
"""Directions whose depths fill those that escape. Always the same: filled from its own directions, an integral of more
of them would be another one, by up to some per cent where half of them escape."""


_ORDERED = 1 << 20
"""More directions than these are traced in the order in which they are numbered."""


@dataclass(frozen=True)
class Surroundings:
    """Unit ``directions`` of equal area, the ``distance`` (scene units) to what is met along each, and whether no
    surface is met there (``escaped``). Evaluated, without derivatives. ``number`` (N,) of each direction along the
    spiral that all of them lie on; None where they are in its order."""

    directions: Vector3f
    distance: Float
    escaped: Bool
    number: np.ndarray | None = None


class AllAround:
    """The surroundings of one observer, in as many directions as they were asked for in."""

    def __init__(self) -> None:
        self._traced: dict[int, Surroundings] = {}
        self.filling: Filling | None = None
        """What fills directions that escape, once that has been asked for."""

    def of(
        self,
        count: int,
        field: AnyGazeField,
        to_world: Similarity,
        place: Place,
        center: Point3f,
        settings: ObserverSettings,
    ) -> Surroundings:
        """Those in ``count`` directions; the other arguments are those of ``trace_surroundings``, always the same."""
        if count not in self._traced:
            if field.config.fills_escaped and self.filling is None:
                self.filling = trace_filling(field, to_world, place, center, settings)
            self._traced[count] = trace_surroundings(field, to_world, place, center, settings, count, self.filling)
        return self._traced[count]


@dataclass(frozen=True)
class Filling:
    """What fills the directions that escape: those ``directions`` (N, 3) in which a surface is met, ``distance`` (N,)
    away."""

    directions: np.ndarray
    distance: np.ndarray


def trace_surroundings(
    field: AnyGazeField,
    to_world: Similarity,
    place: Place,
    center: Point3f,
    settings: ObserverSettings,
    count: int | None = None,
    filling: Filling | None = None,
) -> Surroundings:
    """Those of the observer at ``center`` (one lane) in ``count`` directions (None: ``settings.directions``), for
    ``field`` in ``place``; ``filling``: see ``distance_along``."""
    import mitsuba as mi

    count = count or settings.directions
    # A recording takes no arrays from NumPy.
    number = None if recording() or count > _ORDERED else neighbourly_order(count)
    with dr.suspend_grad():
        directions = fibonacci_vectors(count, None if number is None else mi.UInt32(number))
        distance, escaped = distance_along(field, to_world, place, center, directions, settings, filling)
        dr.eval(directions, distance, escaped)
    return Surroundings(directions, distance, escaped, number)


def distance_along(
    field: AnyGazeField,
    to_world: Similarity,
    place: Place,
    center: Point3f,
    directions: Vector3f,
    settings: ObserverSettings,
    filling: Filling | None = None,
) -> tuple[Float, Bool]:
    """``(distance, escaped)`` as of ``Surroundings`` along unit ``directions``: where ``field`` is to be
    evaluated, also where there is no surface. What escapes ends on the field's box, or at the depth of the nearest
    directions that do not, as the field wants it: of ``filling``, if it has been traced."""
    import mitsuba as mi

    width = dr.width(directions)
    if not field.config.needs_surfaces:
        return dr.ones(mi.Float, width), dr.full(mi.Bool, False, width)
    met, depth = met_along(place, center, directions, settings, _beyond(field, to_world, center, directions))
    if field.config.fills_escaped:
        escaped = ~np.array(met)
        if escaped.any():
            known = filling or trace_filling(field, to_world, place, center, settings)
            if len(known.distance):
                depth = np.array(depth)
                depth[escaped] = nearest_depth(known.directions, known.distance, np.array(directions).T[escaped])
                depth = mi.Float(depth)
    return depth, ~met


def trace_filling(
    field: AnyGazeField, to_world: Similarity, place: Place, center: Point3f, settings: ObserverSettings
) -> Filling:
    """Of the observer at ``center``; see ``distance_along``."""
    few = fibonacci_vectors(_FILL)
    with dr.suspend_grad():
        traced = met_along(place, center, few, settings, _beyond(field, to_world, center, few))
    known, distance = (np.array(v) for v in traced)
    return Filling(np.array(few).T[known], distance[known])


def nearest_depth(known: np.ndarray, depth: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Depth in directions ``wanted`` (M, 3) from that of the up to eight nearest of ``known`` (N, 3): the mean of its
    logarithm, weighted by the inverse square of the distance."""
    from scipy.spatial import KDTree

    # The leaf decides which of directions that are equally far are among the eight.
    apart, which = KDTree(known, leafsize=16).query(wanted, k=np.arange(1, min(8, len(known)) + 1))  # pyright: ignore[reportArgumentType] SciPy takes several
    weight = 1 / (apart**2 + 1e-3)
    log = np.log(np.maximum(depth, 1e-6))[which]
    return np.exp((weight * log).sum(axis=1) / weight.sum(axis=1)).astype(np.float32)


def met_along(
    place: Place, center: Point3f, directions: Vector3f, settings: ObserverSettings, beyond: Float = 0.0
) -> tuple[Bool, Float]:
    """Whether a surface is met along unit ``directions`` (lanes) from ``center``, and its distance in scene units;
    ``beyond`` where none is."""
    import mitsuba as mi

    everywhere = dr.full(mi.Bool, True, dr.width(directions))
    view = place.trace(mi.Ray3f(center, directions), everywhere, settings.march)
    met = everywhere & view.meets(settings.surface_opacity)
    return met, dr.select(met, view.depth(settings.depth, met), beyond)


def _beyond(field: AnyGazeField, to_world: Similarity, center: Point3f, directions: Vector3f) -> Float:
    """Where a ray that meets nothing ends: on the gaze field's box, or its diagonal away."""
    box = field.box
    near, far = intersect_box(
        to_world.point_to_local(center), to_world.vector_to_local(directions), box.lower, box.upper
    )
    return dr.select((near < far) & (far > 0) & dr.isfinite(far), far, box.diagonal * to_world.scale)
