"""What hides a surface from an observer: maps of depth around them, and the sight along one segment."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from nerg_mi.maths.types import Bool, Float, Point3f, Ray3f, Vector3f, variant_types

from .depth import DEPTHS
from .geometry import SceneGeometry, RayView
from .march_primal import Occlusion
from .observer import ObserverCache, ObserverSettings, distance_and_direction, fingerprint_of, visibility
from .observer_gaze import ObservedGaze

# ---- What an observer meets in every direction, marched once and looked up ever after ----
#
# A latitude-longitude map of depth, and of gaze, around the observer. A point is compared with the four nearest entries
# and the results are interpolated (percentage-closer filtering, Reeves et al. 1987), not the depths themselves, which
# would float between surfaces.


class ObserverMap:
    """Depths (scene units, infinite where nothing is met) around ``center`` (one lane), ``2 height`` x
    ``height`` entries.

    Detached: no derivative passes through the map. Rows run from +z to -z, columns from azimuth 0 on, entries at pixel
    centres.
    """

    def __init__(self, place: SceneGeometry, center: Point3f, settings: ObserverSettings):
        mi = variant_types()
        self.height, self.width, self.center = settings.map_height, 2 * settings.map_height, center
        self._float, self._uint, self._vector = mi.Float, mi.UInt32, mi.Vector3f
        with dr.suspend_grad():
            everywhere = dr.full(mi.Bool, True, self.width * self.height)
            view = place.trace(mi.Ray3f(self.center, self._directions()), everywhere, settings.march)
            met = view.has_surface(settings.surface_opacity)
            self.depth = dr.select(met, view.depth(settings.depth, met), dr.inf)
            dr.eval(self.depth)

    def gaze_table(self, gaze: ObservedGaze) -> Float:
        """The density of ``gaze`` (an entry each) where a surface is met, 0 elsewhere."""
        with dr.suspend_grad():
            r_o = self._directions()
            met = dr.isfinite(self.depth)
            p_od = self.center + r_o * dr.select(met, self.depth, 0)
            table = dr.select(met, gaze.evaluate(p_od, self.center, r_o, met)[0], 0)
            dr.eval(table)
        return table

    @property
    def spacing(self) -> float:
        """Angle between neighbouring entries, in radian."""
        return dr.pi / self.height

    def _directions(self) -> Vector3f:
        index = dr.arange(self._uint, self.width * self.height)
        Float = self._float
        phi = (Float(index % self.width) + 0.5) * self.spacing
        theta = (Float(index // self.width) + 0.5) * self.spacing
        sin_theta, cos_theta = dr.sincos(theta)
        sin_phi, cos_phi = dr.sincos(phi)
        return self._vector(sin_theta * cos_phi, sin_theta * sin_phi, cos_theta)

    def look_up(
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

    def gaze_along(
        self, table: Float, r_o: Vector3f, distance: Float, falloff: Float, slack: Float | float, active: Bool
    ) -> Float:
        """Density of a ``gaze_table`` at the surface that is met along unit ``r_o`` for points at ``distance``.

        Negative where the map does not know it: an entry that looks past the point, by more than ``slack``, sees
        another surface."""
        Float = type(distance)
        total, share = Float(0), Float(0)
        for entry, weight in self._entries(r_o, distance):
            depth = dr.gather(Float, self.depth, entry, active)
            weight *= visibility(distance, depth, falloff, slack)
            weight = dr.select(depth < distance + slack, weight, 0)
            total += weight * dr.gather(Float, table, entry, active)
            share += weight
        return dr.select(share > 0, total / dr.select(share > 0, share, 1), -1)

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


# ---- What an observer, who may stand elsewhere than the camera, sees of a point ----
#
# The paper's second depth pass: the observer's ray towards the camera's surface p_d is marched for its own depth d_o,
# and compared with the distance d_o* (see ``visibility``).


# An entry of a map sees the same surface as a point if it lies at most this many times the point's lift behind it.
_PAST = 4
# Ray casts agree on a shape to this share of the scene's diagonal, or of twice the coordinates there: what is far
# away takes no part in how exactly a near one is met, but for the size of its triangles.
RELATIVE_TOLERANCE, _FAR = 1e-4, 3e-7
LARGEST = 1e18
"""Tolerance at most, in scene units: the square of a distance so long is still finite in single precision."""


@dataclass
class Sight:
    """What an observer sees of a point; distances in scene units."""

    # The surface that the observer meets.
    p_od: Point3f
    # d_o; the distance to the point where nothing is met.
    depth: Float
    # 1 visible .. 0 hidden.
    visibility: Float
    # Evaluations of density that it took; None unless counted.
    density_evals: Float | None
    # The density of a gaze field, from a map that keeps it, negative where it does not know it; else None.
    gaze: Float | None = None


def trace_from_observer(
    place: SceneGeometry,
    ray: Ray3f,
    p_d: Point3f,
    p_o: Point3f,
    penetration: Float | float,
    active: Bool,
    falloff: Float,
    settings: ObserverSettings,
    *,
    count: bool = False,
    gaze: ObservedGaze | None = None,
    cache: ObserverCache | None = None,
    needs_depth: bool = True,
) -> Sight:
    """What the observer at ``p_o`` meets towards the surface ``p_d`` that the camera sees on ``ray``.

    The point that is looked for lies a little in front of the surface, towards the camera: by the tolerance, and by the
    ``penetration`` of light into the surface. A surface then never hides itself, however obliquely the observer looks
    along it, because the ray stays above it. A tolerance along the observer's ray alone would have to grow without
    bound.

    ``falloff``: d_f. ``count``: count evaluations. ``gaze``: what a map keeps the density of as well, where no
    derivative needs the field itself. ``cache``: keeps the map. ``whole``: whether the depth, and the surface that is
    met, are needed where the visibility is 0 or 1 without them; otherwise rays may end there, and what they return is
    on the right side of the point, and nothing more.
    """
    tolerance = _tolerance(place, ray, p_d, p_o, settings)
    in_front = tolerance + penetration
    if settings.visibility == "map":
        # Entries of a map are this far apart where the ray ends, and depths on slopes as much.
        apart = dr.norm(p_d - p_o) * (dr.pi / settings.map_height)
        in_front += apart
        tolerance = tolerance + apart
    distance, r_o = distance_and_direction(p_o, p_d - ray.d * in_front)
    attended = None

    if settings.visibility == "map":
        around, table = _map_of(place, p_o, settings, gaze, cache or ObserverCache())
        met, seen = around.look_up(r_o, distance, falloff, tolerance, active)
        if table is not None:
            # Of the surface itself: the point in front of it lies in another direction.
            far, r_d = distance_and_direction(p_o, p_d)
            attended = around.gaze_along(table, r_d, far, falloff, _PAST * in_front, active)
        evals = type(distance)(0)
    else:
        to_point = variant_types().Ray3f(p_o, r_o)
        if settings.visibility == "transmittance":
            to_point.maxt = distance
            between = place.trace(to_point, active, settings.march, count=count)
            reached = type(distance)(1) if between.march is None else dr.exp(-between.march.tau)
            seen = dr.select(between.hits_shape, 0, reached)
            return Sight(p_d, distance, seen, _evaluations(between))
        occlusion = None
        if not needs_depth and DEPTHS.find(settings.depth).at_half:
            before = distance - tolerance
            occlusion = Occlusion(before, before - falloff, settings.surface_opacity)
        view = place.trace(to_point, active, settings.march, count=count, occlusion=occlusion)
        met = _met(view, settings, active)
        seen, evals = visibility(distance, met, falloff, tolerance), _evaluations(view)
    # An observer who meets nothing before the point sees the point itself.
    blocked = met < distance - tolerance
    d_o = dr.select(dr.isfinite(met), met, distance)
    return Sight(dr.select(blocked, p_o + r_o * d_o, p_d), d_o, seen, evals, attended)


def _met(view: RayView, settings: ObserverSettings, active: Bool) -> Float:
    """Depth of the surface on the observer's rays; infinite where there is none, or where it is known to lie behind the
    point."""
    march = view.march
    if march is None or march.known is None:
        return dr.select(active & view.has_surface(settings.surface_opacity), view.depth(settings.depth, active), dr.inf)
    rest = active & ~march.known
    met = dr.select(rest & view.has_surface(settings.surface_opacity), view.depth(settings.depth, rest), dr.inf)
    # Infinite where the way is clear: transmittance 1/2 has not been reached there.
    return dr.select(active & march.known, march.half, met)


def _tolerance(place: SceneGeometry, ray: Ray3f, p_d: Point3f, p_o: Point3f, settings: ObserverSettings) -> Float | float:
    if settings.tolerance:
        return min(settings.tolerance, LARGEST)
    if place.medium is None:
        near = 2 * dr.maximum(dr.norm(dr.detach(p_d)), dr.norm(dr.detach(p_o)))
        return RELATIVE_TOLERANCE * dr.minimum(place.shape_diagonal, near) + _FAR * place.shape_diagonal
    march = settings.march
    return dr.minimum(2 * dr.maximum(march.step, march.dt_gamma * dr.norm(p_d - ray.o)), LARGEST)


def _map_of(
    place: SceneGeometry, p_o: Point3f, settings: ObserverSettings, gaze: ObservedGaze | None, cache: ObserverCache
) -> tuple[ObserverMap, Float | None]:
    """The observer's map, and the table of ``gaze`` on it (None without one, or where it has derivatives)."""
    made_of = (fingerprint_of(place), settings.surfaces, settings.map_height)
    make = lambda center: ObserverMap(place, center, settings)
    known = cache.get_or_compute_each("map", [p_o], made_of, make)
    around = known[0].value
    if gaze is None or dr.grad_enabled(p_o, *gaze.parameters()):
        return around, None
    of_map = (around, gaze.dependencies)
    table = cache.of_known("gaze of map", known, of_map, lambda k: k.value.gaze_table(gaze))[0].value
    return around, table


def _evaluations(view: RayView) -> Float | None:
    return None if view.march is None else view.march.density_evals
