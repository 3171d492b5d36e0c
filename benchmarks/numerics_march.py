"""Numerical errors of a march through simple matter: slabs, single steps, sheets, profiles."""

from __future__ import annotations

import math

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
import numerics_profiles
from nerg_mi.transport.march.depth import surface_depth
from nerg_mi.transport.march.quadrature import absorbed_share, linear_crossing, linear_share, mean_depth_share
from nerg_mi.transport.march.settings import MarchSettings
from numerics import HEAD, Row
from numerics_media import (
    STEP,
    Profile,
    all_finite,
    along_z,
    box,
    exact_box,
    gradient,
    half,
    share,
    share_slope,
    smooth,
    through,
    values,
    worst,
)

import drjit as dr
import numpy as np


def tables(mi):
    yield slabs(mi)
    for title, cases in GROUPS.items():
        yield title, HEAD, [row.cells() for case in cases for row in case(mi)]


# ----------------------------------------------------------------------------
# The slab, through the integrator with nothing set
# ----------------------------------------------------------------------------

SIGMAS = (1e-6, 1e-3, 0.1, 1.0, 10.0, 100.0, 1e3, 1e6, 1e9)


def slab_errors(mi, volume: str, sigma: float, ahead: float, kind: str) -> dict[str, float]:
    """Errors of opacity and depth (of ``kind``) of a unit slab whose face lies ``ahead`` of the ray's origin, and of
    their derivatives with respect to the density."""
    if volume == "constvolume":
        density = {"type": "constvolume", "value": float(sigma)}
    else:
        density = {"type": "gridvolume", "grid": mi.VolumeGrid(np.full((3, 3, 3), sigma, np.float32)), "raw": True}
    # Mitsuba starts the rays of this sensor a hair in front of it.
    z = -ahead - float(mi.math.RayEpsilon)
    film = {"type": "hdrfilm", "width": 1, "height": 1, "component_format": "float32", "rfilter": {"type": "box"}}
    sensor = {
        "type": "radiancemeter",
        "origin": [0.5, 0.5, z],
        "direction": [0, 0, 1],
        "sampler": {"type": "independent", "sample_count": 1},
        "film": film,
    }
    integrator = {
        "type": "nerg",
        "id": "integrator",
        "density": density,
        "depth": kind,
        "radiance": False,
        "aovs": "depth,opacity",
    }
    scene = mi.load_dict({"type": "scene", "sensor": sensor, "integrator": integrator})
    depth, opacity = values(mi.render(scene, spp=1)).ravel()[3:]
    x = float(np.float32(sigma))
    inside, slope = (share(x), share_slope(x)) if kind == "expected" else half(x)
    out = {"opacity": worst(opacity, -math.expm1(-x)), kind: worst(depth, ahead + float(inside))}
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith(("value.value", "density.data")))
    for name, channel, expected in ((kind, 3, float(slope)), ("opacity", 4, math.exp(-x))):
        value = type(params[key])(dr.detach(params[key]))
        dr.enable_grad(value)
        params[key] = value
        params.update()
        dr.backward(dr.gather(mi.Float, mi.render(scene, params, spp=1).array, channel))
        got = float(values(dr.grad(value)).sum())
        out[f"∂ {name} / ∂σ"] = worst(got, expected, relative=name != "opacity" or expected > 1e-6)
    return out


def slabs(mi):
    head = [
        "opacity",
        "expected",
        "expected, face at the origin",
        "median",
        "median, face at the origin",
        "∂ opacity / ∂σ",
        "∂ expected / ∂σ",
        "∂ median / ∂σ",
    ]
    rows = []
    for sigma in SIGMAS:
        errors: dict[str, float] = {}
        for volume in ("constvolume", "gridvolume"):
            for ahead in (1.0, 0.0):
                for kind in ("expected", "median"):
                    for name, e in slab_errors(mi, volume, sigma, ahead, kind).items():
                        name += ", face at the origin" if name == kind and ahead == 0 else ""
                        errors[name] = max(errors.get(name, 0), e)
        note = "" if math.exp(-sigma) > 1e-6 else " (absolute)"
        rows.append([f"{sigma:g}", *(f"{errors[n]:.1e}{note if n.startswith('∂ opacity') else ''}" for n in head)])
    return "Slab of length 1: largest error of `constvolume` and `gridvolume`, closed form", ["σ", *head], rows


# ----------------------------------------------------------------------------
# Steps
# ----------------------------------------------------------------------------


