"""A gaze field in the scene, and what it says of observers.

A field alone cannot be evaluated for an observer: a normalised one must be divided by its integral over the observer's
sphere, which depends on where they stand, and one with semantic features needs those of the place. So a ``PlacedGaze``
has no densities; ``at`` gives an ``ObservedGaze``, which has.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np

from nerg_mi.fields.gaze_base import AnyGazeField, GazeDensity
from nerg_mi.fields.gaze_ensemble import mean, spread
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.types import Bool, Float, Point3f, Vector3f
from nerg_mi.transport.features import observed_features
from nerg_mi.transport.fingerprint import Fingerprint
from nerg_mi.transport.freezing import recording
from nerg_mi.transport.place import Place

from .cache import Known, ObserverCache, fingerprint_of
from .integral import Integral, integrate
from .settings import ObserverSettings
from .surroundings import AllAround, Filling, Surroundings, distance_along, met_along
from .viewpoint import select_nearest

STEP = 1 / 256
"""How far an observer is moved for the derivatives of an integral, of the side of the field's box: edges that pass
then are many directions apart."""

MOVING = 1 << 15
"""Directions of these integrals at most."""


class PlacedGaze:
    """``field`` placed in the scene by ``to_world`` (field to scene); neither is replaced afterwards."""

    def __init__(self, field: AnyGazeField, to_world: Similarity | None = None):
        self.field, self.to_world = field, to_world or Similarity()

    def parameters(self) -> list:
        """Arrays that gaze depends on, for derivatives."""
        return list(self.field.parameters().values())

    def at(
        self, observers: list[Point3f], place: Place, settings: ObserverSettings, cache: ObserverCache | None = None
    ) -> ObservedGaze:
        """The field for ``observers`` (scene points, one lane each) in ``place``, traced with ``settings``.

        A normalised field is integrated over the sphere around each observer, to ``settings.integral_tolerance``; the
        depths carry no derivatives, the integral has those of the field's parameters and of the observers' positions. A
        field that is not normalised is the same for all observers. ``cache``: where depths and integrals are kept.
        """
        if not self.field.config.normalized:
            return ObservedGaze(self, place, settings, [])
        if not observers:
            raise ValueError("a gaze field that is normalised over the observer's sphere needs to know the observers")
        cache = cache or ObserverCache()
        made_of = (fingerprint_of(place), settings.surfaces)
        around = cache.of_each((self, "surroundings"), observers, made_of, lambda center: AllAround())
        made_of = (*made_of, settings.directions, settings.integral_tolerance)
        integrals = []
        for member in self.field.members:
            integral = _SphereIntegral(self, member, place, settings)
            parameters = list(member.parameters().values())
            if dr.grad_enabled(parameters):
                found = [Known(k.center, integral.attached(k)) for k in around]
            else:
                of_member = (made_of, Fingerprint(parameters))
                found = cache.of_numbers((self, "integral", member), around, of_member, integral.detached)
            integrals.append([integral.moving(k, p_o) for k, p_o in zip(found, observers)])
        return ObservedGaze(self, place, settings, integrals)

    def unnormalized(
        self, member: GazeDensity, p_od: Point3f, p_o: Point3f, r_o: Vector3f, active: Bool, escaped: Bool = False
    ) -> tuple[Float, Float]:
        """``(emit, capture)`` of one ``member`` for scene points: what an integral is made of, and no density."""
        local = self.to_world
        return member.unnormalized(
            local.point_to_local(p_od),
            local.point_to_local(p_o),
            local.direction_to_local(r_o),
            active,
            escaped=escaped,
        )


@dataclass(frozen=True)
class _SphereIntegral:
    """The integral of one ``member`` of the ``placed`` field over the sphere around observers (``cache.Known``, with
    their ``AllAround``) in ``place``."""

    placed: PlacedGaze
    member: GazeDensity
    place: Place
    settings: ObserverSettings

    def detached(self, known: Known) -> Float:
        """Its value (one lane)."""
        if recording():
            with dr.suspend_grad():
                return self.attached(known)
        return dr.opaque(type(known.center.x), self._integrate(known).value)

    def attached(self, known: Known) -> Float:
        """The same with derivatives. What is recorded to be replayed elsewhere is summed over all directions."""
        count = self.settings.directions if recording() else self._integrate(known).directions
        return dr.mean(self._integrand(known, self._around(known, count))) * (4 * dr.pi)

    def moving(self, known: Known, p_o: Point3f) -> Known:
        """``known``, an integral, with the derivatives of its observer at ``p_o``, where that has any: central
        differences of sums over the same directions, since what hides something moves with the observer."""
        if not dr.grad_enabled(p_o):
            return known
        h = STEP * self.placed.to_world.scale * self.placed.field.box.side
        count = min(MOVING, self.settings.directions)

        def log_integral(center: Point3f) -> Float:
            dr.make_opaque(center)
            there = Known(center, AllAround())
            return dr.log(dr.mean(self._integrand(there, self._around(there, count))))

        with dr.suspend_grad():
            axes = [type(known.center)(*(h if i == k else 0 for i in range(3))) for k in range(3)]
            slopes = [(log_integral(known.center + e) - log_integral(known.center - e)) / (2 * h) for e in axes]
            slope = type(known.center)(*slopes)
            dr.make_opaque(slope)
        return Known(known.center, known.value * dr.exp(dr.dot(slope, p_o - dr.detach(p_o))))

    def _integrate(self, known: Known) -> Integral:
        def numbered(count: int) -> np.ndarray:
            around = self._around(known, count)
            with dr.suspend_grad():
                found = self._integrand(known, around).numpy()
            if around.number is None:
                return found
            values = np.empty_like(found)
            values[around.number] = found
            return values

        return integrate(numbered, self.settings.directions, self.settings.integral_tolerance)

    def _around(self, known: Known, count: int) -> Surroundings:
        placed = self.placed
        return known.value.of(count, placed.field, placed.to_world, self.place, known.center, self.settings)

    def _integrand(self, known: Known, around: Surroundings) -> Float:
        o = known.center + dr.zeros(type(known.center), dr.width(around.directions))
        emit, capture = self.placed.unnormalized(
            self.member, o + around.directions * around.distance, o, around.directions, True, around.escaped
        )
        return emit * capture + dr.zeros(type(around.distance), dr.width(around.distance))


class ObservedGaze:
    """A gaze field for the observers that ``PlacedGaze.at`` was given, for as long as its weights and the place are
    those of then. It holds no directions, only numbers: many of them may be kept."""

    def __init__(self, placed: PlacedGaze, place: Place, settings: ObserverSettings, integrals: list[list[Known]]):
        self._placed, self._place, self._settings, self._integrals = placed, place, settings, integrals

    def parameters(self) -> list:
        """Arrays that gaze depends on, for derivatives."""
        return self._placed.parameters()

    @property
    def made_of(self) -> tuple:
        """What densities depend on besides the place and the observers, comparable with ``==``."""
        return self._placed, self._settings, Fingerprint(self.parameters())

    def integrals(self, p_o: Point3f) -> list[Float]:
        """Of each member the integral over the sphere of that observer who is nearest to ``p_o``, lane by lane;
        empty for a field that is not normalised."""
        return [select_nearest(known, p_o, lambda value: value) for known in self._integrals]

    def evaluate(
        self,
        p_od: Point3f,
        p_o: Point3f,
        r_o: Vector3f,
        active: Bool,
        semantic: list[Float] | None = None,
        escaped: Bool = False,
    ) -> tuple[Float, Float, Float]:
        """``(gaze, emit, capture)`` in 1/sr of observers at ``p_o`` attending ``p_od`` along unit ``r_o`` (scene points
        and direction, a lane each). Of an ensemble the means.

        ``semantic``: features in place of those that the place has; ``escaped``: directions in which no surface is met.
        """
        return mean(self._each(p_od, p_o, r_o, active, semantic, escaped))

    def spread(
        self,
        p_od: Point3f,
        p_o: Point3f,
        r_o: Vector3f,
        active: Bool,
        semantic: list[Float] | None = None,
        escaped: Bool = False,
    ) -> tuple[Float, Float, Float, Float]:
        """``evaluate`` of an ensemble, and the standard deviation of its members' gaze (1/sr)."""
        found = self._each(p_od, p_o, r_o, active, semantic, escaped)
        return *mean(found), spread(found)

    def along(self, p_o: Point3f, r_o: Vector3f) -> Float:
        """Density (1/sr) of the observer at ``p_o`` (one lane) in unit directions ``r_o``, carrying no derivatives.

        On surfaces it is what the integrator shows there, and elsewhere what the field was trained to be."""
        return mean([(gaze,) for gaze in self.members_along(p_o, r_o)])[0]

    def members_along(self, p_o: Point3f, r_o: Vector3f) -> list[Float]:
        """``along`` of each member of an ensemble by itself; of one field that alone."""
        return self._look(p_o, r_o)[0]

    def look(self, p_o: Point3f, r_o: Vector3f, filling: Filling | None = None) -> tuple[list[Float], Float]:
        """``members_along``, and the distance of the surface that is met along each, infinite where there is none.
        ``filling``: that of the observer, if it has been traced."""
        import mitsuba as mi

        found, distance, escaped = self._look(p_o, r_o, filling)
        if not self._placed.field.config.needs_surfaces:
            with dr.suspend_grad():
                met, distance = met_along(self._place, mi.Point3f(dr.detach(p_o)), r_o, self._settings)
                escaped = ~met
        return found, dr.select(escaped, dr.inf, distance)

    def _look(self, p_o: Point3f, r_o: Vector3f, filling: Filling | None = None) -> tuple[list[Float], Float, Bool]:
        """``(gaze of each member, distance, escaped)``, the last two as of ``surroundings.distance_along``."""
        import mitsuba as mi

        with dr.suspend_grad():
            center = mi.Point3f(dr.detach(p_o))
            dr.make_opaque(center)
            placed, width = self._placed, dr.width(r_o)
            distance, escaped = distance_along(
                placed.field, placed.to_world, self._place, center, r_o, self._settings, filling
            )
            o = center + dr.zeros(mi.Point3f, width)
            everywhere = dr.full(mi.Bool, True, width)
            found = self._each(o + r_o * distance, o, r_o, everywhere, None, escaped)
            # A constant variant returns one lane for all.
            return [gaze + dr.zeros(mi.Float, width) for gaze, *_ in found], distance, escaped

    def _each(
        self, p_od: Point3f, p_o: Point3f, r_o: Vector3f, active: Bool, semantic: list[Float] | None, escaped: Bool
    ) -> list[tuple]:
        """``(gaze, emit, capture)`` of each member."""
        field, local = self._placed.field, self._placed.to_world
        if semantic is None:
            march = self._settings.march
            semantic = observed_features(field.config.semantic, self._place, p_od, p_o, r_o, active, march)
        integrals = self.integrals(p_o) or [None] * len(field.members)
        return [
            member.evaluate(
                local.point_to_local(p_od),
                local.point_to_local(p_o),
                local.direction_to_local(r_o),
                active,
                semantic,
                integral,
                escaped,
            )
            for member, integral in zip(field.members, integrals)
        ]
