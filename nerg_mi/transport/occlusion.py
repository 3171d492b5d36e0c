"""Occlusion of surfaces from an observer: visibility, depth maps around the observer, and tracing towards points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.maths.types import Bool, Float, Point3f, Ray3f, Vector3f, variant_types

from .depth import DEPTHS
from .geometry import RayHit, SceneGeometry, shape_corners
from .march_primal import OcclusionQuery
from .observer import ObserverCache, ObserverSettings, distance_and_direction, fingerprint_geometry
from .observer_gaze import ObservedGaze

# ---- Visibility ----
#
# Whether an observer sees a point: the shadow factor of the paper, with its sign corrected.
#
# The section "Surface Visibility and Gaze Occlusion" of the paper compares the depth d_o of the surface along the
# observer's ray with the distance d_o* to the point. s = clip((d_o* - d_o - tol) / d_f, 0, 1) is 1 if a surface lies in
# between; gaze is multiplied by the visibility 1 - s. (The paper multiplies by s, which would show gaze only where it
# is hidden.)


def visibility(d_expected: Float, d_observed: Float, falloff: Float, tolerance: Float | float) -> Float:
    """Visibility of a point: 1 visible, 0 hidden.

    Parameters
    ----------
    d_expected, d_observed : Float
        d_o*, the distance to the point, and d_o, the depth of the surface along the observer's ray; in scene units.
    falloff : Float
        d_f >= 0, in scene units; 0: a step function.
    tolerance : Float or float
        How much nearer than the point its own surface can be, in scene units.
    """
    excess = d_expected - d_observed - tolerance
    sharp = falloff <= 0
    soft = dr.clip(excess / dr.select(sharp, 1, falloff), 0, 1)
    return 1 - dr.select(sharp, dr.select(excess > 0, 1.0, 0.0), soft)


# ---- Depth map around an observer ----
#
# A latitude-longitude map of depth, and of gaze, that is computed once per observer. A point is compared with the four
# nearest entries, and the results of the comparisons are interpolated (percentage-closer filtering, Reeves et al.
# 1987); interpolated depths would lie between surfaces.


class ObserverDepthMap:
    """Depths around ``center`` (one lane) in scene units, infinite without a surface; ``2 height`` x ``height``
    entries.

    Detached: gradients do not pass through the map. Rows run from +z to -z, columns from azimuth 0; entries are at
    pixel centres.
    """

    UNRECORDED = ("center",)  # As of `CacheEntry`

    def __init__(self, geometry: SceneGeometry, center: Point3f, settings: ObserverSettings):
        mi = variant_types()
        self.height, self.width, self.center = settings.map_height, 2 * settings.map_height, center
        self._float, self._uint, self._vector = mi.Float, mi.UInt32, mi.Vector3f
        with dr.suspend_grad():
            all_lanes = dr.full(mi.Bool, True, self.width * self.height)
            seen = geometry.seen_from(self.center, self.width * self.height)
            ray_hit = seen.trace(mi.Ray3f(self.center, self._directions()), all_lanes, settings.march)
            has_surface = ray_hit.has_surface(settings.surface_opacity)
            self.depth = dr.select(has_surface, ray_hit.depth(settings.depth, has_surface), dr.inf)
            dr.eval(self.depth)

    def make_gaze_table(self, gaze: ObservedGaze) -> Float:
        """The density of ``gaze`` for each entry with a surface, 0 for the others."""
        with dr.suspend_grad():
            r_o = self._directions()
            has_surface = dr.isfinite(self.depth)
            p_od = self.center + r_o * dr.select(has_surface, self.depth, 0)
            table = dr.select(has_surface, gaze.evaluate(p_od, self.center, r_o, has_surface)[0], 0)
            dr.eval(table)
        return table

    @property
    def spacing(self) -> float:
        """Angle between neighbouring entries in radian."""
        return dr.pi / self.height

    def _directions(self) -> Vector3f:
        index = dr.arange(self._uint, self.width * self.height)
        Float = self._float
        phi = (Float(index % self.width) + 0.5) * self.spacing
        theta = (Float(index // self.width) + 0.5) * self.spacing
        sin_theta, cos_theta = dr.sincos(theta)
        sin_phi, cos_phi = dr.sincos(phi)
        return self._vector(sin_theta * cos_phi, sin_theta * sin_phi, cos_theta)

    def eval_visibility(
        self, r_o: Vector3f, distance: Float, falloff: Float, tolerance: Float | float, active: Bool
    ) -> tuple[Float, Float]:
        """``(nearest depth, visibility)`` of points at ``distance`` along unit ``r_o`` from the centre."""
        Float = type(distance)
        seen, nearest, best = Float(0), Float(dr.inf), Float(-1)
        for entry, weight in self._entries(r_o, distance):
            depth = dr.gather(Float, self.depth, entry, active)
            seen += weight * visibility(distance, depth, falloff, tolerance)
            closer = weight > best
            nearest, best = dr.select(closer, depth, nearest), dr.select(closer, weight, best)
        return nearest, seen

    def eval_gaze(
        self, table: Float, r_o: Vector3f, distance: Float, falloff: Float, slack: Float | float, active: Bool
    ) -> Float:
        """Density of a ``table`` from `make_gaze_table` on the surface along unit ``r_o``, for points at ``distance``.

        Negative where the map has no value: an entry that is farther than the point by more than ``slack`` belongs to
        another surface.
        """
        Float = type(distance)
        total, total_weight = Float(0), Float(0)
        for entry, weight in self._entries(r_o, distance):
            depth = dr.gather(Float, self.depth, entry, active)
            weight *= visibility(distance, depth, falloff, slack)
            weight = dr.select(depth < distance + slack, weight, 0)
            total += weight * dr.gather(Float, table, entry, active)
            total_weight += weight
        return dr.select(total_weight > 0, total / dr.select(total_weight > 0, total_weight, 1), -1)

    def _entries(self, r_o, distance):
        """The four entries around the direction ``r_o``, and their bilinear weights."""
        Float, UInt32 = type(distance), self._uint
        r_o = dr.detach(r_o)
        theta = dr.atan2(dr.sqrt(r_o.x * r_o.x + r_o.y * r_o.y), r_o.z)
        x = dr.atan2(r_o.y, r_o.x) / self.spacing - 0.5
        y = dr.clip(theta / self.spacing - 0.5, 0, self.height - 1)
        x = dr.select(x < 0, x + self.width, x)
        i, j = UInt32(x), dr.minimum(UInt32(y), self.height - 1)
        fx, fy = x - Float(i), y - Float(j)
        for dj in (0, 1):
            for di in (0, 1):
                row, column = dr.minimum(j + dj, self.height - 1), (i + di) % self.width
                yield column + self.width * row, (fx if di else 1 - fx) * (fy if dj else 1 - fy)


# ---- Tracing from an observer who is not at the camera ----
#
# The second depth pass of the paper: a ray from the observer to the camera's surface point p_d is traced for its own
# depth d_o, which is compared with the distance d_o* (see `visibility`).


# An entry of a map sees the surface of a point if it lies at most this multiple of the point's offset behind it.
_MAX_OFFSETS_BEHIND = 4
# Ray casts agree on a shape to this fraction of the scene's diagonal, or of twice the coordinates there: distant
# objects do not affect the accuracy of near intersections, except through the size of their triangles.
RELATIVE_TOLERANCE, _FAR = 1e-4, 3e-7
MAX_TOLERANCE = 1e18
"""Maximum tolerance in scene units: the square of a distance of this length is finite in single precision."""


@dataclass
class ObserverHit:
    """What an observer sees towards a point; distances in scene units."""

    # The surface that the observer sees.
    p_od: Point3f
    # d_o; the distance to the point if there is no surface.
    depth: Float
    # 1 visible, 0 hidden.
    visibility: Float
    # Density evaluations; None unless counted.
    density_evals: Float | None
    # Gaze density from a map, negative where the map has no value; None without a map.
    gaze: Float | None = None


def trace_from_observer(
    geometry: SceneGeometry,
    ray: Ray3f,
    p_d: Point3f,
    p_o: Point3f,
    penetration: Float | float,
    active: Bool,
    falloff: Float,
    settings: ObserverSettings,
    *,
    count: bool = False,
    observer_map: ObserverMap | None = None,
    needs_depth: bool = True,
    num_rays: int = 0,
) -> ObserverHit:
    """Trace from the observer at ``p_o`` towards the surface point ``p_d`` that the camera sees on ``ray``.

    The target lies slightly in front of the surface, towards the camera: by the tolerance and the ``penetration`` of
    light into the surface. A surface then does not hide itself even at grazing angles, since the ray stays above it. A
    tolerance along the observer's ray alone would have to grow without bound.

    Parameters
    ----------
    falloff : Float
        d_f in scene units.
    count : bool
        Count density evaluations.
    observer_map : ObserverMap, optional
        The map around ``p_o``, if visibility is decided by a map. Default: a temporary one, without gaze.
    needs_depth : bool
        Whether the depth and the surface are needed even where visibility is 0 or 1 without them. If false, rays may
        end early, and the returned depth is only on the correct side of the point.
    num_rays : int
        Rays of this observer in all calls; default: those of this call.
    """
    tolerance = _tolerance(geometry, ray, p_d, p_o, settings)
    offset = tolerance + penetration
    if settings.visibility == "map":
        # Entries of a map are this far apart at the end of the ray, and depths on slopes differ by as much.
        spacing = dr.norm(p_d - p_o) * (dr.pi / settings.map_height)
        offset += spacing
        tolerance = tolerance + spacing
    distance, r_o = distance_and_direction(p_o, p_d - ray.d * offset)
    density = None

    if settings.visibility == "map":
        observer_map = observer_map or get_observer_map(geometry, p_o, settings, None, ObserverCache())
        depth_map, table = observer_map.depths, observer_map.gaze
        observed_depth, visible = depth_map.eval_visibility(r_o, distance, falloff, tolerance, active)
        if table is not None:
            # Of the surface itself: the target in front of it lies in another direction.
            surface_distance, r_d = distance_and_direction(p_o, p_d)
            density = depth_map.eval_gaze(table, r_d, surface_distance, falloff, _MAX_OFFSETS_BEHIND * offset, active)
        evals = type(distance)(0)
    else:
        to_point = variant_types().Ray3f(p_o, r_o)
        geometry = geometry.seen_from(p_o, num_rays or dr.width(p_d))
        if settings.visibility == "transmittance":
            to_point.maxt = distance
            between = geometry.trace(to_point, active, settings.march, count=count)
            transmittance = type(distance)(1) if between.march is None else dr.exp(-between.march.tau)
            visible = dr.select(between.hits_shape, 0, transmittance)
            return ObserverHit(p_d, distance, visible, _evaluations(between))
        occlusion = None
        if not needs_depth and DEPTHS.find(settings.depth).is_at_half_opacity:
            clear_distance = distance - tolerance
            occlusion = OcclusionQuery(clear_distance, clear_distance - falloff, settings.surface_opacity)
        ray_hit = geometry.trace(to_point, active, settings.march, count=count, occlusion=occlusion)
        observed_depth = _find_observed_depth(ray_hit, settings, active)
        visible, evals = visibility(distance, observed_depth, falloff, tolerance), _evaluations(ray_hit)
    # An observer without a surface in front of the point sees the point itself.
    blocked = observed_depth < distance - tolerance
    d_o = dr.select(dr.isfinite(observed_depth), observed_depth, distance)
    return ObserverHit(dr.select(blocked, p_o + r_o * d_o, p_d), d_o, visible, evals, density)


def _find_observed_depth(ray_hit: RayHit, settings: ObserverSettings, active: Bool) -> Float:
    """Depth of the surface on the observer's rays; infinite without one, or if it is known to lie behind the point."""
    march = ray_hit.march
    if march is None or march.decided is None:
        return dr.select(
            active & ray_hit.has_surface(settings.surface_opacity), ray_hit.depth(settings.depth, active), dr.inf
        )
    undecided = active & ~march.decided
    depth = dr.select(
        undecided & ray_hit.has_surface(settings.surface_opacity), ray_hit.depth(settings.depth, undecided), dr.inf
    )
    # Infinite on unoccluded rays: transmittance 1/2 has not been reached there.
    return dr.select(active & march.decided, march.median_depth, depth)