def one_step(mi):
    x = np.float32(np.logspace(-7, 6, 400))
    x64 = x.astype(float)
    y, dy = gradient(mi.Float(x), absorbed_share)
    counts = x64 < 80  # beyond, exp(-x) is below what single precision holds
    reference, ends = "closed form", "1e-7 .. 1e6 a step"
    yield Row("optical depth of a step", ends, "opacity", worst(y, -np.expm1(-x64)), reference)
    yield Row("", "1e-7 .. 80", "its derivative", worst(dy[counts], np.exp(-x64[counts])), reference)
    y, dy = gradient(mi.Float(x), mean_depth_share)
    yield Row("", ends, "mean depth in the step", worst(y, share(x64)), reference)
    yield Row("", ends, "its derivative", worst(dy, share_slope(x64)), reference)
    y, dy = gradient(mi.Float(x), lambda v: linear_share(v, v))
    yield Row(
        "", ends, "mean depth, linear rule, equal ends (absolute, in steps)", worst(y, share(x64), False), reference
    )
    errors, slopes = [], []
    for a in (1e-6, 1e-2, 1.0, 30.0):
        for b in (0.0, 1e-3, 1.0, 100.0):
            expected = smooth(lambda z: a * z + (b - a) * z * z / 2)[1]  # noqa: B023
            y, dy = gradient(mi.Float(a), lambda v: linear_share(v, mi.Float(b)))  # noqa: B023
            errors.append(abs(y[0] - expected))
            slopes.append(dy[0])
    yield Row("", "ends 0 .. 100", "mean depth, linear rule (absolute, in steps)", max(errors), "float64 quadrature")
    _, dy = gradient(mi.Float([0, 1e-30, 1, 1e30]), lambda v: linear_crossing(v, v * 0, mi.Float(1), mi.Float(0)))
    yield Row("root at zero", "density 0 .. 1e30", "derivative of the crossing", all_finite(slopes, dy), "finite")


def any_number_of_samples(mi):
    for n in (1, 2, 4096):
        r, *_ = through(mi, box(mi, 3), (0.5, 0.5, -1), (0, 0, 1), MarchSettings(1 / n, stop=0))
        errors = worst(r.opacity, -math.expm1(-3)), worst(r.expected_depth, 1 + share(3))
        yield Row("samples a ray", str(n), "opacity; depth", f"{errors[0]:.1e}; {errors[1]:.1e}", "closed form")


def million_rays(mi):
    rng = np.random.default_rng(0)
    n = 1_000_000
    o = rng.normal(size=(n, 3)) * 2 + 0.5
    d = rng.random((n, 3)) - o
    o, d = o.astype(np.float32), (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)
    r, ray, *_ = through(mi, box(mi, 2), o, d, MarchSettings(1 / 16))
    near, far = exact_box(o.astype(float), d.astype(float))
    length = np.maximum(far - np.maximum(near, 0), 0)
    yield Row(
        "a million rays",
        "σ = 2, 16 steps",
        "opacity (absolute)",
        worst(r.opacity, -np.expm1(-2 * length), False),
        "closed form of the float64 ray",
    )
    yield Row(
        "",
        "",
        "depth where length > 1e-3 (absolute)",
        worst(
            values(r.expected_depth)[length > 1e-3],
            (np.maximum(near, 0) + length * share(2 * length))[length > 1e-3],
            False,
        ),
        "closed form of the float64 ray",
    )


def all_opacities(mi):
    x = np.logspace(-6, 1.5, 60).astype(np.float32)
    sigma = mi.Float(x)
    medium = Profile(lambda z, s: s + 0 * z, sigma)
    settings = MarchSettings(STEP, stop=1e-9)
    ray, r = along_z(mi, medium, settings, dr.zeros(mi.Float, len(x)))
    x64 = x.astype(float)
    alpha = -np.expm1(-x64)
    truth = {"expected": share(x64), "median": -np.log1p(-alpha / 2) / x64, "refined": -np.log1p(-alpha / 2) / x64}
    for kind, expected in truth.items():
        got = surface_depth(kind, r, medium, ray, mi.Float(0), mi.Float(1), mi.Mask(True), settings)
        yield Row(
            "depth at any opacity" if kind == "expected" else "",
            "1e-6 .. 1" if kind == "expected" else "",
            f"{kind} depth",
            worst(got, expected),
            "closed form",
        )


GROUPS = {
    "Steps and samples": (one_step, any_number_of_samples, million_rays, all_opacities),
    "Profiles and densities": numerics_profiles.CASES,
}
