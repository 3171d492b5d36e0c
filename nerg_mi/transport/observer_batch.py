"""Densities of a gaze field for many observers: their integrals over the sphere share kernel launches."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import drjit as dr
import numpy as np

from nerg_mi.fields.gaze_hits import ObservedHits
from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.arrays import copy_aligned, to_vector
from nerg_mi.maths.sphere import fibonacci_directions_jit, morton_order
from nerg_mi.maths.types import Bool, Float, Point3f, UInt32, Vector3f, variant_types

from .field_medium import features_for_observer
from .geometry import SceneGeometry
from .observer import ObserverSettings
from .observer_gaze import (
    MISS_DIRECTIONS,
    GazeFieldInstance,
    MissDepths,
    ObserverTracer,
    first_direction_count,
    next_direction_count,
    sum_spheres,
)

# `GazeFieldInstance.for_observers` serves few observers and many directions: each observer has its own launches and its
# cached sphere samples. Samples of a recording are the opposite, with about as many observers as directions. A launch
# for the 4,096 directions of one observer leaves most of its time to overhead, so that here one launch traces the
# directions of many observers. The sums are those of `integrate_sphere` for each of them.

RAYS_PER_LAUNCH = 1 << 18
"""Rays per kernel launch."""

# An integral over the sphere averages over the errors of single depths. If its tolerance is at least _COARSE_TOLERANCE,
# its rays are therefore marched in longer steps, to a transmittance that hardly moves the median. In the demo store
# this halves the time and changes integrals by .1 % (root mean square).
_COARSE_STEP, _COARSE_STOP, _COARSE_TOLERANCE = 3.0, 0.05, 0.01

_OBSERVERS_PER_BLOCK = 256
"""Observers whose depths for escaped rays are held at the same time, 32 KiB each."""


@dataclass(frozen=True)
class _Lanes:
    """Rays of several observers: the points at which a field is evaluated, in scene units."""

    p_o: Point3f
    r_o: Vector3f
    distance: Float
    escaped: Bool

    @property
    def p_od(self) -> Point3f:
        return self.p_o + self.r_o * self.distance


def evaluate_densities(
    instance: GazeFieldInstance,
    geometry: SceneGeometry,
    settings: ObserverSettings,
    origins: np.ndarray,
    directions: np.ndarray,
    on_progress: Callable[[int, int], None] = lambda done, count: None,
) -> np.ndarray:
    """Density of each ray for an observer at its origin, without derivatives.

    The values are those of `ObservedGaze.evaluate_members_along`.

    Parameters
    ----------
    instance : GazeFieldInstance
        The gaze field in the scene.
    geometry : SceneGeometry
        What the observers see.
    settings : ObserverSettings
        Settings of the observers' rays; ``integral_tolerance`` is that of the integral of a normalised field.
    origins, directions : ndarray of shape (N, 3)
        Positions in scene units, and unit directions. A normalised field is integrated once per distinct position.
    on_progress : callable, optional
        Called with the numbers of finished and of all distinct positions.

    Returns
    -------
    ndarray of shape (members, N), float32
        Density in 1/sr for each member of an ensemble; a single field has one member.
    """
    config = instance.field.config
    origins = np.ascontiguousarray(origins, np.float32)
    observers, observer_of_ray = np.unique(origins, axis=0, return_inverse=True)
    order = np.argsort(observer_of_ray.ravel(), kind="stable")
    ends = np.cumsum(np.bincount(observer_of_ray.ravel(), minlength=len(observers)))
    per_observer = config.normalized or config.fills_escaped
    size = _OBSERVERS_PER_BLOCK if per_observer else len(observers)
    density = np.empty((len(instance.field.members), len(origins)), np.float32)
    with dr.suspend_grad():
        for start in range(0, len(observers), size):
            end = min(start + size, len(observers))
            block = _Block(instance, geometry, settings, observers[start:end])
            rays = order[ends[start - 1] if start else 0 : ends[end - 1]]
            density[:, rays] = block.evaluate(observer_of_ray.ravel()[rays] - start, directions[rays])
            on_progress(end, len(observers))
    return density


class _Block:
    """Some observers at ``positions`` (M, 3), and what is computed once for each."""

    def __init__(
        self, instance: GazeFieldInstance, geometry: SceneGeometry, settings: ObserverSettings, positions: np.ndarray
    ):
        mi = variant_types()
        self._instance, self._geometry, self._settings = instance, geometry, settings
        self._sphere_settings = _coarsen(settings, geometry)
        self._positions, self._count = to_vector(mi.Point3f, positions), len(positions)
        self._miss_depths: list[MissDepths] = []
        if instance.field.config.needs_surfaces and instance.field.config.fills_escaped:
            self._miss_depths = list(self._trace_miss_depths())
        self._integrals = self._integrate() if instance.field.config.normalized else None
        self._hits: ObservedHits | None = None
        if instance.field.hits is not None:
            local = np.array(instance.to_world.point_to_local(self._positions), np.float64).T
            self._hits = instance.field.hits.observe(local, namespace(self._positions.x))

    def evaluate(self, observer: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Densities (members, N) of the observers with indices ``observer`` (N,), sorted, in ``directions`` (N, 3)."""
        mi = variant_types()
        parts = []
        for start in range(0, len(observer), RAYS_PER_LAUNCH):
            rows = slice(start, start + RAYS_PER_LAUNCH)
            index = observer[rows]
            tracer = self._tracer(mi.UInt32(copy_aligned(index, np.uint32)), self._settings)
            lanes = self._trace(tracer, to_vector(mi.Vector3f, directions[rows]), index)
            values = [self._evaluate_member(k, lanes, index) for k in range(len(self._instance.field.members))]
            dr.eval(values)
            parts.append(np.stack([np.array(value) for value in values]))
        return np.concatenate(parts, axis=1)

    def _evaluate_member(self, number: int, lanes: _Lanes, observer: np.ndarray) -> Float:
        mi, field, local = variant_types(), self._instance.field, self._instance.to_world
        active = dr.full(mi.Bool, True, len(observer))
        march = self._settings.march
        semantic = features_for_observer(
            field.config.semantic, self._geometry, lanes.p_od, lanes.p_o, lanes.r_o, active, march
        )
        integral = None if self._integrals is None else mi.Float(copy_aligned(self._integrals[number, observer]))
        gaze, *_ = field.members[number].evaluate(
            local.point_to_local(lanes.p_od),
            local.point_to_local(lanes.p_o),
            local.direction_to_local(lanes.r_o),
            active,
            semantic,
            integral,
            lanes.escaped,
        )
        # A constant variant returns one lane.
        gaze = gaze + dr.zeros(mi.Float, len(observer))
        if self._hits is None or field.hits is None:
            return gaze
        position, direction = local.point_to_local(lanes.p_o), local.direction_to_local(lanes.r_o)
        return field.hits.mix(
            gaze, self._hits.density(direction, position, mi.UInt32(copy_aligned(observer, np.uint32)))
        )

    def _integrate(self) -> np.ndarray:
        """Integrals (members, M) over the sphere."""
        settings, members = self._settings, self._instance.field.members
        integrals = np.empty((len(members), self._count))
        first = first_direction_count(settings.directions, settings.integral_tolerance)
        # Pairs of member and observer that still need a sum, by its number of directions.
        pending = {first: np.ones((len(members), self._count), bool)}
        while pending:
            count = min(pending)
            unfinished = pending.pop(count)
            observers = np.flatnonzero(unfinished.any(axis=0))
            for index, values in self._integrands(observers, count):
                for number in range(len(members)):
                    for observer, integral in zip(index, sum_spheres(values[number])):
                        if not unfinished[number, observer]:
                            continue
                        integrals[number, observer] = integral.value
                        if count < settings.directions and integral.error > settings.integral_tolerance:
                            larger = next_direction_count(integral, settings.directions, settings.integral_tolerance)
                            pending.setdefault(larger, np.zeros_like(unfinished))[number, observer] = True
        return integrals

    def _integrands(self, observers: np.ndarray, count: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """The integrands (members, n, count) of some ``observers`` after the other, in the order of the spiral, with
        the indices (n,) of these observers."""
        mi, members = variant_types(), self._instance.field.members
        order = morton_order(count)
        for index, observer, direction in _launches(observers, count):
            directions = fibonacci_directions_jit(count, dr.gather(mi.UInt32, mi.UInt32(order), direction))
            tracer = self._tracer(observer, self._sphere_settings)
            lanes = self._trace(tracer, directions, np.repeat(index, count) if self._miss_depths else None)
            values = []
            for member in members:
                emit, capture = self._instance.unnormalized(
                    member, lanes.p_od, lanes.p_o, lanes.r_o, True, lanes.escaped
                )
                values.append(emit * capture + dr.zeros(mi.Float, dr.width(lanes.r_o)))
            dr.eval(values)
            integrand = np.empty((len(members), len(index), count), np.float32)
            for row, value in zip(integrand, values):
                row[:, order] = np.array(value).reshape(len(index), count)
            yield index, integrand

    def _trace(self, tracer: ObserverTracer, directions: Vector3f, index: np.ndarray | None) -> _Lanes:
        """Trace rays; ``index``: those of their observers, sorted, if escaped rays take the depths of their
        neighbours."""
        dr.eval(directions)
        if not self._miss_depths:
            distance, escaped = tracer.trace_distances(directions)
        else:
            assert index is not None
            has_surface, distance = tracer.trace_surfaces(directions, ends_at_box=True)
            dr.eval(has_surface, distance)
            depth, missed, vectors = np.array(distance), ~np.array(has_surface), np.array(directions).T
            starts = np.flatnonzero(np.diff(index, prepend=-1))
            for start, end in zip(starts, [*starts[1:], len(index)]):
                rows = slice(start, end)
                self._miss_depths[index[start]].fill(depth[rows], missed[rows], vectors[rows])
            distance, escaped = variant_types().Float(depth), ~has_surface
        dr.eval(distance, escaped)
        return _Lanes(tracer.center, directions, distance, escaped)

    def _trace_miss_depths(self) -> Iterator[MissDepths]:
        vectors = np.array(fibonacci_directions_jit(MISS_DIRECTIONS)).T
        for index, observer, direction in _launches(np.arange(self._count), MISS_DIRECTIONS):
            directions = fibonacci_directions_jit(MISS_DIRECTIONS, direction)
            tracer = self._tracer(observer, self._sphere_settings)
            has_surface, distance = tracer.trace_surfaces(directions, ends_at_box=True)
            dr.eval(has_surface, distance)
            shape = len(index), MISS_DIRECTIONS
            for mask, depth in zip(np.array(has_surface).reshape(shape), np.array(distance).reshape(shape)):
                yield MissDepths(vectors[mask], depth[mask])

    def _tracer(self, observer: UInt32, settings: ObserverSettings) -> ObserverTracer:
        """A tracer of the rays of the observers with indices ``observer``."""
        center = dr.gather(variant_types().Point3f, self._positions, observer)
        dr.eval(center)
        return ObserverTracer(self._instance, self._geometry, center, settings)


def _coarsen(settings: ObserverSettings, geometry: SceneGeometry) -> ObserverSettings:
    """Return the settings of the rays of an integral over the sphere to ``settings.integral_tolerance``."""
    if geometry.medium is None or settings.integral_tolerance < _COARSE_TOLERANCE:
        return settings
    march = settings.march
    # A longer step could pass over the voxels of a grid.
    factor = 1.0 if geometry.medium.cells is not None else _COARSE_STEP
    coarse = replace(
        march, step=factor * march.step, dt_gamma=factor * march.dt_gamma, stop=max(march.stop, _COARSE_STOP)
    )
    return replace(settings, march=coarse)


def _launches(observers: np.ndarray, count: int) -> Iterator[tuple[np.ndarray, UInt32, UInt32]]:
    """Groups of ``observers`` with ``count`` rays each: their indices, and for each ray that of its observer and its
    own (UInt32)."""
    mi = variant_types()
    size = max(1, RAYS_PER_LAUNCH // count)
    for start in range(0, len(observers), size):
        index = observers[start : start + size]
        ray = dr.arange(mi.UInt32, len(index) * count)
        # Opaque, so that the numbers of directions share kernels.
        per_observer = dr.opaque(mi.UInt32, count)
        yield (
            index,
            dr.gather(mi.UInt32, mi.UInt32(copy_aligned(index, np.uint32)), ray // per_observer),
            ray % per_observer,
        )