def _tolerance(
    geometry: SceneGeometry, ray: Ray3f, p_d: Point3f, p_o: Point3f, settings: ObserverSettings
) -> Float | float:
    if settings.tolerance:
        return min(settings.tolerance, MAX_TOLERANCE)
    if geometry.medium is None:
        near = 2 * dr.maximum(dr.norm(dr.detach(p_d)), dr.norm(dr.detach(p_o)))
        return RELATIVE_TOLERANCE * dr.minimum(geometry.shape_diagonal, near) + _FAR * geometry.shape_diagonal
    march = settings.march
    return dr.minimum(2 * dr.maximum(march.step, march.dt_gamma * dr.norm(p_d - ray.o)), MAX_TOLERANCE)


def shape_tolerance(geometry: SceneGeometry, settings: ObserverSettings, shape: Any) -> float:
    """Return the distance in scene units by which a surface may lie in front of a point of ``shape`` that it does not
    occlude."""
    if settings.tolerance:
        return min(settings.tolerance, MAX_TOLERANCE)
    if geometry.medium is not None:
        march = settings.march
        return min(2 * max(march.step, march.dt_gamma), MAX_TOLERANCE)
    diagonal, near = geometry.shape_diagonal, 2 * float(np.abs(shape_corners(shape)).max())
    return RELATIVE_TOLERANCE * min(diagonal, near) + _FAR * diagonal


