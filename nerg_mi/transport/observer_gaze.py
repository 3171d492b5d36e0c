"""An observer's gaze as a density over directions: its integral with an error estimate, and the surroundings."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

import drjit as dr
import numpy as np

from nerg_mi.fields.gaze_base import AnyGazeField, GazeHead, mean, spread
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.geometry import Similarity, intersect_box
from nerg_mi.maths.sphere import fibonacci_vectors, neighbourly_order
from nerg_mi.maths.types import Bool, Float, Point3f, Vector3f, variant_types

from .field_medium import observed_features
from .geometry import SceneGeometry
from .jit import Fingerprint, recording
from .observer import Known, ObserverCache, ObserverSettings, fingerprint_of, select_nearest

# ---- The integral over an observer's sphere, in as many directions as its error asks for ----
#
# What an observer looks at jumps where a surface hides another one. For sums over points that are spread as evenly as
# can be, the error of such integrands falls with the number of points to the power of -3/4 (Beck 1984, for caps of the
# sphere; Aistleitner, Brauchart & Dick 2012 for these points), which tells the error of a sum from the scatter of sums
# over parts of its points.

FIRST = 1 << 13
"""Directions that are tried first for a tolerance of `USUAL`, which they mostly keep; fewer for a wider one, `FEWEST`
at least."""

USUAL, FEWEST = 5e-3, 1 << 11
ERROR_PARTS = 8
"""Parts of a sum whose scatter tells its error. Every eighth point of a golden spiral lies on one too, of eight times
the angle, and no rounder; parts err in opposite ways more often than not, so that the error is told too large, by two
or three times in the mean."""

ERROR_EXPONENT = 0.75
"""Of the number of points, with which the error of a sum over them falls."""


@dataclass(frozen=True)
class Integral:
    """``value``: of the sum over ``directions``; ``error``: the one that it is likely to have at most, as a share."""

    value: float
    directions: int
    error: float


def integrate(values: Callable[[int], np.ndarray], most: int, tolerance: float) -> Integral:
    """The integral of what ``values(count)`` (count,) are in that many directions of equal area, as
    `maths.sphere.fibonacci_directions` numbers them: over as few as err by ``tolerance``, a share of it, or over
    ``most``."""
    first = FIRST >> max(0, math.floor(math.log2(tolerance / USUAL) / ERROR_EXPONENT)) if tolerance > 0 else most
    count = min(max(first, FEWEST), most)
    while True:
        found = _sum(values(count))
        if count == most or found.error <= tolerance:
            return found
        # What is told falls nearly as their number grows.
        times = min(found.error / tolerance, most / count)
        count = min(most, count << max(math.ceil(math.log2(times)), 1))


def _sum(values: np.ndarray) -> Integral:
    values = np.asarray(values, np.float64)
    mean = float(values.mean())
    parts = [values[k::ERROR_PARTS].mean() for k in range(min(ERROR_PARTS, len(values)))]
    scatter = float(np.std(parts, ddof=1)) if len(parts) > 1 else math.inf
    error = scatter * ERROR_PARTS**-ERROR_EXPONENT / abs(mean) if mean else math.inf if scatter else 0.0
    return Integral(4 * math.pi * mean, len(values), error)


# ---- Surroundings ----
#
# What an observer meets in every direction: over which a gaze field is integrated.

_FILL = 1 << 14
"""Directions whose depths fill those that escape. Always the same: filled from its own directions, an integral of more
of them would be another one, by up to some per cent where half of them escape."""


_ORDERED = 1 << 20
"""More directions than these are traced in the order in which they are numbered."""


@dataclass(frozen=True)
class ObserverSurroundings:
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
        self._traced: dict[int, ObserverSurroundings] = {}
        self.filling: Filling | None = None
        """What fills directions that escape, once that has been asked for."""

    def of(self, count: int, outlook: ObserverTracer) -> ObserverSurroundings:
        """Those in ``count`` directions; ``outlook``: always the observer's."""
        if count not in self._traced:
            if outlook.field.config.fills_escaped and self.filling is None:
                self.filling = outlook.trace_filling()
            self._traced[count] = outlook.trace(count, self.filling)
        return self._traced[count]


