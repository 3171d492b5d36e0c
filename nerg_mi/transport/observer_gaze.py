"""Gaze of an observer as a density over directions: the integral over the sphere, and samples of what surrounds
them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import GazeHead, GazeNetwork, mean_over_members, std_over_members
from nerg_mi.fields.gaze_hits import ObservedHits
from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.geometry import Similarity, intersect_box
from nerg_mi.maths.sphere import fibonacci_directions_jit, morton_order
from nerg_mi.maths.types import Bool, Float, Point3f, Vector3f, variant_types

from .depth import DEPTHS
from .field_medium import FieldMedium, features_for_observer
from .geometry import SceneGeometry
from .jit import Fingerprint, is_recording
from .observer import CacheEntry, ObserverCache, ObserverSettings, fingerprint_geometry, select_nearest
from .quadrature import RULES
from .recording import NotRecordable, Recorder
from .splat_medium import SplatMedium
from .volume_medium import VolumeMedium

# ---- Integral over an observer's sphere, with an error estimate ----
#
# The gaze of an observer is discontinuous where one surface hides another. For point sets that are as even as possible,
# the error of such integrals decreases with the number of points to the power of -3/4 (Beck 1984, for spherical caps;
# Aistleitner, Brauchart & Dick 2012 for these points). The scatter of partial sums therefore estimates the error of the
# full sum.

FIRST_DIRECTIONS = 1 << 13
"""Directions of the first attempt for a tolerance of `USUAL_TOLERANCE`, usually sufficient; fewer for a larger
tolerance, at least `MIN_DIRECTIONS`."""

USUAL_TOLERANCE, MIN_DIRECTIONS = 5e-3, 1 << 10
ERROR_PARTS = 8
"""Partial sums whose scatter estimates the error. Every eighth point of a golden spiral lies on a spiral of eight times
the angle, which is less even, and the errors of the parts are often of opposite sign; the error is therefore
overestimated, by a factor of two to three on average."""

ERROR_EXPONENT = 0.75
"""Exponent of the number of points with which the error of a sum decreases."""


@dataclass(frozen=True)
class SphereIntegral:
    """``value``: the integral, from ``directions`` points; ``error``: an estimate of its maximum relative error."""

    value: float
    directions: int
    error: float


def integrate_sphere(values: Callable[[int], np.ndarray], max_directions: int, tolerance: float) -> SphereIntegral:
    """Integrate over the sphere with as few directions as the tolerance allows.

    Parameters
    ----------
    values : callable
        ``values(count)``: the integrand (count,) in that many directions of equal area, numbered as by
        `maths.sphere.fibonacci_directions`.
    max_directions : int
        Maximum number of directions.
    tolerance : float
        Relative error at which the sum ends; 0: use ``max_directions``.
    """
    count = first_direction_count(max_directions, tolerance)
    while True:
        integral = sum_sphere(values(count))
        if count == max_directions or integral.error <= tolerance:
            return integral
        count = next_direction_count(integral, max_directions, tolerance)


def first_direction_count(max_directions: int, tolerance: float) -> int:
    """Directions of the first attempt of `integrate_sphere`."""
    count = (
        FIRST_DIRECTIONS >> max(0, round(math.log2(tolerance / USUAL_TOLERANCE) / ERROR_EXPONENT))
        if tolerance > 0
        else max_directions
    )
    return min(max(count, MIN_DIRECTIONS), max_directions)


def next_direction_count(integral: SphereIntegral, max_directions: int, tolerance: float) -> int:
    """Directions of the attempt of `integrate_sphere` that follows ``integral``, whose error exceeds the tolerance."""
    # The estimated error decreases almost in proportion to the number of directions.
    factor = min(integral.error / tolerance, max_directions / integral.directions)
    return min(max_directions, integral.directions << max(math.ceil(math.log2(factor)), 1))


def sum_sphere(values: np.ndarray) -> SphereIntegral:
    """The integral of ``values`` (N,) in N directions of equal area, in the order of the spiral."""
    return sum_spheres(np.asarray(values)[None])[0]


def sum_spheres(values: np.ndarray) -> list[SphereIntegral]:
    """The integrals of M functions, each with its ``values`` (M, N) as for `sum_sphere`."""
    count = values.shape[1]
    parts = [values[:, k::ERROR_PARTS].mean(axis=1, dtype=np.float64) for k in range(min(ERROR_PARTS, count))]
    sizes = [len(range(k, count, ERROR_PARTS)) for k in range(len(parts))]
    means = np.average(parts, axis=0, weights=sizes)
    scatters = np.std(parts, axis=0, ddof=1) if len(parts) > 1 else np.full(len(values), math.inf)
    integrals = []
    for mean, scatter in zip(means.tolist(), scatters.tolist()):
        error = scatter * ERROR_PARTS**-ERROR_EXPONENT / abs(mean) if mean else math.inf if scatter else 0.0
        integrals.append(SphereIntegral(4 * math.pi * mean, count, error))
    return integrals


# ---- Sphere samples ----
#
# The surfaces around an observer in all directions, over which a gaze field is integrated.

MISS_DIRECTIONS = 1 << 11
"""Directions whose depths replace those of rays that escape. A fixed number: depths taken from an integral's own
directions would make the integral depend on their number, by several per cent where half of the rays escape."""


_MAX_ORDERED = 1 << 20
"""Up to this number, directions are traced along a space-filling curve; beyond it in the order of their indices."""


@dataclass(frozen=True)
class SphereSamples:
    """Samples of the sphere around an observer. Evaluated, detached.

    ``directions``: unit vectors of equal area; ``distance``: distance of the surface along each, in scene units;
    ``escaped``: whether the ray meets no surface; ``indices`` (N,): index of each direction on the spiral, None if they
    are in its order.
    """

    directions: Vector3f
    distance: Float
    escaped: Bool
    indices: np.ndarray | None = None


class SphereSampleCache:
    """The sphere samples of one observer, by the number of directions."""

    def __init__(self) -> None:
        self._traced: dict[int, SphereSamples] = {}
        self.miss_depths: MissDepths | None = None
        """Depths for rays that escape, once they have been traced."""

    def get(self, count: int, tracer: ObserverTracer) -> SphereSamples:
        """The samples in ``count`` directions; ``tracer``: always that of the observer."""
        if count not in self._traced:
            if tracer.placed.field.config.fills_escaped and self.miss_depths is None:
                self.miss_depths = tracer.trace_miss_depths()
            self._traced[count] = tracer.trace(count, self.miss_depths)
        return self._traced[count]


@dataclass(frozen=True)
class MissDepths:
    """Depths for rays that escape: the ``directions`` (N, 3) with a surface, and its ``distance`` (N,)."""

    directions: np.ndarray
    distance: np.ndarray

    def fill(self, depth: np.ndarray, escaped: np.ndarray, directions: np.ndarray) -> None:
        """Replace ``depth`` (M,) of ``directions`` (M, 3) where ``escaped`` (M,); unchanged if all rays escape."""
        if len(self.distance) and escaped.any():
            depth[escaped] = interpolate_nearest_depth(self.directions, self.distance, directions[escaped])


@dataclass(frozen=True, eq=False)
class ObserverTracer:
    """Traces the rays of the observer at ``center`` (one lane, or one per ray) through ``geometry`` with ``settings``,
    to the points at which the field ``placed`` in the scene is evaluated."""

    placed: GazeFieldInstance
    geometry: SceneGeometry
    center: Point3f
    settings: ObserverSettings
    recorder: Recorder | None = None

    def trace(self, count: int | None = None, miss_depths: MissDepths | None = None) -> SphereSamples:
        """Sphere samples in ``count`` directions (default: ``settings.directions``); ``miss_depths``: see
        `trace_distances`."""
        count = count or self.settings.directions
        # A function that dr.freeze records cannot contain arrays of NumPy.
        number = None if is_recording() or count > _MAX_ORDERED else morton_order(count)
        with dr.suspend_grad():
            directions = fibonacci_directions_jit(count, None if number is None else variant_types().UInt32(number))
            distance, escaped = self.trace_distances(directions, miss_depths)
            dr.eval(directions, distance, escaped)
        return SphereSamples(directions, distance, escaped, number)

    def trace_distances(self, directions: Vector3f, miss_depths: MissDepths | None = None) -> tuple[Float, Bool]:
        """``(distance, escaped)`` along unit ``directions``, as in `SphereSamples`: where the field is evaluated.

        A ray that escapes ends on the field's bounding box or, if the field requires it, at the depth of the nearest
        directions with a surface: those of ``miss_depths`` if they have been traced.
        """
        mi = variant_types()
        width = dr.width(directions)
        if not self.placed.field.config.needs_surfaces:
            return dr.ones(mi.Float, width), dr.full(mi.Bool, False, width)
        has_surface, depth = self.trace_surfaces(directions, ends_at_box=True)
        if self.placed.field.config.fills_escaped:
            escaped = ~np.array(has_surface)
            if escaped.any():
                depth = np.array(depth)
                filled = miss_depths or self.trace_miss_depths()
                filled.fill(depth, escaped, np.array(directions).T)
                depth = mi.Float(depth)
        return depth, ~has_surface

    def trace_miss_depths(self) -> MissDepths:
        """Trace the depths for rays that escape."""
        directions = fibonacci_directions_jit(MISS_DIRECTIONS)
        with dr.suspend_grad():
            results = self.trace_surfaces(directions, ends_at_box=True)
        has_surface, distance = (np.array(v) for v in results)
        return MissDepths(np.array(directions).T[has_surface], distance[has_surface])

    def trace_surfaces(self, directions: Vector3f, ends_at_box: bool = False) -> tuple[Bool, Float]:
        """Whether there is a surface along unit ``directions``, and its distance in scene units; without one
        `miss_distance` if ``ends_at_box``, else 0."""

        seen = self.geometry.seen_from(self.center, dr.width(directions))

        def trace() -> tuple[Bool, Float]:
            mi, settings = variant_types(), self.settings
            all_lanes = dr.full(mi.Bool, True, dr.width(directions))
            ray_hit = seen.trace(mi.Ray3f(self.center, directions), all_lanes, settings.march)
            has_surface = all_lanes & ray_hit.has_surface(settings.surface_opacity)
            end = self.miss_distance(directions) if ends_at_box else 0
            depth = dr.select(has_surface, ray_hit.depth(settings.depth, has_surface), end)
            return has_surface, cast("Float", depth)

        if self.recorder is None:
            return trace()
        rules = [RULES.find(self.settings.march.quadrature), DEPTHS.find(self.settings.depth)]
        frame = [self.placed.field.box, self.placed.to_world]
        list_inputs = lambda: [*list_geometry_inputs(seen), self.center, self.settings, *rules, *frame]
        key = "surfaces", dr.width(directions), ends_at_box
        return self.recorder.run(trace, key, list_inputs, [directions])

    def miss_distance(self, directions: Vector3f) -> Float:
        """End of a ray without a surface: on the bounding box of the gaze field, or at a distance of its diagonal."""
        box, local = self.placed.field.box, self.placed.to_world
        o, d = local.point_to_local(self.center), local.vector_to_local(directions)
        near, far = intersect_box(o, d, box.lower, box.upper)
        return dr.select((near < far) & (far > 0) & dr.isfinite(far), far, box.diagonal * local.scale)


def interpolate_nearest_depth(directions: np.ndarray, depth: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Interpolate depth from the up to eight nearest directions: the mean of its logarithm, weighted by inverse squared
    distance.

    ``directions`` (N, 3) with ``depth`` (N,); ``queries`` (M, 3). Returns (M,).
    """
    from scipy.spatial import KDTree

    # The leaf size decides which of equally distant directions are among the eight. An unbalanced tree is built faster.
    tree = KDTree(directions, leafsize=16, balanced_tree=False, compact_nodes=False)
    distance, neighbours = tree.query(queries, k=np.arange(1, min(8, len(directions)) + 1))  # pyright: ignore[reportArgumentType] SciPy takes several
    weight = 1 / (distance**2 + 1e-3)
    log = np.log(np.maximum(depth, 1e-6))[neighbours]
    return np.exp((weight * log).sum(axis=1) / weight.sum(axis=1)).astype(np.float32)


