"""What an observer, who may stand elsewhere than the camera, sees of a point.

The paper's second depth pass: the observer's ray towards the camera's surface p_d is
marched for its own depth d_o, and compared with the distance d_o* (see ``visibility``).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from nerg_mi.transport.freezing import recording
from nerg_mi.transport.march.settings import MarchSettings
from nerg_mi.transport.place import Place

from .depth_map import ObserverMap
from .visibility import visibility

KINDS = ("depth", "transmittance", "map")

# An entry of a map sees the same surface as a point if it lies at most this many times the point's lift behind it.
_PAST = 4
# Ray casts agree on a shape to this share of the scene's diagonal, or of twice the coordinates there: what is far
# away takes no part in how exactly a near one is met, but for the size of its triangles.
EXACT, _FAR = 1e-4, 3e-7

LARGEST = 1e18
"""Tolerance at most, in scene units: the square of a distance so long is still finite in single precision."""


@dataclass
class Sight:
    """``p_od``: the surface that the observer meets; ``depth``: d_o, the distance to the point where nothing is
    met; ``visibility``: 1 visible .. 0 hidden; ``density_evals``: evaluations that it took (None unless counted);
    ``gaze``: the density, from a map that keeps it, negative where it does not know it; else None."""

    p_od: object
    depth: object
    visibility: object
    density_evals: object
    gaze: object = None


def towards(p_o, p):
    """Distance and unit direction from ``p_o`` to ``p``, finite with their derivatives where both coincide."""
    v = p - p_o
    square = dr.squared_norm(v)
    # Nearer than 1e-15 units the derivative of the direction leaves single precision.
    apart = square > 1e-30
    distance = dr.select(apart, dr.sqrt(dr.select(apart, square, 1)), 0)
    # Any direction will do for an observer exactly on the surface.
    return distance, dr.select(apart, v / dr.select(apart, distance, 1), type(v)(0, 0, 1))


class ObserverPass:
    """Looks from an observer at points of a place.

    ``kind``: one of ``KINDS``; ``depth``: kind of d_o; ``surface_opacity``: opacity from which a ray meets a
    surface; ``tolerance``: in scene units, 0 for two steps (without a medium, see ``EXACT``);
    ``map_height``: rows of the map.
    """

    def __init__(
        self, settings: MarchSettings, kind: str, depth: str, surface_opacity: float, tolerance: float, map_height: int
    ):
        self.settings, self.kind, self.depth = settings, kind, depth
        self.surface_opacity, self.tolerance, self.map_height = surface_opacity, tolerance, map_height
        self._map = None

    def forget(self) -> None:
        """Drop the cached map: the field has changed."""
        self._map = None

    def look(self, place: Place, ray, p_d, p_o, fuzz, active, falloff, count: bool, gaze=None) -> Sight:
        """What the observer at ``p_o`` meets towards the camera's surface ``p_d`` on ``ray``.

        The point that is looked for lies a little in front of the surface, towards the camera: by the
        tolerance, and by ``fuzz``, how far light goes into the surface. A surface then never hides itself,
        however obliquely the observer looks along it, because the ray stays above it. A tolerance along the
        observer's ray alone would have to grow without bound. ``gaze`` (``gaze_medium.GazeMedium``): have a map keep
        the gaze as well, where no derivative needs the field itself.
        """
        import mitsuba as mi

        tolerance = self._tolerance(place, ray, p_d, p_o)
        in_front = tolerance + fuzz
        if self.kind == "map":
            # Entries of a map are this far apart where the ray ends, and depths on slopes as much.
            apart = dr.norm(p_d - p_o) * (dr.pi / self.map_height)
            in_front += apart
            tolerance = tolerance + apart
        distance, r_o = towards(p_o, p_d - ray.d * in_front)
        attended = None

        if self.kind == "map":
            known = self._map_from(place, p_o)
            if gaze is not None and not dr.grad_enabled(p_o, *gaze.parameters()):
                known.keep(gaze)
            else:
                gaze = None
            met, seen = known.look_up(r_o, distance, falloff, tolerance, active)
            if gaze is not None:
                # Of the surface itself: the point in front of it lies in another direction.
                whole, r_d = towards(p_o, p_d)
                attended = known.gaze_along(r_d, whole, falloff, _PAST * in_front, active)
            evals = type(distance)(0)
        else:
            towards_point = mi.Ray3f(p_o, r_o)
            if self.kind == "transmittance":
                towards_point.maxt = distance
                between = place.trace(towards_point, active, self.settings, count=count)
                seen = dr.select(between.hit, 0, 1 if between.march is None else dr.exp(-between.march.tau))
                return Sight(p_d, distance, seen, _evals(between))
            view = place.trace(towards_point, active, self.settings, count=count)
            met = dr.select(active & view.meets(self.surface_opacity), view.depth(self.depth, active), dr.inf)
            seen, evals = visibility(distance, met, falloff, tolerance), _evals(view)
        # An observer who meets nothing before the point sees the point itself.
        blocked = met < distance - tolerance
        d_o = dr.select(dr.isfinite(met), met, distance)
        return Sight(dr.select(blocked, p_o + r_o * d_o, p_d), d_o, seen, evals, attended)

    def _tolerance(self, place, ray, p_d, p_o):
        if self.tolerance:
            return min(self.tolerance, LARGEST)
        if place.medium is None:
            near = 2 * dr.maximum(dr.norm(dr.detach(p_d)), dr.norm(dr.detach(p_o)))
            return EXACT * dr.minimum(place.diagonal, near) + _FAR * place.diagonal
        return dr.minimum(2 * dr.maximum(self.settings.step, self.settings.dt_gamma * dr.norm(p_d - ray.o)), LARGEST)

    def _map_from(self, place, p_o) -> ObserverMap:
        """The observer's map, marched anew only when the observer, the field or a shape has changed."""
        known = self._map
        if recording():
            # A recorded function decides nothing by what it reads: it marches its map whenever it is replayed.
            return ObserverMap(place, p_o, self.map_height, self.settings, self.depth, self.surface_opacity)
        if known is None or not known.serves(place) or not dr.all(known.center == dr.detach(p_o), axis=None):
            self._map = ObserverMap(place, p_o, self.map_height, self.settings, self.depth, self.surface_opacity)
        return self._map


def _evals(view):
    return None if view.march is None else view.march.density_evals
