"""What an observer meets in every direction, marched once and looked up ever after.

A latitude-longitude map of depth around the observer. A point is compared with the
four nearest entries and the results are interpolated (percentage-closer filtering,
Reeves et al. 1987), not the depths themselves, which would float between surfaces.
"""
from __future__ import annotations

import drjit as dr

from .depth import surface_depth
from .march import march
from .visibility import visibility


class ObserverMap:
    """Depths (scene units, infinite where nothing is met) around ``p_o``, ``2 height`` x ``height`` entries.

    Detached: no derivative passes through the map. Rows run from +z to -z, columns from azimuth 0 on,
    entries at pixel centres.
    """

    def __init__(self, medium, p_o, height: int, settings, kind: str, surface_opacity: float, vector):
        self.height, self.width = height, 2 * height
        self._uint = dr.uint32_array_t(type(p_o.x))
        with dr.suspend_grad():
            self.center = type(p_o)(dr.detach(p_o))
            index = dr.arange(self._uint, self.width * height)
            d = self._direction(index % self.width, index // self.width, vector)
            local = medium.local(self.center, d)
            t0, t1 = dr.maximum(local.t_near, 0), local.t_far
            everywhere = dr.mask_t(t0)(True)
            result = march(medium, local, t0, t1, everywhere, settings)
            met = result.opacity >= surface_opacity
            depth = surface_depth(kind, result, medium, local, t0, t1, met, settings)
            self.depth = dr.select(met, depth, dr.inf)
            dr.eval(self.depth)

    @property
    def spacing(self) -> float:
        """Angle between neighbouring entries, in radian."""
        return dr.pi / self.height

    def _direction(self, column, row, vector):
        Float = type(self.center.x)
        phi, theta = (Float(column) + 0.5) * self.spacing, (Float(row) + 0.5) * self.spacing
        sin_theta, cos_theta = dr.sincos(theta)
        sin_phi, cos_phi = dr.sincos(phi)
        return vector(sin_theta * cos_phi, sin_theta * sin_phi, cos_theta)

    def look_up(self, r_o, distance, falloff, tolerance, active):
        """``(nearest depth, visibility)`` of points at ``distance`` along unit ``r_o`` from the centre."""
        Float, UInt32 = type(distance), self._uint
        r_o = dr.detach(r_o)
        theta = dr.atan2(dr.sqrt(r_o.x * r_o.x + r_o.y * r_o.y), r_o.z)
        phi = dr.atan2(r_o.y, r_o.x)
        x = dr.select(phi < 0, phi + dr.two_pi, phi) / self.spacing - 0.5
        y = dr.clip(theta / self.spacing - 0.5, 0, self.height - 1)
        x = dr.select(x < 0, x + self.width, x)
        i, j = UInt32(x), dr.minimum(UInt32(y), self.height - 1)
        fx, fy = x - Float(i), y - Float(j)
        seen, nearest, best = Float(0), Float(dr.inf), Float(-1)
        for dj in (0, 1):
            for di in (0, 1):
                row, column = dr.minimum(j + dj, self.height - 1), (i + di) % self.width
                depth = dr.gather(Float, self.depth, column + self.width * row, active)
                weight = (fx if di else 1 - fx) * (fy if dj else 1 - fy)
                seen += weight * visibility(distance, depth, falloff, tolerance)
                closer = weight > best
                nearest, best = dr.select(closer, depth, nearest), dr.select(closer, weight, best)
        return nearest, seen
