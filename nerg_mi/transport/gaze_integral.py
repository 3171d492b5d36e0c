"""The integral of a gaze field over an observer's sphere, by which a normalised field is divided.

It depends on where the observer stands and on nothing that the camera does: one integral an observer, over a set of
directions of equal area whose depths are traced once.
"""
from __future__ import annotations

import math

import drjit as dr
import numpy as np

from .observer_map import _fingerprint, _indices

COUNT = 1 << 17
"""Directions of an integral: enough for a thousandth at depths that jump from surface to surface."""

_FILL = 1 << 14
"""Directions whose depths fill those that escape. Always the same: filled from its own directions, an integral of more of them
would be another one, by up to some per cent where half of them escape."""


class GazeIntegral:
    """Of ``gaze`` (``media.GazeMedium``) at ``p_o`` (Point3f, one lane) in ``place``; see ``value``.

    ``settings``, ``kind``, ``surface_opacity``: of the observer's rays, as the integrator has them. The depths carry no
    derivatives; the value has those of the field's parameters. ``depths``: an integral of such a field here, whose depths will do.
    """

    def __init__(self, gaze, place, p_o, settings, kind: str, surface_opacity: float, count: int = COUNT, depths: GazeIntegral | None = None):
        import mitsuba as mi

        self.gaze, self.center = gaze, mi.Point3f(dr.detach(p_o))
        # A position that is a constant of the kernel would be compiled anew for every observer.
        dr.make_opaque(self.center)
        self._made = _traced_in(place), settings, kind, surface_opacity
        self._value, self._value_of = None, None
        if depths is not None:
            self.directions, self.distance, self.escaped = depths.directions, depths.distance, depths.escaped
            return
        with dr.suspend_grad():
            self.directions = _spiral(count)
            self.distance, self.escaped = self._depths(place, settings, kind, surface_opacity)
            dr.eval(self.directions, self.distance, self.escaped)

    def _depths(self, place, settings, kind, surface_opacity):
        import mitsuba as mi

        config, width = self.gaze.field.config, dr.width(self.directions)
        if getattr(config, "geometry", None) == "none":
            return dr.ones(mi.Float, width), dr.full(mi.Bool, False, width)

        def trace(directions):
            everywhere = dr.full(mi.Bool, True, dr.width(directions))
            view = place.look(mi.Ray3f(self.center, directions), everywhere, settings)
            met = everywhere & view.meets(surface_opacity)
            return met, dr.select(met, view.depth(kind, met), self._beyond(directions))

        met, depth = trace(self.directions)
        if getattr(config, "escaped", None) == "nearest":
            escaped = ~np.array(met)
            if escaped.any():
                few = _spiral(_FILL)
                known, distance = (np.array(v) for v in trace(few))
                if known.any():
                    depth = np.array(depth)
                    depth[escaped] = nearest_depth(np.array(few).T[known], distance[known], np.array(self.directions).T[escaped])
                    depth = mi.Float(depth)
        return depth, ~met

    def _beyond(self, directions):
        """Where a ray that meets nothing ends: on the gaze field's box, or its diagonal away."""
        from .ray_box import intersect_box

        box, local = self.gaze.field.box, self.gaze.to_world
        near, far = intersect_box(local.point_to_local(self.center), local.vector_to_local(directions), box.lower, box.upper)
        return dr.select((near < far) & (far > 0) & dr.isfinite(far), far, box.diagonal * local.scale)

    def serves(self, p_o, place, settings, kind, surface_opacity) -> bool:
        """Whether the depths are those of such an observer in such a place."""
        return self._made == (_traced_in(place), settings, kind, surface_opacity) and bool(dr.all(self.center == dr.detach(p_o), axis=None))

    def value(self):
        """The integral (Float of one lane), with derivatives where parameters of the field have any."""
        parameters = self.gaze.parameters()
        if not dr.grad_enabled(parameters):
            if self._value_of is None or self._value_of != _indices(parameters):
                with dr.suspend_grad():
                    self._value = self._integral()
                    dr.eval(self._value)
                self._value_of = _indices(parameters)
            return self._value
        return self._integral()

    def _integral(self):
        o = self.center + dr.zeros(type(self.center), dr.width(self.directions))
        emit, capture = self.gaze.unnormalized(o + self.directions * self.distance, o, self.directions, True, self.escaped)
        return dr.mean(emit * capture + dr.zeros(type(self.distance), dr.width(self.distance))) * (4 * dr.pi)


def _spiral(count: int):
    """``count`` directions of equal area (Vector3f) on a golden-angle spiral: ``attention.sphere``'s, made on the device."""
    import mitsuba as mi

    i = dr.arange(mi.Float, count)
    z = 1 - (2 * i + 1) / count
    # Turns of the golden angle, of which whole ones are dropped in double precision.
    turns = dr.arange(mi.Float64, count) * (1.5 - 0.5 * math.sqrt(5))
    sin, cos = dr.sincos(mi.Float(dr.two_pi * (turns - dr.floor(turns))))
    r = dr.sqrt((1 - z) * (1 + z))
    return mi.Vector3f(r * cos, r * sin, z)


def nearest_depth(known: np.ndarray, depth: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Depth in directions ``wanted`` (M, 3) from that of the up to eight nearest of ``known`` (N, 3): the mean of its
    logarithm, weighted by the inverse square of the distance."""
    from scipy.spatial import cKDTree

    apart, which = cKDTree(known).query(wanted, k=np.arange(1, min(8, len(known)) + 1))
    weight = 1 / (apart**2 + 1e-3)
    log = np.log(np.maximum(depth, 1e-6))[which]
    return np.exp((weight * log).sum(axis=1) / weight.sum(axis=1)).astype(np.float32)


def _traced_in(place) -> list:
    values = [] if place.medium is None else [v for v in place.medium.parameters() if dr.is_array_v(v)]
    return [_fingerprint(place), _indices(values)]
