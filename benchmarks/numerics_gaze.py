"""Numerical errors of gaze: von Mises-Fisher densities, kernel densities, scores and losses, directions at the
poles."""

from __future__ import annotations

import math

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.density.kde.estimate import SphericalKde
from nerg_mi.evaluation import saliency as metrics
from nerg_mi.field.gaze.product import activate, softplus
from nerg_mi.maths import vmf
from nerg_mi.maths.sphere import direction_to_latlong, latlong_to_direction, logsumexp
from nerg_mi.training.gaze.losses import gaze_loss, probe_cc, probe_kld
from numerics import HEAD, Row
from numerics_media import all_finite, gradient, values, worst

import drjit as dr
import numpy as np

KAPPAS = np.logspace(-8, 8, 33)
LONG = np.longdouble


def tables(mi):
    for title, cases in (
        ("Directions and densities on the sphere", (concentrations, kernels, log_sums, directions)),
        ("Scores and losses", (scores, losses, activations)),
    ):
        yield title, HEAD, [row.cells() for case in cases for row in case(mi)]


def log_normaliser(kappa):
    """log C(κ) in 80-bit arithmetic where the machine has it."""
    k = LONG(kappa)
    return np.log(k / (-np.expm1(-2 * k))) - np.log(2 * LONG(np.pi))