@dataclass(frozen=True)
class Filling:
    """What fills the directions that escape: those ``directions`` (N, 3) in which a surface is met, ``distance`` (N,)
    away."""

    directions: np.ndarray
    distance: np.ndarray


@dataclass(frozen=True, eq=False)
class ObserverTracer:
    """What the observer at ``center`` (one lane) meets in ``place``, traced with ``settings``, where ``field``, which
    ``to_world`` places in the scene, is to be evaluated."""

    field: AnyGazeField
    to_world: Similarity
    place: SceneGeometry
    center: Point3f
    settings: ObserverSettings

    def trace(self, count: int | None = None, filling: Filling | None = None) -> ObserverSurroundings:
        """The surroundings in ``count`` directions (None: ``settings.directions``); ``filling``: see
        ``distance_along``."""
        count = count or self.settings.directions
        # A recording takes no arrays from NumPy.
        number = None if recording() or count > _ORDERED else neighbourly_order(count)
        with dr.suspend_grad():
            directions = fibonacci_vectors(count, None if number is None else variant_types().UInt32(number))
            distance, escaped = self.distance_along(directions, filling)
            dr.eval(directions, distance, escaped)
        return ObserverSurroundings(directions, distance, escaped, number)

    def distance_along(self, directions: Vector3f, filling: Filling | None = None) -> tuple[Float, Bool]:
        """``(distance, escaped)`` as of ``ObserverSurroundings`` along unit ``directions``: where the field is to be
        evaluated, also where there is no surface. What escapes ends on the field's box, or at the depth of the nearest
        directions that do not, as the field wants it: of ``filling``, if it has been traced."""
        mi = variant_types()
        width = dr.width(directions)
        if not self.field.config.needs_surfaces:
            return dr.ones(mi.Float, width), dr.full(mi.Bool, False, width)
        met, depth = self.met_along(directions, self._beyond(directions))
        if self.field.config.fills_escaped:
            escaped = ~np.array(met)
            if escaped.any():
                known = filling or self.trace_filling()
                if len(known.distance):
                    depth = np.array(depth)
                    depth[escaped] = interpolate_nearest_depth(known.directions, known.distance, np.array(directions).T[escaped])
                    depth = mi.Float(depth)
        return depth, ~met

    def trace_filling(self) -> Filling:
        """What fills directions that escape."""
        few = fibonacci_vectors(_FILL)
        with dr.suspend_grad():
            traced = self.met_along(few, self._beyond(few))
        known, distance = (np.array(v) for v in traced)
        return Filling(np.array(few).T[known], distance[known])

    def met_along(self, directions: Vector3f, beyond: Float | float = 0.0) -> tuple[Bool, Float]:
        """Whether a surface is met along unit ``directions`` (lanes), and its distance in scene units; ``beyond`` where
        none is."""
        mi, settings = variant_types(), self.settings
        everywhere = dr.full(mi.Bool, True, dr.width(directions))
        view = self.place.trace(mi.Ray3f(self.center, directions), everywhere, settings.march)
        met = everywhere & view.has_surface(settings.surface_opacity)
        return met, cast("Float", dr.select(met, view.depth(settings.depth, met), beyond))

    def _beyond(self, directions: Vector3f) -> Float:
        """Where a ray that meets nothing ends: on the gaze field's box, or its diagonal away."""
        box, local = self.field.box, self.to_world
        o, d = local.point_to_local(self.center), local.vector_to_local(directions)
        near, far = intersect_box(o, d, box.lower, box.upper)
        return dr.select((near < far) & (far > 0) & dr.isfinite(far), far, box.diagonal * local.scale)


