"""Largest numerical errors of a march: slabs, single steps, sheets, profiles and difficult densities.

    python benchmarks/numerics.py

Values and derivatives of each case are compared with a closed form or with a computation in float64. A row of the
tables has the case, its range, the quantity, the largest error, and the reference. Errors are relative unless the row
states otherwise. The benchmark prints Markdown and does not pass or fail; the tests enforce bounds.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.fields.radiance import density_from_log
from nerg_mi.transport.depth import DEPTHS, MarchContext
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.medium import LocalRay
from nerg_mi.transport.quadrature import (
    RULES,
    absorbed_fraction,
    find_linear_crossing,
    linear_mean_depth_fraction,
    mean_depth_fraction,
)
from nerg_mi.transport.volume_medium import VolumeMedium
from timing import save_result

import drjit as dr
import numpy as np

HEAD = ["case", "range", "quantity", "largest error", "reference"]
"""A parser of tables whose lines are `Row`s."""


@dataclass
class Row:
    """One line of a table. ``error``: a number, or a sentence for other outcomes."""

    case: str
    range: str
    quantity: str
    error: float | str
    reference: str

    def cells(self) -> list[str]:
        shown = self.error if isinstance(self.error, str) else f"{self.error:.1e}"
        return [self.case, self.range, self.quantity, "0" if shown == "0.0e+00" else shown, self.reference]


STEP = 3**0.5 / 1024
"""Default step: 1/1024 of the diagonal of a unit cube."""


def worst(got, expected, relative=True) -> float:
    """Largest error; infinite if a value is not finite that should be."""
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
    """1/x - 1/expm1(x) in float64, by its series where it cancels."""
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


class DensityProfile:
    """A medium in z from 0 to ``length``, of density ``f(z, *parameters)``, without an occupancy bound."""

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


def grid(mi, data, **overrides):
    return VolumeMedium(
        mi.load_dict(
            {"type": "gridvolume", "grid": mi.VolumeGrid(np.asarray(data, np.float32)), "raw": True, **overrides}
        )
    )


def through(mi, medium, o, d, settings):
    """March of rays (N, 3) through a medium, with the ray and its ends."""
    o, d = (np.atleast_2d(np.asarray(v, np.float32)) for v in (o, d))
    ray = medium.ray_to_local(mi.Point3f(o.T), mi.Vector3f(d.T))
    t0, t1 = dr.maximum(ray.t_near, 0), ray.t_far
    return march(medium, ray, t0, t1, True, settings, count=True), ray, t0, t1


def exact_box(o, d, lower=0.0, upper=1.0):
    """Distances (N,) at which float64 rays (N, 3) enter and leave a box; the first is larger on a miss."""
    parallel = d == 0
    inverse = 1 / np.where(parallel, 1, d)
    a, b = (lower - o) * inverse, (upper - o) * inverse
    outside = parallel & ((o < lower) | (o > upper))
    near = np.where(parallel, -np.inf, np.minimum(a, b)).max(-1)
    return near, np.where(parallel, np.where(outside, -np.inf, np.inf), np.maximum(a, b)).min(-1)


def all_finite(*arrays) -> str:
    """Text of a row that tests for finite values only."""
    return "finite" if all(np.all(np.isfinite(np.asarray(a, float))) for a in arrays) else "NOT FINITE"


THIN = 1e-4


def sheets_in_a_grid(mi):
    """10,000 voxels along z, two of which are not empty: τ = 0.1, then opaque."""
    data = np.full((10000, 2, 2), 1e-8, np.float32)
    data[3000], data[7000] = 1e3, 1e9
    medium = grid(mi, data, filter_type="nearest")
    rng = np.random.default_rng(1)
    o = np.concatenate([rng.uniform(0.2, 0.8, (64, 2)), rng.uniform(-1, -0.5, (64, 1))], -1).astype(np.float32)
    d = np.concatenate([rng.uniform(-0.1, 0.1, (64, 2)), np.ones((64, 1))], -1)
    d = (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)
    to = lambda z: (z - o[:, 2].astype(float)) / d[:, 2]
    a = -np.expm1(-1e3 * THIN / d[:, 2].astype(float))
    front = to(0.3) + THIN / d[:, 2] * share(1e3 * THIN / d[:, 2].astype(float))
    expected = a * front + (1 - a) * to(0.7)
    for kind in RULES.names():
        settings = MarchSettings(medium.default_step, quadrature=kind)
        r, *_ = through(mi, medium, o, d, settings)
        error = worst(r.expected_depth, expected, False)
        result = np.mean(values(r.opacity) > 0.999)
        yield Row(
            "thin sheets in near-vacuum" if kind == "constant" else "",
            f"σ 1e-8, 1e3, 1e9; 1e-4 thick; {kind}",
            f"depth (absolute); {result:.0%} of the rays end at the sheet",
            error,
            "closed form",
        )


def sheets_and_steps(mi):
    """Fraction of rays that find an opaque sheet of another volume, by step length."""
    n = 4096
    z0 = mi.Float(np.linspace(0, 0.1, n, dtype=np.float32))
    medium = DensityProfile(lambda z: dr.select((z >= 0.5) & (z < 0.5 + THIN), 1e9, 1e-8))
    result = []
    for step in (0.5, 1, 2, 10):
        _, r = along_z(mi, medium, MarchSettings(step * THIN), z0)
        result.append(f"{step:g}: {np.mean(values(r.opacity) > 0.5):.1%}")
    yield Row(
        "the same sheet, a volume without bounds",
        "step / thickness 0.5 .. 10",
        "rays that meet it",
        ", ".join(result),
        "all",
    )


def jump(mi):
    """Vacuum, then a wall that starts anywhere within a step."""
    walls = np.linspace(0.3, 0.3 + 2 * STEP, 41)
    for kind in ("constant", "linear"):
        errors = []
        for wall in walls:
            medium = DensityProfile(lambda z, w: dr.select(z >= w, 1e9, 1e-8), mi.Float(wall))
            _, r = along_z(mi, medium, MarchSettings(STEP, quadrature=kind))
            errors.append(abs(values(r.expected_depth)[0] - wall) / STEP)
        yield Row(
            "discontinuity" if kind == "constant" else "",
            f"σ 1e-8 to 1e9; {kind}",
            "depth (in steps)",
            max(errors),
            "closed form",
        )


def exponential(mi):
    """σ = σ0 exp(k z), with the closed form τ = σ0 (exp(k z) - 1) / k."""
    for kind in ("constant", "linear"):
        errors = np.zeros(4)
        for s0, k in ((1e-8, 1.0), (1e-3, 30.0), (50.0, -20.0), (1e3, -5.0)):
            exact = lambda a, b: smooth(lambda z: a * np.expm1(b * z) / b)
            alpha, depth = exact(s0, k)
            h = 1e-4
            slope = [(np.array(exact(s0, k + h)) - np.array(exact(s0, k - h))) / (2 * h)]
            k_ = mi.Float(k)
            dr.enable_grad(k_)
            medium = DensityProfile(lambda z, k: s0 * dr.exp(k * z), k_)  # noqa: B023
            _, r = along_z(mi, medium, MarchSettings(STEP, quadrature=kind, stop=1e-9))
            got = [values(r.opacity)[0], values(r.expected_depth)[0]]
            for y in (r.opacity, r.expected_depth):
                dr.set_grad(k_, 0)
                dr.backward(y, flags=dr.ADFlag.ClearVertices)
                got.append(values(dr.grad(k_))[0])
            expected = [alpha, depth, slope[0][0], slope[0][1]]
            new = [
                worst(got[0], expected[0]),
                worst(got[1], expected[1]),
                worst(got[2], expected[2], abs(expected[2]) > 1e-6),
                worst(got[3], expected[3], abs(expected[3]) > 1e-6),
            ]
            errors = np.maximum(errors, new)
        for i, name in enumerate(("opacity", "depth", "∂ opacity / ∂k", "∂ depth / ∂k")):
            yield Row(
                "exponential profiles" if i == 0 else "",
                f"1e-8 .. 1e10, falling and rising; {kind}" if i == 0 else "",
                name,
                errors[i],
                "closed τ, float64 quadrature, 577 steps",
            )


def odd_densities(mi):
    for name, sigma, alpha in (
        ("0", 0.0, 0),
        ("-1", -1.0, 0),
        ("NaN", math.nan, 0),
        ("inf", math.inf, 1),
        ("3e38", 3e38, 1),
    ):
        r, ray, t0, t1 = through(mi, box(mi, sigma, 1), (0.5, 0.5, 0), (0, 0, 1), MarchSettings(STEP))
        got = values(r.opacity)[0], values(r.expected_depth)[0]
        yield Row(
            "densities that are none" if name == "0" else "",
            name,
            "opacity; depth (absolute)",
            f"{abs(got[0] - alpha):.0e}; {abs(got[1] - alpha):.0e}",
            "masked: vacuum, or opaque from 1 on",
        )
    data = np.ones((2, 2, 2), np.float32)
    data[1, 0, 1] = np.nan
    try:
        grid(mi, data)
        outcome = "ACCEPTED"
    except ValueError as error:
        outcome = f'refused: "{error}"'
    yield Row("", "NaN in a grid", "", outcome, "an error that names the voxel")
    y, dy = gradient(mi.Float([-1e4, -200, 29.9, 30.1, 88, 89, 1e4, np.inf]), lambda h: density_from_log(h, 1.0))
    yield Row(
        "exponential activation",
        "log σ -1e4 .. inf",
        "density and derivative (at most exp 30)",
        all_finite(y, dy),
        "finite",
    )


PROFILES = (sheets_in_a_grid, sheets_and_steps, jump, exponential, odd_densities)


def tables(mi):
    """The name, columns and rows of each result."""
    yield "numerics-slabs", *slabs(mi)
    for name, cases in GROUPS.items():
        yield name, HEAD, [row.cells() for case in cases for row in case(mi)]


# ----------------------------------------------------------------------------
# The slab, through the integrator with default parameters
# ----------------------------------------------------------------------------

SIGMAS = (1e-6, 1e-3, 0.1, 1.0, 10.0, 100.0, 1e3, 1e6, 1e9)


def slab_errors(mi, volume: str, sigma: float, ahead: float, kind: str) -> dict[str, float]:
    """Errors of opacity and depth (of ``kind``) of a unit slab whose face is ``ahead`` of the ray's origin, and of
    their derivatives with respect to the density."""
    if volume == "constvolume":
        density = {"type": "constvolume", "value": float(sigma)}
    else:
        density = {"type": "gridvolume", "grid": mi.VolumeGrid(np.full((3, 3, 3), sigma, np.float32)), "raw": True}
    # Mitsuba starts the rays of this sensor slightly in front of it.
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
    return ["σ", *head], rows


# ----------------------------------------------------------------------------
# Steps
# ----------------------------------------------------------------------------


def one_step(mi):
    x = np.float32(np.logspace(-7, 6, 400))
    x64 = x.astype(float)
    y, dy = gradient(mi.Float(x), absorbed_fraction)
    counts = x64 < 80  # beyond, exp(-x) is below the range of single precision
    reference, ends = "closed form", "1e-7 .. 1e6 a step"
    yield Row("optical depth of a step", ends, "opacity", worst(y, -np.expm1(-x64)), reference)
    yield Row("", "1e-7 .. 80", "its derivative", worst(dy[counts], np.exp(-x64[counts])), reference)
    y, dy = gradient(mi.Float(x), mean_depth_fraction)
    yield Row("", ends, "mean depth in the step", worst(y, share(x64)), reference)
    yield Row("", ends, "its derivative", worst(dy, share_slope(x64)), reference)
    y, dy = gradient(mi.Float(x), lambda v: linear_mean_depth_fraction(v, v))
    yield Row(
        "", ends, "mean depth, linear rule, equal ends (absolute, in steps)", worst(y, share(x64), False), reference
    )
    errors, slopes = [], []
    for a in (1e-6, 1e-2, 1.0, 30.0):
        for b in (0.0, 1e-3, 1.0, 100.0):
            expected = smooth(lambda z: a * z + (b - a) * z * z / 2)[1]  # noqa: B023
            y, dy = gradient(mi.Float(a), lambda v: linear_mean_depth_fraction(v, mi.Float(b)))  # noqa: B023
            errors.append(abs(y[0] - expected))
            slopes.append(dy[0])
    yield Row("", "ends 0 .. 100", "mean depth, linear rule (absolute, in steps)", max(errors), "float64 quadrature")
    _, dy = gradient(mi.Float([0, 1e-30, 1, 1e30]), lambda v: find_linear_crossing(v, v * 0, mi.Float(1), mi.Float(0)))
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
    medium = DensityProfile(lambda z, s: s + 0 * z, sigma)
    settings = MarchSettings(STEP, stop=1e-9)
    ray, r = along_z(mi, medium, settings, dr.zeros(mi.Float, len(x)))
    x64 = x.astype(float)
    alpha = -np.expm1(-x64)
    truth = {"expected": share(x64), "median": -np.log1p(-alpha / 2) / x64, "refined": -np.log1p(-alpha / 2) / x64}
    for kind, expected in truth.items():
        got = DEPTHS.find(kind).inside(MarchContext(r, medium, ray, mi.Float(0), mi.Float(1), mi.Mask(True), settings))
        yield Row(
            "depth at any opacity" if kind == "expected" else "",
            "1e-6 .. 1" if kind == "expected" else "",
            f"{kind} depth",
            worst(got, expected),
            "closed form",
        )


GROUPS = {
    "numerics-steps": (one_step, any_number_of_samples, million_rays, all_opacities),
    "numerics-profiles": PROFILES,
}


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-m", "--mode", default="llvm_ad_rgb", help="Mitsuba variant. Default: %(default)s.")
    args = parser.parse_args(argv)
    import mitsuba as mi

    mi.set_variant(args.mode)
    for table in tables(mi):
        save_result(*table)


if __name__ == "__main__":
    main()
