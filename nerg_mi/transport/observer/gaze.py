"""A gaze field in the scene, and what it says of observers.

A field alone cannot be evaluated for an observer: a normalised one must be divided by its integral over the observer's
sphere, which depends on where they stand, and one with semantic features needs those of the place. So a ``PlacedGaze``
has no densities; ``at`` gives an ``ObservedGaze``, which has.
"""

from __future__ import annotations

import drjit as dr

from nerg_mi.field.gaze.ensemble import mean, spread
from nerg_mi.field.gaze.protocol import AnyGazeField, GazeDensity
from nerg_mi.maths.similarity import Similarity
from nerg_mi.maths.types import Bool, Float, Point3f, Vector3f
from nerg_mi.transport.features import observed_features
from nerg_mi.transport.fingerprint import Fingerprint
from nerg_mi.transport.place import Place

from .cache import Known, ObserverCache, fingerprint_of
from .settings import ObserverSettings
from .surroundings import Surroundings, distance_along, trace_surroundings
from .viewpoint import select_nearest


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

        A normalised field is integrated over the sphere around each observer, in ``settings.directions``; the depths
        carry no derivatives, the integral has those of the field's parameters. A field that is not normalised is the
        same for all observers. ``cache``: where depths and integrals are kept.
        """
        if not self.field.config.normalized:
            return ObservedGaze(self, place, settings, [])
        if not observers:
            raise ValueError("a gaze field that is normalised over the observer's sphere needs to know the observers")
        cache = cache or ObserverCache()
        made_of = (fingerprint_of(place), settings.surfaces, settings.directions)
        around = cache.of_each(
            (self, "surroundings"),
            observers,
            made_of,
            lambda center: trace_surroundings(self.field, self.to_world, place, center, settings),
        )
        integrals = [self._integrals(member, around, made_of, cache) for member in self.field.members]
        return ObservedGaze(self, place, settings, integrals)

    def _integrals(self, member: GazeDensity, around: list[Known], made_of: tuple, cache: ObserverCache) -> list[Known]:
        """Of one ``member``, for each observer; members agree on what they need to know of the surroundings."""
        parameters = list(member.parameters().values())
        if dr.grad_enabled(parameters):
            return [Known(k.center, self._integral(member, k.center, k.value)) for k in around]

        def integrate(k: Known) -> Float:
            with dr.suspend_grad():
                value = self._integral(member, k.center, k.value)
                dr.eval(value)
            return value

        return cache.of_known((self, "integral", member), around, (made_of, Fingerprint(parameters)), integrate)

    def _integral(self, member: GazeDensity, center: Point3f, around: Surroundings) -> Float:
        """The integral (one lane) of ``member`` over what is ``around`` the observer at ``center``."""
        o = center + dr.zeros(type(center), dr.width(around.directions))
        emit, capture = self.unnormalized(
            member, o + around.directions * around.distance, o, around.directions, True, around.escaped
        )
        return dr.mean(emit * capture + dr.zeros(type(around.distance), dr.width(around.distance))) * (4 * dr.pi)

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


class ObservedGaze:
    """A gaze field for the observers that ``PlacedGaze.at`` was given, for as long as its weights and the place are
    those of then. It holds no directions, only numbers: many of them may be kept."""

    def __init__(self, placed: PlacedGaze, place: Place, settings: ObserverSettings, integrals: list[list[Known]]):
        self._placed, self._place, self._settings, self._integrals = placed, place, settings, integrals

    def parameters(self) -> list:
        """Arrays that gaze depends on, for derivatives."""
        return self._placed.parameters()

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
        import mitsuba as mi

        with dr.suspend_grad():
            center = mi.Point3f(dr.detach(p_o))
            dr.make_opaque(center)
            placed, width = self._placed, dr.width(r_o)
            distance, escaped = distance_along(placed.field, placed.to_world, self._place, center, r_o, self._settings)
            o = center + dr.zeros(mi.Point3f, width)
            everywhere = dr.full(mi.Bool, True, width)
            found = self._each(o + r_o * distance, o, r_o, everywhere, None, escaped)
            # A constant variant returns one lane for all.
            return [gaze + dr.zeros(mi.Float, width) for gaze, *_ in found]

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