def tilted(pole, angle):
    """Unit directions at float64 ``angle`` from ``pole``, in the plane of an axis perpendicular to it."""
    pole = np.asarray(pole, float)
    side = np.cross(pole, [0.0, 0.6, 0.8] if abs(pole[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    return np.cos(angle)[..., None] * pole + np.sin(angle)[..., None] * side


MUS = np.array([[0, 0, 1.0], [0, 0, -1.0], [0.6, 0.0, 0.8], [1.0, 0, 0], [0.48, 0.6, 0.64]])


def concentrations(mi):
    exact = np.array([log_normaliser(k) for k in KAPPAS]).astype(float)
    yield Row(
        "vMF",
        "κ 1e-8 .. 1e8",
        "log normaliser (nats)",
        worst(vmf.log_normaliser(KAPPAS), exact, False),
        "80-bit arithmetic",
    )
    errors, naive = [], []
    for mu in MUS:
        for kappa in KAPPAS:
            angle = np.concatenate([[0], np.geomspace(1e-6, np.pi, 40)])
            x = tilted(mu, angle)
            expected = float(log_normaliser(kappa)) - kappa * 2 * np.sin(angle / 2) ** 2
            near = kappa * 2 * np.sin(angle / 2) ** 2 < 80  # beyond, the density is 0 to single precision
            errors.append(worst(vmf.log_density(x, mu, kappa)[near], expected[near], False))
            x32, mu32 = x.astype(np.float32), mu.astype(np.float32)
            dot = np.float32(kappa) * ((x32 * mu32).sum(-1, dtype=np.float32) - np.float32(1))
            naive.append(np.max(np.abs(dot + kappa * 2 * np.sin(angle / 2) ** 2)[near]))
    yield Row(
        "",
        "κ 1e-8 .. 1e8, angles 0 .. π, 5 means with the poles",
        "log density (nats)",
        max(errors),
        "80-bit, exact angle",
    )
    yield Row("", "", "... by an fp32 dot product instead (nats)", max(naive), "80-bit, exact angle")
    resultant = vmf.mean_resultant_length(KAPPAS)
    k = KAPPAS.astype(LONG)
    exact = np.where(k < 0.1, k / 3 - k**3 / 45 + 2 * k**5 / 945 - k**7 / 4725, 1 / np.tanh(k) - 1 / k).astype(float)
    yield Row("", "κ 1e-8 .. 1e8", "mean resultant length", worst(resultant, exact), "80-bit, series below 0.1")
    some = (KAPPAS > 1e-6) & (KAPPAS < 1e6)
    yield Row(
        "",
        "κ 1e-6 .. 1e6",
        "κ from its resultant",
        worst(vmf.kappa_from_resultant(resultant[some]), KAPPAS[some]),
        "the κ put in",
    )


def kernels(mi):
    """Densities whose closed form is one von Mises-Fisher, or the mean of two opposite ones."""
    cases = {
        "one ray": (MUS[:1], MUS[:1]),
        "1,000 identical rays": (np.repeat(MUS[4:], 1000, 0), MUS[4:]),
        "two antipodal rays": (np.stack([MUS[4], -MUS[4]]), np.stack([MUS[4], -MUS[4]])),
    }
    for name, (rays, modes) in cases.items():
        errors = []
        for kappa in np.logspace(-8, 8, 9):
            reach = min(math.pi, 4 / math.sqrt(kappa))
            x = np.concatenate([tilted(m, np.linspace(0, reach, 24)) for m in modes]).astype(np.float32)
            x64 = x.astype(float)
            # What single precision was given, on the unit sphere: the angle is taken between these two.
            mean = np.zeros(len(x))
            for m in modes.astype(np.float32).astype(float):
                square = np.sum((x64 - m) ** 2, -1)
                mean += np.exp(float(log_normaliser(kappa)) - kappa * square / 2) / len(modes)
            got = SphericalKde(rays, [0, len(rays)], kappa).evaluate(x)[0]
            errors.append(worst(np.log(got.astype(float)), np.log(mean), False))
        yield Row(
            "KDE" if name == "one ray" else "",
            f"{name}, κ 1e-8 .. 1e8, to four widths",
            "log density (nats)",
            max(errors),
            "float64 of the same directions",
        )
    ns = SphericalKde(MUS[:1], [0, 1], 1.0).ns
    finite = []
    for kappa in (1e-8, 1.0, 1e8):
        kde = SphericalKde(MUS[:1], [0, 1], kappa)
        d = ns.Array3f(0, 0, [1, -1])
        dr.enable_grad(d)
        y = kde.density(ns.UInt32([0, 0]), d)
        dr.set_grad(d, ns.Array3f(0.3, 0.4, 0.5))
        finite.append(np.array(dr.forward_to(y)))
    yield Row(
        "", "at the ray and opposite to it", "derivative with respect to the direction", all_finite(*finite), "finite"
    )


def log_sums(mi):
    """A von Mises-Fisher density of directions of equal area, with its logits moved by a constant."""
    n = 4096
    z = (np.arange(n) + 0.5) / n * 2 - 1
    errors = []
    for kappa in (0.0, 1.0, 100.0):
        # ∫ exp(κ z) dω over bands of equal area, by their own sum in 80 bits.
        exact = np.log(np.sum(np.exp(LONG(kappa) * (z.astype(LONG) - 1))) * 4 * LONG(np.pi) / n)
        for logit in (-1e6, -1e3, 0.0, 1e3, 1e6):
            got = logsumexp(kappa * (z - 1) + logit, 4 * np.pi / n)
            errors.append(abs(float(LONG(got) - logit - exact)) / max(1.0, abs(logit)))
    yield Row("log ∫ exp over the sphere", "logits -1e6 .. 1e6", "nats, of max(1, |logit|)", max(errors), "80-bit sum")


def directions(mi):
    angle = np.concatenate([[0], np.geomspace(1e-12, 1, 60)])
    theta = np.concatenate([angle, np.pi - angle])
    phi = 1.0
    d = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], -1)
    u, v = direction_to_latlong(d)
    off = np.sin(theta) > 1e-15
    yield Row(
        "pixels at the poles",
        "1e-12 .. 1 rad off",
        "polar angle (rad, absolute)",
        worst(v * np.pi, theta, False),
        "the angle put in",
    )
    yield Row(
        "",
        "",
        "longitude (rad, absolute)",
        worst(u[off] * 2 * np.pi, np.full(off.sum(), phi), False),
        "the longitude put in",
    )
    back = latlong_to_direction(u, v)
    yield Row(
        "", "", "direction and back (rad)", float(np.max(np.linalg.norm(back - d, axis=-1))), "the direction put in"
    )


def scores(mi):
    rng = np.random.default_rng(0)
    p = rng.random(512)
    one = np.zeros(512)
    one[7] = 1
    zero, flat = np.zeros(512), np.full(512, 0.08)
    pairs = {"zeros": zero, "one direction": one, "constant": flat, "tiny": 1e-150 * p, "huge": 1e150 * p}
    got = np.array(
        [[f(a, b) for f in (metrics.kld, metrics.cc, metrics.sim)] for a in pairs.values() for b in pairs.values()]
    )
    yield Row(
        "KLD, CC and SIM", "maps of zeros, one direction, constants, 1e±150", "all pairs", all_finite(got), "finite"
    )
    yield Row(
        "",
        "any scale 1e-300 .. 1e300",
        "KLD of p with itself scaled (nats)",
        max(abs(metrics.kld(p, s * p)) for s in (1e-300, 1e-12, 1.0, 1e12, 1e300)),
        "0",
    )
    scales = (1e-300, 1e-150, 1e-12, 1e12, 1e150, 1e300)
    yield Row(
        "",
        "any scale 1e-300 .. 1e300",
        "CC of p with itself scaled",
        max(abs(metrics.cc(p, s * p) - 1) for s in scales),
        "1",
    )
    yield Row(
        "",
        "any scale 1e-300 .. 1e300",
        "NSS of p scaled",
        max(worst(metrics.nss(s * p, s * p), metrics.nss(p, p)) for s in scales),
        "NSS of p",
    )
    yield Row("", "one direction against uniform", "KLD (nats)", abs(metrics.kld(one, flat) - math.log(512)), "log 512")
    yield Row(
        "",
        "prediction zero where the truth is one",
        "KLD (nats)",
        abs(metrics.kld(one, 1 - one) - math.log(512 / metrics.EPS)),
        "log 512 / ε, ε = 1e-20",
    )
    yield Row("", "a constant map", "CC", abs(float(metrics.cc(p, flat))), "0 by definition")


def losses(mi):
    Float = mi.Float
    rng = np.random.default_rng(1)
    p = rng.random(256)
    maps = {
        "zeros": 0 * p,
        "constant": 0 * p + 0.08,
        "one direction": np.eye(256)[3] * 20,
        "1e-30": 1e-30 * p,
        "1e30": 1e12 * p,
    }
    results, finite = [], []
    for truth in maps.values():
        for x in maps.values():
            y, dy = gradient(Float(np.float32(x)), lambda v: gaze_loss(v, Float(np.float32(truth)), 256).total)  # noqa: B023
            results.append(y)
            finite.append(dy)
    yield Row(
        "gaze loss and its derivative",
        "zeros, constants, one direction, 1e-30, 1e12 1/sr",
        "all pairs",
        all_finite(*results, *finite),
        "finite",
    )
    q = rng.random(256)
    w = Float(np.float32(np.full(256, 1 / 256)))
    a, b = Float(np.float32(p)), Float(np.float32(q))
    got = values(probe_kld(b, a, 256, w))[0], values(probe_cc(b, a, 256, w))[0]
    yield Row(
        "",
        "random maps",
        "KLD; CC (absolute)",
        f"{abs(got[0] - metrics.kld(p, q, eps=1e-6)):.1e}; {abs(got[1] - metrics.cc(p, q)):.1e}",
        "float64 scores",
    )


def activations(mi):
    x = np.float32([-1e4, -100, -1, 0, 1, 30, 100, 1e4])
    y, dy = gradient(mi.Float(x), softplus)
    x64 = x.astype(float)
    exact = np.where(x64 >= 0, 1 / (1 + np.exp(-np.abs(x64))), np.exp(-np.abs(x64)) / (1 + np.exp(-np.abs(x64))))
    yield Row(
        "activations of gaze",
        "logits ±1e4",
        "softplus; its derivative (absolute)",
        f"{worst(y, np.logaddexp(0, x64), False):.1e}; {worst(dy, exact, False):.1e}",
        "float64",
    )
    y, dy = gradient(mi.Float(x), lambda v: activate(v, "exp"))
    yield Row(
        "",
        "logits ±1e4",
        "exp, at most exp 30",
        worst(y[1:6], np.exp(x64[1:6])) if np.all(np.isfinite(dy)) else math.inf,
        "float64, -100 .. 30 (derivative finite)",
    )