# ---- A gaze field in the scene ----
#
# A gaze field alone cannot be evaluated for an observer: a normalised one is divided by its integral over the
# observer's sphere, which depends on the position, and one with semantic features needs those of the radiance field.
# `GazeFieldInstance` therefore has no densities; `GazeFieldInstance.for_observers` returns an `ObservedGaze`, which
# has.

DIFFERENCE_STEP = 1 / 256
"""Displacement of the observer for finite differences of an integral, as a fraction of the edge of the field's box:
large enough that occlusion edges move by many directions."""

MAX_DIFFERENCE_DIRECTIONS = 1 << 15
"""Maximum number of directions of these integrals."""


class GazeFieldInstance:
    """``field`` placed in the scene by ``to_world`` (field to scene); both are fixed."""

    def __init__(self, field: GazeNetwork, to_world: Similarity | None = None):
        self.field, self.to_world = field, to_world or Similarity()

    def parameters(self) -> list:
        """Arrays that gaze depends on, for derivatives."""
        return list(self.field.parameters().values())

    def for_observers(
        self,
        observers: list[Point3f],
        geometry: SceneGeometry,
        settings: ObserverSettings,
        cache: ObserverCache | None = None,
    ) -> ObservedGaze:
        """The field for ``observers`` (scene points, one lane each) in ``geometry``, traced with ``settings``.

        A normalised field is integrated over the sphere around each observer, to ``settings.integral_tolerance``.
        Depths carry no derivatives; the integral carries those of the field's parameters and of the observers'
        positions. A field that is not normalised is the same for all observers.

        Parameters
        ----------
        cache : ObserverCache, optional
            Keeps depths and integrals. Default: a temporary one.
        """
        if not self.field.config.normalized:
            return ObservedGaze(self, geometry, settings, [])
        if not observers:
            raise ValueError("a gaze field that is normalised over the observer's sphere needs at least one observer")
        if self.field.hits is not None and is_recording():
            raise NergError(
                "dr.freeze cannot record a gaze field with re-aimed hits, whose neighbours are found outside of "
                "kernels; set its property reaimed_hits to false"
            )
        cache = cache or ObserverCache()
        made_of = (fingerprint_geometry(geometry), settings.surface_settings)
        samples = cache.get_or_compute_each(
            (self, "surroundings"), observers, made_of, lambda center: SphereSampleCache()
        )
        depends_on = (*made_of, settings.directions, settings.integral_tolerance)
        integrals = []
        for member in self.field.members:
            integrator = _MemberIntegrator(self, member, geometry, settings, cache.recorder)
            parameters = list(member.parameters().values())
            if dr.grad_enabled(parameters):
                entries = [CacheEntry(k.center, integrator.integrate_with_derivatives(k)) for k in samples]
            else:
                of_member = (depends_on, Fingerprint(parameters))
                entries = cache.get_or_compute_scalar(
                    (self, "integral", member), samples, of_member, integrator.integrate
                )
            integrals.append([integrator.attach_to_position(k, p_o) for k, p_o in zip(entries, observers)])
        hits = []
        if (reaimed := self.field.hits) is not None:

            def observe(center: Point3f) -> ObservedHits:
                position = np.array(self.to_world.point_to_local(center), np.float64).ravel()
                return reaimed.observe(position, namespace(center.x))

            hits = cache.get_or_compute_each((self, "hits"), observers, reaimed, observe)
        return ObservedGaze(self, geometry, settings, integrals, hits)

    def unnormalized(
        self,
        member: GazeHead,
        p_od: Point3f,
        p_o: Point3f,
        r_o: Vector3f,
        active: Bool | bool,
        escaped: Bool | bool = False,
    ) -> tuple[Float, Float]:
        """``(emit, capture)`` of one ``member`` at scene points: the factors of the integrand, not a density."""
        local = self.to_world
        return member.unnormalized(
            local.point_to_local(p_od),
            local.point_to_local(p_o),
            local.direction_to_local(r_o),
            active,
            escaped=escaped,
        )