@dataclass(frozen=True, eq=False)
class ObserverMap:
    """The depths around an observer, and the table of their gaze; None without gaze, or if it carries gradients."""

    depths: ObserverDepthMap
    gaze: Float | None


def get_observer_map(
    geometry: SceneGeometry, p_o: Point3f, settings: ObserverSettings, gaze: ObservedGaze | None, cache: ObserverCache
) -> ObserverMap:
    """The map of the observer at ``p_o`` (one lane) in ``geometry``, kept in ``cache``; ``gaze``: the gaze field whose
    density it also stores."""
    dependencies = (fingerprint_geometry(geometry), settings.surface_settings, settings.map_height)
    compute = lambda center: ObserverDepthMap(geometry, center, settings)
    entries = cache.get_or_compute_each("map", [p_o], dependencies, compute)
    depth_map = entries[0].value
    if gaze is None or dr.grad_enabled(p_o, *gaze.parameters()):
        return ObserverMap(depth_map, None)
    table_dependencies = (depth_map, gaze.dependencies)
    table = cache.get_or_compute("gaze of map", entries, table_dependencies, lambda k: k.value.make_gaze_table(gaze))[
        0
    ].value
    return ObserverMap(depth_map, table)


def _evaluations(ray_hit: RayHit) -> Float | None:
    return None if ray_hit.march is None else ray_hit.march.density_evals
