"""Directions that lenses show, on the device: the float32 counterpart of `photos.cameras.rays`."""

from __future__ import annotations

import drjit as dr
import numpy as np

from nerg_mi.photos.cameras import Intrinsics, fisheye_limit

# From the image's own coordinates, Newton's iteration reaches float32 in 3 to 5 steps at the corners of usual lenses.
_STEPS = 8
_ROUNDING = 1e-5


class LensTable:
    """The lenses of some frames; only what they need is computed.

    A row has the half-pixel offset and inverse focal length of both axes, then the eight coefficients and, for
    fisheyes, the image radius where they end (0: no fisheye).
    """

    def __init__(self, ns, lenses: list[Intrinsics]):
        self.ns = ns
        self.fisheye = [i.fisheye for i in lenses]
        plain = [i for i in lenses if not i.fisheye]
        self.distorted = any(any(i.distortion) for i in plain)
        self.rational = any(i.k4 or i.k5 or i.k6 for i in plain)
        rows = [[0.5 - i.cx, 0.5 - i.cy, 1 / i.fx, 1 / i.fy, *i.distortion, *_end(i)] for i in lenses]
        self._columns = [ns.Float(c) for c in np.array(rows, np.float32).T]

    def directions(self, frame, column, row):
        """Directions (3 Floats, OpenGL camera frame, of any length) of the pixels ``column``, ``row`` of ``frame``
        (UInt32)."""
        ns = self.ns
        get = lambda k: dr.gather(ns.Float, self._columns[k], frame)
        x, y = (ns.Float(column) + get(0)) * get(2), (ns.Float(row) + get(1)) * get(3)
        z = ns.Float(1)
        if self.distorted or any(self.fisheye):
            k = [get(4 + n) for n in range(8)]
            out = self._pinhole(x, y, k) if self.distorted else (x, y, z)
            if any(self.fisheye):
                end, angle = get(12), get(13)
                bent = self._fisheye(x, y, k, end, angle)
                out = bent if all(self.fisheye) else tuple(dr.select(end > 0, b, a) for a, b in zip(out, bent))
            x, y, z = out
        return x, -y, -z

    def _pinhole(self, x0, y0, k):
        """Newton's iteration on OpenCV's model, see `photos.cameras.undistort`."""
        k1, k2, p1, p2, k3, k4, k5, k6 = k
        x, y = x0, y0
        for _ in range(_STEPS):
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)
            if self.rational:
                under = dr.rcp(1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
                radial *= under
                slope = (slope - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) * under
            ex = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - x0
            ey = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - y0
            a = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
            b = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
            d = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
            inverse = dr.rcp(a * d - b * b)
            x, y = x - (d * ex - b * ey) * inverse, y - (a * ey - b * ex) * inverse
        return x, y, self.ns.Float(1)

    def _fisheye(self, x, y, k, end, most):
        """Newton's iteration on the angle, kept within its rising part, see `photos.cameras.rays`."""
        k1, k2, _, _, k3, k4, _, _ = k
        r = dr.sqrt(x * x + y * y)
        goal = dr.minimum(r, end)
        low, high, theta = self.ns.Float(0), most, dr.minimum(goal, most)
        for _ in range(3 * _STEPS):
            t = theta * theta
            excess = theta * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4)))) - goal
            slope = 1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + t * 9 * k4)))
            low, high = dr.select(excess > 0, low, theta), dr.select(excess > 0, theta, high)
            step = theta - excess / slope
            # Where the polynomial flattens Newton's step may leave the bracket, by more than rounding: halve it
            # instead.
            theta = dr.select((step > low - _ROUNDING) & (step < high + _ROUNDING), step, 0.5 * (low + high))
        sine, cosine = dr.sincos(theta)
        across = dr.select(r > 1e-7, sine / dr.maximum(r, 1e-7), 1)
        return x * across, y * across, cosine


def _end(lens: Intrinsics) -> tuple[float, float]:
    """Image radius and angle where a fisheye ends."""
    if not lens.fisheye:
        return 0.0, 0.0
    angle, radius = fisheye_limit(lens)
    return radius, angle
