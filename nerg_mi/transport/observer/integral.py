"""The integral of a gaze field over an observer's sphere, by which a normalised field is divided.

It depends on where the observer stands and on nothing that the camera does: one integral an observer, over a set of
directions of equal area whose depths are traced once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import numpy as np

from nerg_mi.transport.features import observed_features
from nerg_mi.transport.fingerprint import Fingerprint, of_shapes

COUNT = 1 << 17
"""Directions of an integral: enough for a thousandth at depths that jump from surface to surface."""

_FILL = 1 << 14
"""Directions whose depths fill those that escape. Always the same: filled from its own directions, an integral of more
of them would be another one, by up to some per cent where half of them escape."""


class GazeIntegral:
    """Of ``gaze`` (``gaze_medium.GazeMedium``) at ``p_o`` (Point3f, one lane) in ``place``; see ``value``.

    ``settings``, ``kind``, ``surface_opacity``: of the observer's rays, as the integrator has them. The depths carry no
    derivatives; the value has those of the field's parameters. ``depths``: an integral of such a field here, whose
    depths will do.
    """

    def __init__(
        self,
        gaze,
        place,
        p_o,
        settings,
        kind: str,
        surface_opacity: float,
        count: int = COUNT,
        depths: GazeIntegral | None = None,
    ):
        import mitsuba as mi

        self.gaze, self.center = gaze, mi.Point3f(dr.detach(p_o))
        # A position that is a constant of the kernel would be compiled anew for every observer.
        dr.make_opaque(self.center)
        self._made = _traced_in(place), settings, kind, surface_opacity
        self._surroundings = Surroundings(gaze, place, self.center, settings, kind, surface_opacity)
        self._value, self._value_of = None, None
        if depths is not None:
            self.directions, self.distance, self.escaped = depths.directions, depths.distance, depths.escaped
            return
        with dr.suspend_grad():
            self.directions = _spiral(count)
            self.distance, self.escaped = self._surroundings.along(self.directions)
            dr.eval(self.directions, self.distance, self.escaped)

    def serves(self, p_o, place, settings, kind, surface_opacity) -> bool:
        """Whether the depths are those of such an observer in such a place."""
        return self._made == (_traced_in(place), settings, kind, surface_opacity) and bool(
            dr.all(self.center == dr.detach(p_o), axis=None)
        )

    def value(self):
        """The integral (Float of one lane), with derivatives where parameters of the field have any."""
        parameters = self.gaze.parameters()
        if not dr.grad_enabled(parameters):
            if self._value_of is None or self._value_of != Fingerprint(parameters):
                with dr.suspend_grad():
                    self._value = self._integral()
                    dr.eval(self._value)
                self._value_of = Fingerprint(parameters)
            return self._value
        return self._integral()

    def _integral(self):
        o = self.center + dr.zeros(type(self.center), dr.width(self.directions))
        emit, capture = self.gaze.unnormalized(
            o + self.directions * self.distance, o, self.directions, True, self.escaped
        )
        return dr.mean(emit * capture + dr.zeros(type(self.distance), dr.width(self.distance))) * (4 * dr.pi)


class Surroundings:
    """What an observer at ``center`` (Point3f, one lane) meets in every direction, as the field of ``gaze`` is to be
    evaluated there: also where there is no surface. The other arguments are those of ``GazeIntegral``."""

    def __init__(self, gaze, place, center, settings, kind: str, surface_opacity: float):
        self.field, self.to_world, self.place, self.center = gaze.field, gaze.to_world, place, center
        self.settings, self.kind, self.surface_opacity = settings, kind, surface_opacity

    def along(self, directions):
        """Distance (Float, scene units) along unit ``directions`` (Vector3f), and whether no surface is met there
        (Bool).

        What escapes ends on the field's box, or at the depth of the nearest directions that do not, as the field wants
        it."""
        import mitsuba as mi

        config, width = self.field.config, dr.width(directions)
        if getattr(config, "geometry", None) == "none":
            return dr.ones(mi.Float, width), dr.full(mi.Bool, False, width)
        met, depth = self._trace(directions)
        if getattr(config, "escaped", None) == "nearest":
            escaped = ~np.array(met)
            if escaped.any():
                few = _spiral(_FILL)
                known, distance = (np.array(v) for v in self._trace(few))
                if known.any():
                    depth = np.array(depth)
                    depth[escaped] = nearest_depth(
                        np.array(few).T[known], distance[known], np.array(directions).T[escaped]
                    )
                    depth = mi.Float(depth)
        return depth, ~met

    def _trace(self, directions):
        import mitsuba as mi

        everywhere = dr.full(mi.Bool, True, dr.width(directions))
        view = self.place.trace(mi.Ray3f(self.center, directions), everywhere, self.settings)
        met = everywhere & view.meets(self.surface_opacity)
        return met, dr.select(met, view.depth(self.kind, met), self._beyond(directions))

    def _beyond(self, directions):
        """Where a ray that meets nothing ends: on the gaze field's box, or its diagonal away."""
        from nerg_mi.maths.ray_box import intersect_box

        box, local = self.field.box, self.to_world
        near, far = intersect_box(
            local.point_to_local(self.center), local.vector_to_local(directions), box.lower, box.upper
        )
        return dr.select((near < far) & (far > 0) & dr.isfinite(far), far, box.diagonal * local.scale)


@dataclass(frozen=True)
class KnownIntegral:
    """An integral of which nothing but the number is kept: ``number`` (Float, one lane) of the observer at
    ``center``."""

    center: object
    number: object

    def value(self):
        return self.number

    def serves(self, *how) -> bool:
        """Never: what it was made of is not known."""
        return False


def gaze_around(gaze, place, p_o, r_o, settings, kind: str, surface_opacity: float):
    """Density (Float, 1/sr) of the observer at ``p_o`` (Point3f, one lane) in directions ``r_o`` (unit Vector3f),
    carrying no derivatives: on surfaces what the integrator shows there, and elsewhere what the field was trained to
    be.

    ``gaze`` (``gaze_medium.GazeMedium`` or ``gaze_ensemble.EnsembleMedium``) must ``face`` the observer; the others as there.
    """
    import mitsuba as mi

    with dr.suspend_grad():
        center = mi.Point3f(dr.detach(p_o))
        dr.make_opaque(center)
        distance, escaped = Surroundings(gaze, place, center, settings, kind, surface_opacity).along(r_o)
        o = center + dr.zeros(mi.Point3f, dr.width(r_o))
        p_od, everywhere = o + r_o * distance, dr.full(mi.Bool, True, dr.width(r_o))
        semantic = observed_features(gaze.field.config.semantic, place, p_od, o, r_o, everywhere, settings)
        # A constant variant returns one lane for all.
        return gaze.evaluate(p_od, o, r_o, everywhere, semantic, escaped)[0] + dr.zeros(mi.Float, dr.width(r_o))


def _spiral(count: int):
    """``count`` directions of equal area (Vector3f) on a golden-angle spiral: ``maths.sphere``'s, made on the
    device."""
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
    return [of_shapes(place), Fingerprint(values)]