@dataclass(frozen=True)
class _MemberIntegrator:
    """The integral of one ``member`` of the ``placed`` field over the sphere around observers in ``geometry``.

    Observers are `CacheEntry` objects with a `SphereSampleCache`.
    """

    placed: GazeFieldInstance
    member: GazeHead
    geometry: SceneGeometry
    settings: ObserverSettings
    recorder: Recorder | None = None

    def integrate(self, entry: CacheEntry) -> Float:
        """The value of the integral (one lane)."""
        if is_recording():
            with dr.suspend_grad():
                return self.integrate_with_derivatives(entry)
        return dr.opaque(type(entry.center.x), self._integrate(entry).value)

    def integrate_with_derivatives(self, entry: CacheEntry) -> Float:
        """The same with derivatives. A recorded function, which is replayed with other values, sums over all
        directions."""
        count = self.settings.directions if is_recording() else self._integrate(entry).directions
        return dr.mean(self._integrand(entry, self._around(entry, count))) * (4 * dr.pi)

    def attach_to_position(self, entry: CacheEntry, p_o: Point3f) -> CacheEntry:
        """Attach the integral to the position ``p_o`` of its observer, if that carries gradients.

        Central differences of sums over the same directions: occlusion moves with the observer.
        """
        if not dr.grad_enabled(p_o):
            return entry
        h = DIFFERENCE_STEP * self.placed.to_world.scale * self.placed.field.box.side
        count = min(MAX_DIFFERENCE_DIRECTIONS, self.settings.directions)

        def log_integral(center: Point3f) -> Float:
            dr.make_opaque(center)
            displaced = CacheEntry(center, SphereSampleCache())
            return dr.log(dr.mean(self._integrand(displaced, self._around(displaced, count))))

        with dr.suspend_grad():
            axes = [type(entry.center)(*(h if i == k else 0 for i in range(3))) for k in range(3)]
            slopes = [(log_integral(entry.center + e) - log_integral(entry.center - e)) / (2 * h) for e in axes]
            slope = type(entry.center)(*slopes)
            dr.make_opaque(slope)
        return CacheEntry(entry.center, entry.value * dr.exp(dr.dot(slope, p_o - dr.detach(p_o))))

    def _integrate(self, entry: CacheEntry) -> SphereIntegral:
        def eval_in_order(count: int) -> np.ndarray:
            samples = self._around(entry, count)
            with dr.suspend_grad():
                integrand = self._integrand(entry, samples).numpy()
            if samples.indices is None:
                return integrand
            values = np.empty_like(integrand)
            values[samples.indices] = integrand
            return values

        return integrate_sphere(eval_in_order, self.settings.directions, self.settings.integral_tolerance)

    def _around(self, entry: CacheEntry, count: int) -> SphereSamples:
        tracer = ObserverTracer(self.placed, self.geometry, entry.center, self.settings, self.recorder)
        return entry.value.get(count, tracer)

    def _integrand(self, entry: CacheEntry, samples: SphereSamples) -> Float:
        if self.recorder is None:
            return self._evaluate_integrand(entry, samples)

        def list_inputs() -> list[Any]:
            require_listed_networks(self.member)
            return [self.placed, self.member]

        key, arrays = ("integrand", dr.width(samples.directions)), [entry.center, samples.directions]
        arrays += [samples.distance, samples.escaped]
        return self.recorder.run(lambda: self._evaluate_integrand(entry, samples), key, list_inputs, arrays)

    def _evaluate_integrand(self, entry: CacheEntry, samples: SphereSamples) -> Float:
        o = entry.center + dr.zeros(type(entry.center), dr.width(samples.directions))
        emit, capture = self.placed.unnormalized(
            self.member, o + samples.directions * samples.distance, o, samples.directions, True, samples.escaped
        )
        return emit * capture + dr.zeros(type(samples.distance), dr.width(samples.distance))


