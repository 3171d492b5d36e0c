"""What an observer meets in every direction, marched once and looked up ever after.

A latitude-longitude map of depth, and of gaze, around the observer. A point is compared with the four nearest entries
and the results are interpolated (percentage-closer filtering, Reeves et al. 1987), not the depths themselves, which
would float between surfaces.
"""

from __future__ import annotations

import drjit as dr

from nerg_mi.maths.types import Bool, Float, Point3f, Vector3f
from nerg_mi.transport.place import Place

from .gaze import ObservedGaze
from .settings import ObserverSettings
from .visibility import visibility


class ObserverMap:
    """Depths (scene units, infinite where nothing is met) around ``center`` (one lane), ``2 height`` x
    ``height`` entries.

    Detached: no derivative passes through the map. Rows run from +z to -z, columns from azimuth 0 on, entries at pixel
    centres.
    """

    def __init__(self, place: Place, center: Point3f, settings: ObserverSettings):
        import mitsuba as mi

        self.height, self.width, self.center = settings.map_height, 2 * settings.map_height, center
        self._float, self._uint, self._vector = mi.Float, mi.UInt32, mi.Vector3f
        with dr.suspend_grad():
            everywhere = dr.full(mi.Bool, True, self.width * self.height)
            view = place.trace(mi.Ray3f(self.center, self._directions()), everywhere, settings.march)
            met = view.meets(settings.surface_opacity)
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
        self, r_o: Vector3f, distance: Float, falloff: Float, tolerance: Float, active: Bool
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
        self, table: Float, r_o: Vector3f, distance: Float, falloff: Float, slack: Float, active: Bool
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
