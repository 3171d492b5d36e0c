"""What an observer, who may stand elsewhere than the camera, sees of a point.

The paper's second depth pass: the observer's ray towards the camera's surface p_d is
marched for its own depth d_o, and compared with the distance d_o* (see ``visibility``).
"""
from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from .depth import surface_depth
from .march import MarchSettings, scouted_march
from .observer_map import ObserverMap
from .visibility import visibility

KINDS = ("depth", "transmittance", "map")


@dataclass
class Sight:
    """``p_od``: the surface that the observer meets; ``depth``: d_o, the distance to the point where nothing is
    met; ``visibility``: 1 visible .. 0 hidden; ``density_evals``: evaluations that it took."""

    p_od: object
    depth: object
    visibility: object
    density_evals: object


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
    """Looks from an observer at points of ``medium``.

    ``kind``: one of ``KINDS``; ``depth``: kind of d_o; ``surface_opacity``: opacity from which a ray meets a
    surface; ``tolerance``: in scene units, 0 for two steps; ``map_height``: rows of the map.
    """

    def __init__(self, medium, settings: MarchSettings, kind: str, depth: str, surface_opacity: float,
                 tolerance: float, map_height: int):
        self.medium, self.settings, self.kind, self.depth = medium, settings, kind, depth
        self.surface_opacity, self.tolerance, self.map_height = surface_opacity, tolerance, map_height
        self._map = None

    def forget(self) -> None:
        """Drop the cached map: the field has changed."""
        self._map = None

    def look(self, ray, p_d, p_o, fuzz, active, falloff, count: bool) -> Sight:
        """What the observer at ``p_o`` meets towards the camera's surface ``p_d`` on ``ray``.

        The point that is looked for lies a little in front of the surface, towards the camera: by the
        tolerance, and by ``fuzz``, how far light goes into the surface. A surface then never hides itself,
        however obliquely the observer looks along it, because the ray stays above it. A tolerance along the
        observer's ray alone would have to grow without bound.
        """
        step = dr.maximum(self.settings.step, self.settings.dt_gamma * dr.norm(p_d - ray.o))
        tolerance = self.tolerance or 2 * step
        in_front = tolerance + fuzz
        if self.kind == "map":
            # Entries of a map are this far apart where the ray ends.
            in_front += dr.norm(p_d - p_o) * (dr.pi / self.map_height)
        distance, r_o = towards(p_o, p_d - ray.d * in_front)

        if self.kind == "map":
            met, seen = self._map_from(p_o, type(p_d)).look_up(r_o, distance, falloff, tolerance, active)
            evals = type(distance)(0)
        else:
            local = self.medium.local(p_o, r_o)
            t0, t1 = dr.maximum(local.t_near, 0), local.t_far
            if self.kind == "transmittance":
                between = scouted_march(
                    self.medium, local, t0, dr.minimum(t1, distance), active, self.settings, count=count
                )
                return Sight(p_d, distance, dr.exp(-between.tau), between.density_evals)
            result = scouted_march(self.medium, local, t0, t1, active, self.settings, count=count)
            depth = surface_depth(self.depth, result, self.medium, local, t0, t1, active, self.settings)
            met = dr.select(active & (result.opacity >= self.surface_opacity), depth, dr.inf)
            seen, evals = visibility(distance, met, falloff, tolerance), result.density_evals
        # An observer who meets nothing before the point sees the point itself.
        blocked = met < distance - tolerance
        d_o = dr.select(dr.isfinite(met), met, distance)
        return Sight(dr.select(blocked, p_o + r_o * d_o, p_d), d_o, seen, evals)

    def _map_from(self, p_o, vector) -> ObserverMap:
        """The observer's map, marched anew only when the observer has moved or a parameter has changed."""
        if self._map is None or not dr.all(self._map.center == dr.detach(p_o), axis=None):
            self._map = ObserverMap(
                self.medium, p_o, self.map_height, self.settings, self.depth, self.surface_opacity, vector
            )
        return self._map