def interpolate_nearest_depth(known: np.ndarray, depth: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Depth in directions ``wanted`` (M, 3) from that of the up to eight nearest of ``known`` (N, 3): the mean of its
    logarithm, weighted by the inverse square of the distance."""
    from scipy.spatial import KDTree

    # The leaf decides which of directions that are equally far are among the eight.
    apart, which = KDTree(known, leafsize=16).query(wanted, k=np.arange(1, min(8, len(known)) + 1))  # pyright: ignore[reportArgumentType] SciPy takes several
    weight = 1 / (apart**2 + 1e-3)
    log = np.log(np.maximum(depth, 1e-6))[which]
    return np.exp((weight * log).sum(axis=1) / weight.sum(axis=1)).astype(np.float32)


# ---- A gaze field in the scene, and what it says of observers ----
#
# A field alone cannot be evaluated for an observer: a normalised one must be divided by its integral over the
# observer's sphere, which depends on where they stand, and one with semantic features needs those of the place. So a
# ``GazeFieldInstance`` has no densities; ``at`` gives an ``ObservedGaze``, which has.

STEP = 1 / 256
"""How far an observer is moved for the derivatives of an integral, of the side of the field's box: edges that pass
then are many directions apart."""

MOVING = 1 << 15
"""Directions of these integrals at most."""


class GazeFieldInstance:
    """``field`` placed in the scene by ``to_world`` (field to scene); neither is replaced afterwards."""

    def __init__(self, field: AnyGazeField, to_world: Similarity | None = None):
        self.field, self.to_world = field, to_world or Similarity()

    def parameters(self) -> list:
        """Arrays that gaze depends on, for derivatives."""
        return list(self.field.parameters().values())

    def make_tracer(self, place: SceneGeometry, center: Point3f, settings: ObserverSettings) -> ObserverTracer:
        """What the observer at ``center`` (one lane) meets where the field is to be evaluated for them."""
        return ObserverTracer(self.field, self.to_world, place, center, settings)

    def for_observers(
        self, observers: list[Point3f], place: SceneGeometry, settings: ObserverSettings, cache: ObserverCache | None = None
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
        around = cache.get_or_compute_each((self, "surroundings"), observers, made_of, lambda center: AllAround())
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
        self,
        member: GazeHead,
        p_od: Point3f,
        p_o: Point3f,
        r_o: Vector3f,
        active: Bool | bool,
        escaped: Bool | bool = False,
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
    """The integral of one ``member`` of the ``placed`` field over the sphere around observers (``observer.Known``, with
    their ``AllAround``) in ``place``."""

    placed: GazeFieldInstance
    member: GazeHead
    place: SceneGeometry
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

    def _around(self, known: Known, count: int) -> ObserverSurroundings:
        return known.value.of(count, self.placed.make_tracer(self.place, known.center, self.settings))

    def _integrand(self, known: Known, around: ObserverSurroundings) -> Float:
        o = known.center + dr.zeros(type(known.center), dr.width(around.directions))
        emit, capture = self.placed.unnormalized(
            self.member, o + around.directions * around.distance, o, around.directions, True, around.escaped
        )
        return emit * capture + dr.zeros(type(around.distance), dr.width(around.distance))


class ObservedGaze:
    """A gaze field for the observers that ``GazeFieldInstance.at`` was given, for as long as its weights and the place are
    those of then. It holds no directions, only numbers: many of them may be kept."""

    def __init__(self, placed: GazeFieldInstance, place: SceneGeometry, settings: ObserverSettings, integrals: list[list[Known]]):
        self._placed, self._place, self._settings, self._integrals = placed, place, settings, integrals

    @property
    def field(self) -> AnyGazeField:
        return self._placed.field

    def parameters(self) -> list:
        """Arrays that gaze depends on, for derivatives."""
        return self._placed.parameters()

    @property
    def dependencies(self) -> tuple:
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
        escaped: Bool | bool = False,
    ) -> tuple[Float, Float, Float]:
        """``(gaze, emit, capture)`` in 1/sr of observers at ``p_o`` attending ``p_od`` along unit ``r_o`` (scene points
        and direction, a lane each). Of an ensemble the means.

        ``semantic``: features in place of those that the place has; ``escaped``: directions in which no surface is met.
        """
        return mean(self._each(p_od, p_o, r_o, active, semantic, escaped))

    def evaluate_with_std(self, p_od: Point3f, p_o: Point3f, r_o: Vector3f, active: Bool) -> tuple[Float, Float, Float, Float]:
        """``evaluate`` of an ensemble, and the standard deviation of its members' gaze (1/sr)."""
        found = self._each(p_od, p_o, r_o, active)
        gaze, emit, capture = mean(found)
        return gaze, emit, capture, spread(found)

    def evaluate_along(self, p_o: Point3f, r_o: Vector3f) -> Float:
        """Density (1/sr) of the observer at ``p_o`` (one lane) in unit directions ``r_o``, carrying no derivatives.

        On surfaces it is what the integrator shows there, and elsewhere what the field was trained to be."""
        return mean([(gaze,) for gaze in self.evaluate_members_along(p_o, r_o)])[0]

    def evaluate_members_along(self, p_o: Point3f, r_o: Vector3f) -> list[Float]:
        """``along`` of each member of an ensemble by itself; of one field that alone."""
        return self._look(p_o, r_o)[0]

    def evaluate_with_distance(self, p_o: Point3f, r_o: Vector3f, filling: Filling | None = None) -> tuple[list[Float], Float]:
        """``evaluate_members_along``, and the distance of the surface that is met along each, infinite where there is none.
        ``filling``: that of the observer, if it has been traced."""
        found, distance, escaped = self._look(p_o, r_o, filling)
        if not self._placed.field.config.needs_surfaces:
            with dr.suspend_grad():
                center = variant_types().Point3f(dr.detach(p_o))
                met, distance = self._placed.make_tracer(self._place, center, self._settings).met_along(r_o)
                escaped = ~met
        return found, dr.select(escaped, dr.inf, distance)

    def _look(self, p_o: Point3f, r_o: Vector3f, filling: Filling | None = None) -> tuple[list[Float], Float, Bool]:
        """``(gaze of each member, distance, escaped)``, the last two as of ``ObserverTracer.distance_along``."""
        mi = variant_types()
        with dr.suspend_grad():
            center = mi.Point3f(dr.detach(p_o))
            dr.make_opaque(center)
            width = dr.width(r_o)
            distance, escaped = self._placed.make_tracer(self._place, center, self._settings).distance_along(r_o, filling)
            o = center + dr.zeros(mi.Point3f, width)
            everywhere = dr.full(mi.Bool, True, width)
            found = self._each(o + r_o * distance, o, r_o, everywhere, None, escaped)
            # A constant variant returns one lane for all.
            return [gaze + dr.zeros(mi.Float, width) for gaze, *_ in found], distance, escaped

    def _each(
        self,
        p_od: Point3f,
        p_o: Point3f,
        r_o: Vector3f,
        active: Bool,
        semantic: list[Float] | None = None,
        escaped: Bool | bool = False,
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


# ---- Looking ----
#
# An observer who looks around: their gaze along any directions, and the surfaces that they meet there.


# Directions of the integral of a normalised field, at most: of one field it cancels out of shares of the gaze, and of
# an ensemble only the members' weights beside each other rest on it.
_INTEGRAL = 2048


def make_gaze_evaluator(
    gaze: GazeFieldInstance, place: SceneGeometry, settings: ObserverSettings, eye: np.ndarray
) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """A function of unit directions (N, 3): the gaze (M, N) of the observer at ``eye`` (3,), in proportion to 1/sr, by
    each of M members of an ensemble or by one field, and the distance (N,) of the first surface, infinite where there
    is none; in scene units."""
    mi = variant_types()
    settings = replace(settings, directions=min(settings.directions, _INTEGRAL))
    center = mi.Point3f(np.asarray(eye, np.float64).tolist())
    # A position that is a constant of the kernel would be compiled anew for every observer.
    dr.make_opaque(center)
    cache = ObserverCache()
    observed = gaze.for_observers([center], place, settings, cache)
    around = cache.peek((gaze, "surroundings"))
    filling = around[0].value.filling if around else None

    def look(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found, distance = observed.evaluate_with_distance(center, to_vector(mi.Vector3f, directions), filling)
        dr.eval(found, distance)
        lanes = lambda v: np.broadcast_to(np.array(v, np.float64), (len(directions),))
        return np.array([lanes(g) for g in found]), lanes(distance)

    return look
