"""What the numerics of a march are measured with: closed forms in float64, and media that march along a line."""

from __future__ import annotations

import math

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.transport.march.march import march
from nerg_mi.transport.media.local_ray import LocalRay
from nerg_mi.transport.media.volume import VolumeMedium

import drjit as dr
import numpy as np

STEP = 3**0.5 / 1024
"""With nothing set, a 1024th of the diagonal of a unit cube."""


def worst(got, expected, relative=True) -> float:
    """Largest error; infinite where something is not finite that should be."""
    got, expected = (np.asarray(v, float) for v in (got, expected))
    if not np.all(np.isfinite(got)):
        return math.inf
    error = np.abs(got - expected)
    return float(np.max(error / np.abs(expected)) if relative else np.max(error))


def values(x) -> np.ndarray:
    return np.array(x).astype(float)


def gradient(x, f):
    """``f(x)`` and its derivative, entry by entry, as float64 arrays; ``x`` a Float."""
    x = type(x)(x)
    dr.enable_grad(x)
    y = f(x)
    dr.backward(dr.sum(y))
    return values(y), values(dr.grad(x))


def share(x):
    """1/x - 1/expm1(x) in float64, by its series where that cancels."""
    x = np.asarray(x, float)
    safe = np.clip(x, 0.05, 700)
    return np.where(x < 0.05, 0.5 - x / 12 + x**3 / 720 - x**5 / 30240, 1 / np.maximum(x, 0.05) - 1 / np.expm1(safe))


def share_slope(x):
    x = np.asarray(x, float)
    safe = np.clip(x, 0.2, 700)
    series = -1 / 12 + x**2 / 240 - x**4 / 6048 + x**6 / 172800
    return np.where(x < 0.2, series, -1 / np.maximum(x, 0.2) ** 2 + 1 / (4 * np.sinh(safe / 2) ** 2))


def half(x):
    """-log((1 + exp(-x)) / 2) / x in float64, where half of a slab's opacity is reached, and its derivative."""
    x = np.asarray(x, float)
    safe = np.maximum(x, 0.05)
    passed = np.exp(-safe)
    value = -np.log1p(0.5 * np.expm1(-safe)) / safe
    slope = (passed / (1 + passed) - value) / safe
    return (
        np.where(x < 0.05, 0.5 - x / 8 + x**3 / 192 - x**5 / 2880, value),
        np.where(x < 0.05, -1 / 8 + x**2 / 64 - x**4 / 576, slope),
    )


def smooth(tau, length=1.0, panels=2000):
    """``(opacity, expected depth)`` of a smooth optical depth ``tau(z)`` on [0, length], by Gauss-Legendre quadrature
    of ∫ (T(z) - T(length)) dz / opacity."""
    x, w = np.polynomial.legendre.leggauss(8)
    z = ((np.arange(panels)[:, None] + 0.5 + 0.5 * x) / panels * length).ravel()
    opacity = -np.expm1(-tau(length))
    # T(z) - T(length) = T(z) (1 - exp(-(τ(length) - τ(z)))), which does not cancel.
    gained = np.exp(-tau(z)) * -np.expm1(-(tau(length) - tau(z)))
    return float(opacity), float((gained * np.tile(0.5 * w / panels * length, panels)).sum() / opacity)


class Profile:
    """A medium in z from 0 to ``length``, of density ``f(z, *parameters)``, that states no bound."""

    occupancy = cells = step = hits = None

    def __init__(self, f, *parameters, length=1.0):
        self.f, self._parameters, self.length = f, list(parameters), length

    def parameters(self):
        return self._parameters

    def density(self, p, active):
        return dr.select(active, self.f(p.z, *self._parameters), 0)

    def density_features(self, p, active):
        return self.density(p, active), []


def along_z(mi, medium, settings, start=0.0, **options):
    """A march along +z from the points z = ``start``."""
    start = mi.Float(start)
    ray = LocalRay(
        mi.Point3f(0, 0, start), mi.Vector3f(0, 0, 1), mi.Vector3f(0, 0, 1), mi.Float(0), medium.length - start
    )
    return ray, march(
        medium, ray, dr.zeros(mi.Float, dr.width(start)), medium.length - start, True, settings, **options
    )


def box(mi, sigma, near=0.0, length=1.0):
    to_world = mi.ScalarTransform4f().translate([0, 0, near]).scale(length)
    return VolumeMedium(mi.load_dict({"type": "constvolume", "value": float(sigma), "to_world": to_world}))


def grid(mi, data, **more):
    return VolumeMedium(
        mi.load_dict({"type": "gridvolume", "grid": mi.VolumeGrid(np.asarray(data, np.float32)), "raw": True, **more})
    )


def through(mi, medium, o, d, settings):
    """March of rays (N, 3) through a medium, and the ray and its ends."""
    o, d = (np.atleast_2d(np.asarray(v, np.float32)) for v in (o, d))
    ray = medium.local(mi.Point3f(o.T), mi.Vector3f(d.T))
    t0, t1 = dr.maximum(ray.t_near, 0), ray.t_far
    return march(medium, ray, t0, t1, True, settings, count=True), ray, t0, t1


def exact_box(o, d, lower=0.0, upper=1.0):
    """Distances (N,) at which float64 rays (N, 3) enter and leave a box; the first is the larger one on a miss."""
    parallel = d == 0
    inverse = 1 / np.where(parallel, 1, d)
    a, b = (lower - o) * inverse, (upper - o) * inverse
    outside = parallel & ((o < lower) | (o > upper))
    near = np.where(parallel, -np.inf, np.minimum(a, b)).max(-1)
    return near, np.where(parallel, np.where(outside, -np.inf, np.inf), np.maximum(a, b)).min(-1)


def all_finite(*arrays) -> str:
    """What a row says where only finiteness is asked for."""
    return "finite" if all(np.all(np.isfinite(np.asarray(a, float))) for a in arrays) else "NOT FINITE"
