"""Numerical errors of odd rays, far and small places, and derivatives at the ends of single precision."""

from __future__ import annotations

import math

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.maths.elementary import log1p, one_minus_exp, sigmoid
from nerg_mi.maths.ray_box import intersect_box
from nerg_mi.transport.march.march import march
from nerg_mi.transport.march.rules import RULES
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
    grid,
    share,
    through,
    values,
    worst,
)

import drjit as dr
import numpy as np


def tables(mi):
    for title, cases in GROUPS.items():
        yield title, HEAD, [row.cells() for case in cases for row in case(mi)]


def odd_rays(mi):
    s2, s3 = 0.5**0.5, 3**-0.5
    rays = [
        ((0.5, 0.5, -1), (0, 0, 1)),
        ((0, 0.5, -1), (0, 0, 1)),
        ((1, 1, -1), (0, 0, 1)),  # parallel: inside, on a face, an edge
        ((2, 0.5, -1), (0, 0, 1)),
        ((-1, -1, 0.5), (s2, s2, 0)),
        ((1, -1, 0.5), (-s2, s2, 0)),  # miss, a zero component
        ((-1, -1, -1), (s3, s3, s3)),
        ((0.5, 0.5, 0.5), (1, 0, 0)),
        ((0.5, 0.5, 0), (0, 0, 1)),  # corner, from inside, from a face
        ((0.5, 0.5, 1), (0, 0, 1)),
        ((0.5, 0.5, 2), (0, 0, 1)),
        ((0.3, 0.4, -1), (1e-30, 1e-38, 1)),  # on the far face, behind, tiny
        ((1, 0.25, 0.5), (-1, 0, 0)),
        ((0.25, 0.25, 0.25), (s3, s3, s3)),  # from a face, through cell corners
    ]
    o, d = (np.float32([r[i] for r in rays]) for i in (0, 1))
    near, far = exact_box(o.astype(float), d.astype(float))
    t_near, t_far = (values(t) for t in intersect_box(mi.Point3f(o.T), mi.Vector3f(d.T), (0, 0, 0), (1, 1, 1)))
    length = lambda a, b: np.maximum(b - np.maximum(a, 0), 0)
    yield Row(
        "rays that miss, graze, start inside or on a face, run parallel",
        f"{len(rays)} rays",
        "length in the box (absolute)",
        worst(length(t_near, t_far), length(near, far), False),
        "float64",
    )
    data = np.random.default_rng(0).exponential(1, (4, 4, 4)).astype(np.float32)
    depth = np.array(
        [
            length(near, far)[i] and fine_tau(data, o[i].astype(float), d[i].astype(float), max(near[i], 0), far[i])
            for i in range(len(rays))
        ]
    )
    for kind in RULES.names():
        r, *_ = through(mi, grid(mi, data), o, d, MarchSettings(STEP, quadrature=kind, stop=0))
        yield Row(
            "",
            f"grid of 4³ voxels, {kind}",
            "optical depth (absolute)",
            worst(r.tau, depth, False),
            "float64, 20,000 samples",
        )


def fine_tau(data, o, d, near, far, n=20000):
    t = near + (np.arange(n) + 0.5) / n * (far - near)
    x = (o + t[:, None] * d) * 4 - 0.5
    i = np.floor(x).astype(int)
    f, total = x - i, 0.0
    for corner in range(8):
        bits = np.array([(corner >> axis) & 1 for axis in range(3)])
        j = np.clip(i + bits, 0, 3)
        total = total + np.where(bits == 1, f, 1 - f).prod(-1) * data[j[:, 2], j[:, 1], j[:, 0]]
    return total.mean() * (far - near)