class ObservedGaze:
    """A gaze field for given observers, valid while its weights and the geometry are unchanged. It holds no directions,
    only one number per observer and member."""

    def __init__(
        self,
        placed: GazeFieldInstance,
        geometry: SceneGeometry,
        settings: ObserverSettings,
        integrals: list[list[CacheEntry]],
        hits: Sequence[CacheEntry] = (),
    ):
        self._instance, self._geometry, self._settings, self._integrals = placed, geometry, settings, integrals
        self._hits = list(hits)

    @property
    def field(self) -> GazeNetwork:
        return self._instance.field

    def parameters(self) -> list:
        """Arrays that gaze depends on, for derivatives."""
        return self._instance.parameters()

    @property
    def dependencies(self) -> tuple:
        """What densities depend on besides the geometry and the observers, comparable with ``==``."""
        return self._instance, self._settings, Fingerprint(self.parameters())

    def prepare(self, lanes: int) -> None:
        """Compute what the evaluation of ``lanes`` directions reads, which a recorded branch cannot compute."""
        for entry in self._hits:
            entry.value.prepare(lanes // len(self._hits))
        if len(self._hits) > 1 and not self._is_tabulated:
            _ = self._merged_hits

    def integrals(self, p_o: Point3f) -> list[Float]:
        """For each member the integral over the sphere of the observer nearest to ``p_o``, lane by lane; empty for a
        field that is not normalised."""
        return [select_nearest(entries, p_o, lambda value: value) for entries in self._integrals]

    def evaluate(
        self,
        p_od: Point3f,
        p_o: Point3f,
        r_o: Vector3f,
        active: Bool,
        semantic: list[Float] | None = None,
        escaped: Bool | bool = False,
    ) -> tuple[Float, Float, Float]:
        """``(gaze, emit, capture)`` in 1/sr for observers at ``p_o`` who look at ``p_od`` along unit ``r_o``.

        Parameters
        ----------
        p_od, p_o, r_o : Point3f, Point3f, Vector3f
            Scene points and unit direction, one lane per observer.
        semantic : list of Float, optional
            Semantic features. Default: those of the radiance field.
        escaped : Bool
            Directions without a surface.

        Returns
        -------
        tuple of Float
            For an ensemble the means over its members.
        """
        return mean_over_members(self._each(p_od, p_o, r_o, active, semantic, escaped))

    def evaluate_with_std(
        self, p_od: Point3f, p_o: Point3f, r_o: Vector3f, active: Bool
    ) -> tuple[Float, Float, Float, Float]:
        """`evaluate`, followed by the standard deviation of gaze over the members of an ensemble (1/sr)."""
        values = self._each(p_od, p_o, r_o, active)
        gaze, emit, capture = mean_over_members(values)
        return gaze, emit, capture, std_over_members(values)

    def evaluate_along(self, p_o: Point3f, r_o: Vector3f) -> Float:
        """Density (1/sr) for the observer at ``p_o`` (one lane) in unit directions ``r_o``, without derivatives.

        On surfaces it equals what the integrator shows; elsewhere it is what the field was trained to be.
        """
        return mean_over_members([(gaze,) for gaze in self.evaluate_members_along(p_o, r_o)])[0]

    def evaluate_members_along(self, p_o: Point3f, r_o: Vector3f) -> list[Float]:
        """`evaluate_along` for each member of an ensemble; a list of one for a single field."""
        return self._look(p_o, r_o)[0]

    def evaluate_with_distance(
        self, p_o: Point3f, r_o: Vector3f, miss_depths: MissDepths | None = None
    ) -> tuple[list[Float], Float]:
        """`evaluate_members_along`, and the distance of the surface in each direction, infinite where there is no
        surface.

        ``miss_depths``: depths for directions without a surface, from `ObserverTracer.trace_miss_depths`; None traces
        them if the field needs them.
        """
        gaze, distance, escaped = self._look(p_o, r_o, miss_depths)
        if not self._instance.field.config.needs_surfaces:
            with dr.suspend_grad():
                center = variant_types().Point3f(dr.detach(p_o))
                tracer = ObserverTracer(self._instance, self._geometry, center, self._settings)
                has_surface, distance = tracer.trace_surfaces(r_o)
                escaped = ~has_surface
        return gaze, dr.select(escaped, dr.inf, distance)

    def _look(
        self, p_o: Point3f, r_o: Vector3f, miss_depths: MissDepths | None = None
    ) -> tuple[list[Float], Float, Bool]:
        """``(gaze of each member, distance, escaped)``, the last two as in `ObserverTracer.trace_distances`."""
        mi = variant_types()
        with dr.suspend_grad():
            center = mi.Point3f(dr.detach(p_o))
            dr.make_opaque(center)
            width = dr.width(r_o)
            tracer = ObserverTracer(self._instance, self._geometry, center, self._settings)
            distance, escaped = tracer.trace_distances(r_o, miss_depths)
            o = center + dr.zeros(mi.Point3f, width)
            all_lanes = dr.full(mi.Bool, True, width)
            values = self._each(o + r_o * distance, o, r_o, all_lanes, None, escaped)
            # A constant variant returns one lane.
            return [gaze + dr.zeros(mi.Float, width) for gaze, *_ in values], distance, escaped

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
        field, local = self._instance.field, self._instance.to_world
        if semantic is None:
            march = self._settings.march
            semantic = features_for_observer(field.config.semantic, self._geometry, p_od, p_o, r_o, active, march)
        integrals = self.integrals(p_o) or [None] * len(field.members)
        p_od, position, direction = (
            local.point_to_local(p_od),
            local.point_to_local(p_o),
            local.direction_to_local(r_o),
        )
        values = [
            member.evaluate(p_od, position, direction, active, semantic, integral, escaped)
            for member, integral in zip(field.members, integrals)
        ]
        if field.hits is None:
            return values
        hits = self._evaluate_hits(p_o, position, direction)
        return [(field.hits.mix(gaze, hits), *factors) for gaze, *factors in values]

    def _evaluate_hits(self, p_o: Point3f, position: Point3f, direction: Vector3f) -> Float:
        """Density of the re-aimed hits of the observer nearest to ``p_o``, lane by lane."""
        if len(self._hits) == 1:
            return self._hits[0].value.density(direction, position)
        if not dr.flag(dr.JitFlag.SymbolicScope):
            self.prepare(dr.width(direction))
        # Without tables and for derivatives each lane reads the samples of its own observer only.
        if self._is_tabulated and not dr.grad_enabled(position, direction):
            return select_nearest(self._hits, p_o, lambda observed: observed.density(direction, position))
        index = select_nearest([CacheEntry(e.center, k) for k, e in enumerate(self._hits)], p_o, variant_types().UInt32)
        return self._merged_hits.density(direction, position, index + dr.zeros(type(index), dr.width(direction)))

    @property
    def _is_tabulated(self) -> bool:
        return all(entry.value.is_tabulated for entry in self._hits)

    @cached_property
    def _merged_hits(self) -> ObservedHits:
        return ObservedHits.merge([entry.value for entry in self._hits])


def require_listed_networks(field: Any) -> None:
    """Raise `NotRecordable` unless a recording knows what ``field`` reads: it lists its networks.

    Registered fields of other packages need not list theirs, and may read what is no attribute.
    """
    networks = getattr(field, "mlps", None)
    if networks is None:
        raise NotRecordable("networks that a field does not list")
    for net in networks:
        if net.has_constant_weights:
            # They belong to the key of a recording, which cannot read them.
            net.get_constants()


def list_geometry_inputs(geometry: SceneGeometry) -> list[Any]:
    """All that rays through ``geometry`` read, for a recording. Raises `NotRecordable`."""
    medium = geometry.medium
    if isinstance(medium, FieldMedium):
        require_listed_networks(medium.field)
    elif not (medium is None or isinstance(medium, (SplatMedium, VolumeMedium))):
        raise NotRecordable(f"a {type(medium).__name__}")
    # Without a medium, tolerances depend on the size of the shapes.
    return [geometry, geometry.shape_diagonal if medium is None and geometry.scene is not None else None]


# ---- Gaze of one observer in arbitrary directions ----


# Maximum number of directions of the integral: for a single field it cancels in relative attention, for an ensemble it
# only affects the relative weights of the members.
_MAX_INTEGRAL_DIRECTIONS = 2048


def make_gaze_evaluator(
    gaze: GazeFieldInstance, geometry: SceneGeometry, settings: ObserverSettings, observer: np.ndarray
) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """A function of unit directions (N, 3) for one observer.

    Parameters
    ----------
    observer : array (3,)
        Position in scene units.

    Returns
    -------
    callable
        Returns the gaze (M, N) of each of M members, proportional to 1/sr, and the distance (N,) of the first surface
        in scene units, infinite without one.
    """
    mi = variant_types()
    settings = replace(settings, directions=min(settings.directions, _MAX_INTEGRAL_DIRECTIONS))
    center = mi.Point3f(np.asarray(observer, np.float64).tolist())
    # A literal position would compile a new kernel for each observer.
    dr.make_opaque(center)
    cache = ObserverCache()
    observed = gaze.for_observers([center], geometry, settings, cache)
    entries = cache.peek((gaze, "surroundings"))
    miss_depths = entries[0].value.miss_depths if entries else None

    def evaluate(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values, distance = observed.evaluate_with_distance(center, to_vector(mi.Vector3f, directions), miss_depths)
        dr.eval(values, distance)
        lanes = lambda v: np.broadcast_to(np.array(v, np.float64), (len(directions),))
        return np.array([lanes(g) for g in values]), lanes(distance)

    return evaluate
