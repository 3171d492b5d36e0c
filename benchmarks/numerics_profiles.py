"""Numerical errors of a march through profiles that are hard to march: sheets, jumps, exponentials, odd densities."""

from __future__ import annotations

import math

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.field.radiance import density_from_log
from nerg_mi.transport.march.rules import RULES
from nerg_mi.transport.march.settings import MarchSettings
from numerics import Row
from numerics_media import (
    STEP,
    Profile,
    all_finite,
    along_z,
    box,
    gradient,
    grid,
    share,
    smooth,
    through,
    values,
    worst,
)

import drjit as dr
import numpy as np

THIN = 1e-4


def sheets_in_a_grid(mi):
    """10,000 voxels along z, two of them matter: τ = 0.1, then opaque."""
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
        settings = MarchSettings(medium.step, quadrature=kind)
        r, *_ = through(mi, medium, o, d, settings)
        error = worst(r.expected_depth, expected, False)
        found = np.mean(values(r.opacity) > 0.999)
        yield Row(
            "thin sheets in near-vacuum" if kind == "constant" else "",
            f"σ 1e-8, 1e3, 1e9; 1e-4 thick; {kind}",
            f"depth (absolute); {found:.0%} of the rays end at the sheet",
            error,
            "closed form",
        )


def sheets_and_steps(mi):
    """Which share of rays meets an opaque sheet of a foreign volume, by step."""
    n = 4096
    z0 = mi.Float(np.linspace(0, 0.1, n, dtype=np.float32))
    medium = Profile(lambda z: dr.select((z >= 0.5) & (z < 0.5 + THIN), 1e9, 1e-8))
    found = []
    for step in (0.5, 1, 2, 10):
        _, r = along_z(mi, medium, MarchSettings(step * THIN), z0)
        found.append(f"{step:g}: {np.mean(values(r.opacity) > 0.5):.1%}")
    yield Row(
        "the same sheet, a volume without bounds",
        "step / thickness 0.5 .. 10",
        "rays that meet it",
        ", ".join(found),
        "all",
    )


def jump(mi):
    """Vacuum, then wall; the wall starts anywhere within a step."""
    walls = np.linspace(0.3, 0.3 + 2 * STEP, 41)
    for kind in ("constant", "linear"):
        errors = []
        for wall in walls:
            medium = Profile(lambda z, w: dr.select(z >= w, 1e9, 1e-8), mi.Float(wall))
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
    """σ = σ0 exp(k z), with the closed τ = σ0 (exp(k z) - 1) / k."""
    for kind in ("constant", "linear"):
        errors = np.zeros(4)
        for s0, k in ((1e-8, 1.0), (1e-3, 30.0), (50.0, -20.0), (1e3, -5.0)):
            exact = lambda a, b: smooth(lambda z: a * np.expm1(b * z) / b)
            alpha, depth = exact(s0, k)
            h = 1e-4
            slope = [(np.array(exact(s0, k + h)) - np.array(exact(s0, k - h))) / (2 * h)]
            k_ = mi.Float(k)
            dr.enable_grad(k_)
            medium = Profile(lambda z, k: s0 * dr.exp(k * z), k_)  # noqa: B023
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


CASES = (sheets_in_a_grid, sheets_and_steps, jump, exponential, odd_densities)