def sizes(mi):
    for size in (1e-3, 1e6):
        r, *_ = through(
            mi, box(mi, 2 / size, size, size), (size / 2, size / 2, 0), (0, 0, 1), MarchSettings(size * STEP)
        )
        errors = worst(r.opacity, -math.expm1(-2)), worst(r.expected_depth, size * (1 + share(2)))
        yield Row("box", f"{size:g} units", "opacity; depth", f"{errors[0]:.1e}; {errors[1]:.1e}", "closed form")
    for distance in (1e3, 1e4, 1e5):
        r, *_ = through(mi, box(mi, 3, distance), (0.5, 0.5, 0), (0, 0, 1), MarchSettings(STEP))
        errors = worst(r.opacity, -math.expm1(-3)), worst(r.expected_depth, distance + share(3), False)
        yield Row(
            f"unit slab {distance:g} units away",
            "σ = 3",
            "opacity; depth (absolute); evaluations",
            f"{errors[0]:.1e}; {errors[1]:.1e}; {values(r.density_evals)[0]:.0f}",
            "closed form",
        )
    medium = box(mi, 3)
    ray = medium.local(mi.Point3f(0.5, 0.5, -1), mi.Vector3f(0, 0, 1))
    r = march(medium, ray, mi.Float(1.5), mi.Float(1.5), True, MarchSettings(STEP))
    yield Row(
        "near = far",
        "",
        "opacity, depth",
        worst([values(r.opacity)[0], values(r.expected_depth)[0]], [0, 0], False),
        "0",
    )
    r, *_ = through(mi, box(mi, 3, 1e5), (0.5, 0.5, 0), (0, 0, 1), MarchSettings(1e-9))
    yield Row(
        "a step that cannot change t",
        "1e-9 at 1e5",
        "evaluations until it ends",
        f"{values(r.density_evals)[0]:.0f}",
        "finite",
    )


# ----------------------------------------------------------------------------
# Derivatives at the ends of single precision
# ----------------------------------------------------------------------------


def hidden_matter(mi):
    """A front of optical depth x, then σ behind it: ∂α/∂σ = (1/2) exp(-x - σ/2)."""
    errors, finite = [], []
    for x in (0.0, 1.0, 20.0, 60.0, 80.0, 100.0, 200.0, 1e4, 1e9):
        behind = mi.Float(1.0)
        dr.enable_grad(behind)
        medium = Profile(lambda z, s: dr.select(z < 0.5, 2 * x, s), behind)  # noqa: B023
        _, r = along_z(mi, medium, MarchSettings(1 / 256, stop=0))
        got = []
        for y in (r.opacity, r.expected_depth, dr.select(dr.isfinite(r.half), r.half, 0)):
            dr.set_grad(behind, 0)
            dr.backward(y, flags=dr.ADFlag.ClearVertices)
            got.append(values(dr.grad(behind))[0])
        finite.append(got)
        exact = 0.5 * math.exp(-x - 0.5)
        if exact > 1e-37:
            errors.append(worst(got[0], exact))
        else:
            errors.append(abs(got[0]))
    yield Row(
        "transmittance underflows in front of matter",
        "τ 0 .. 1e9, no stopping",
        "∂ opacity / ∂ density behind",
        max(errors),
        "closed form",
    )
    yield Row("", "", "derivatives of expected and median depth", all_finite(finite), "finite")


def ends_of_functions(mi):
    x = np.float32(np.concatenate([np.logspace(-30, 38, 200), -np.logspace(-30, 38, 200), [0]]))
    x64 = x.astype(float)
    with np.errstate(over="ignore"):
        exact = np.where(x64 > 0, 1 / (1 + np.exp(-np.abs(x64))), np.exp(-np.abs(x64)) / (1 + np.exp(-np.abs(x64))))
    y, dy = gradient(mi.Float(x), sigmoid)
    yield Row(
        "saturated sigmoid",
        "±1e38",
        "value; derivative (absolute)",
        f"{worst(y, exact, False):.1e}; {worst(dy, exact * (1 - exact), False):.1e}",
        "float64",
    )
    x = np.float32(np.concatenate([[0], np.logspace(-38, 9, 300)]))
    y, dy = gradient(mi.Float(x), one_minus_exp)
    yield Row(
        "1 - exp(-x)",
        "0 .. 1e9",
        "value; derivative (absolute)",
        f"{worst(y, -np.expm1(-x.astype(float)), False):.1e}; {worst(dy, np.exp(-x.astype(float)), False):.1e}",
        "float64",
    )
    x = np.float32(np.concatenate([[0], np.logspace(-38, 0, 200), -np.logspace(-38, -0.01, 200)]))
    y, _ = gradient(mi.Float(x), log1p)
    yield Row("log(1 + x)", "-0.98 .. 1", "value (absolute)", worst(y, np.log1p(x.astype(float)), False), "float64")


GROUPS = {
    "Rays and places": (odd_rays, sizes),
    "Derivatives at the ends of single precision": (hidden_matter, ends_of_functions),
}
