"""The step rule against integrals in extended precision, and its invariances."""

from fractions import Fraction

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.transport.quadrature import absorbed_share, linear_share, mean_depth_share

TAU = np.logspace(-8, 8, 1601).astype(np.float32)


def exact_share(tau):
    """1/τ - 1/expm1(τ) by rational arithmetic (the series of exp), so that nothing cancels."""
    out = []
    for t in np.atleast_1d(tau).astype(float):
        if t > 50:
            out.append(1 / t)
            continue
        x, term, tail, n = Fraction(t), Fraction(1), Fraction(0), 2
        # expm1(τ) / τ = 1 + Σ τ^n / (n + 1)!;  1/τ - 1/expm1(τ) = (Σ ...) / (τ expm1(τ)/τ)
        term = x / 2
        while term > Fraction(1, 10**40) * (1 + tail):
            tail += term
            n += 1
            term = (term * x / n).limit_denominator(10**60)
        out.append(float(tail / (x * (1 + tail))))
    return np.array(out)


def test01_the_reference_agrees_with_quadrature():
    # ∫ s τ exp(-τ s) ds / ∫ τ exp(-τ s) ds over [0, 1], by Gauss-Legendre
    s, w = np.polynomial.legendre.leggauss(60)
    s, w = (s + 1) / 2, w / 2
    for tau in (1e-6, 0.1, 1, 5, 20):
        f = tau * np.exp(-tau * s) * w
        assert np.isclose(exact_share(tau)[0], (f * s).sum() / f.sum(), rtol=1e-12)


def test02_mean_depth_share():
    tau = np.concatenate([TAU[::8], np.nextafter(np.float32(0.5), [0, 1]).astype(np.float32)])
    got = mean_depth_share(ns.Float(tau)).numpy()
    assert np.all(np.abs(got - exact_share(tau)) <= 1e-6 * exact_share(tau))


def test03_its_ends():
    got = mean_depth_share(ns.Float([0, 1e-38, 3e38, np.inf])).numpy()
    assert got[0] == 0.5 and got[1] == 0.5 and abs(got[2]) < 1e-34 and abs(got[3]) < 1e-34


def slope_of(function, x, mode):
    """Derivative, lane by lane, of a function of the array ``x``. The modes meet other infinities on their way."""
    v = ns.Float(x)
    dr.enable_grad(v)
    result = function(v)
    if mode == "backward":
        dr.backward(dr.sum(result))
        return dr.grad(v).numpy()
    dr.forward(v)
    return dr.grad(result).numpy()


@pytest.mark.parametrize("mode", ["forward", "backward"])
def test04_derivatives_are_finite_and_right(mode):
    tau = np.concatenate([[0], TAU[::8], [np.inf]]).astype(np.float32)
    got = slope_of(mean_depth_share, tau, mode)
    assert np.all(np.isfinite(got))
    t = tau[1:-1].astype(float)
    with np.errstate(over="ignore"):
        series = -1 / 12 + t**2 / 240 - t**4 / 6048
        closed = -1 / t**2 + 1 / (4 * np.sinh(np.minimum(t, 600) / 2) ** 2)
    expected = np.where(t < 0.1, series, closed)
    assert np.allclose(got[1:-1], expected, rtol=2e-4, atol=2e-6)
    assert np.isclose(got[0], -1 / 12)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test05_splitting_a_step_changes_nothing(share):
    tau = TAU[TAU < 1e4]
    a, b = ns.Float(tau * np.float32(share)), ns.Float(tau * np.float32(1 - share))
    whole = ns.Float(tau)
    behind = dr.exp(-a) * absorbed_share(b)
    assert np.allclose((absorbed_share(a) + behind).numpy(), absorbed_share(whole).numpy(), rtol=1e-6)
    moment = absorbed_share(a) * share * mean_depth_share(a) + behind * (share + (1 - share) * mean_depth_share(b))
    expected = (absorbed_share(whole) * mean_depth_share(whole)).numpy()
    assert np.allclose(moment.numpy(), expected, rtol=2e-6)


def test06_permuting_steps_preserves_opacity():
    tau = np.random.default_rng(0).exponential(0.1, 64).astype(np.float32)
    opacities = []
    for order in (np.arange(64), np.arange(64)[::-1], np.random.default_rng(1).permutation(64)):
        light, total = 1.0, 0.0
        for share in absorbed_share(ns.Float(tau[order])).numpy():
            total += light * share
            light *= 1 - share
        opacities.append(total)
    assert np.allclose(opacities, -np.expm1(-tau.astype(float).sum()), rtol=1e-6)


# ------------------------------------------------------------------------
#  Density that is linear over a step
# ------------------------------------------------------------------------


def exact_linear_share(a, b):
    """∫ s σ exp(-τ) ds / ∫ σ exp(-τ) ds in float64, by Gauss-Legendre panels to an optical depth of 45 or the end."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    goal = np.minimum(45, (a + b) / 2)
    end = np.minimum(2 * goal / (a + np.sqrt(np.maximum(a * a + 2 * (b - a) * goal, 0))), 1)
    moment = total = 0
    x, w = np.polynomial.legendre.leggauss(24)
    for k in range(8):
        for share, weight in zip((k + (x + 1) / 2) / 8, w):
            s = end * share
            f = weight * (a + (b - a) * s) * np.exp(-(a * s + (b - a) * s * s / 2))
            moment, total = moment + s * f, total + f
    return moment / total


def ends():
    """Pairs of densities times length: from 0 and 1e-8 to 1e9 each, and pairs that hardly differ."""
    grid = np.concatenate([[0], np.logspace(-8, 9, 86)])
    rng = np.random.default_rng(0)
    near = 10 ** rng.uniform(-2, 3, 4000)
    far = np.maximum(near * (1 + rng.normal(size=4000) * 10 ** rng.uniform(-7, 0, 4000)), 0)
    a, b = (np.ravel(v) for v in np.meshgrid(grid, grid))
    return np.concatenate([a[1:], near]).astype(np.float32), np.concatenate([b[1:], far]).astype(np.float32)


def test07_the_linear_reference_agrees_with_closed_forms():
    assert np.allclose(exact_linear_share(TAU[::40], TAU[::40]), exact_share(TAU[::40]), rtol=1e-13)
    # From 0 up a half normal distribution, down to 0 Dawson's integral.
    from scipy.special import dawsn, erf

    c = np.array([3.0, 10, 60, 800, 1e6])
    passed = np.exp(-c / 2)
    assert np.allclose(
        exact_linear_share(0 * c, c), (np.sqrt(np.pi / 2 / c) * erf(np.sqrt(c / 2)) - passed) / (1 - passed), rtol=1e-13
    )
    assert np.allclose(
        exact_linear_share(c, 0 * c), (np.sqrt(2 / c) * dawsn(np.sqrt(c / 2)) - passed) / (1 - passed), rtol=1e-13
    )


def test08_linear_share():
    a, b = ends()
    got = linear_share(ns.Float(a), ns.Float(b)).numpy()
    assert np.abs(got / exact_linear_share(a, b) - 1).max() < 1e-6
    equal = linear_share(ns.Float(TAU), ns.Float(TAU)).numpy()
    assert np.allclose(equal, mean_depth_share(ns.Float(TAU)).numpy(), rtol=1e-6)


@pytest.mark.parametrize("mode", ["forward", "backward"])
@pytest.mark.parametrize("which", [0, 1])
def test09_its_derivatives(which, mode):
    a, b = ends()
    got = slope_of(
        lambda x: linear_share(x, ns.Float(b)) if which == 0 else linear_share(ns.Float(a), x), (a, b)[which], mode
    )
    assert np.all(np.isfinite(got))
    a, b = a.astype(float), b.astype(float)
    # One-sided differences of second order: densities are not negative.
    h = 1e-4 * (np.minimum(np.maximum(a, np.sqrt(a + b)), a + b) if which == 0 else a + b)
    at = lambda k: exact_linear_share(a + k * h * (which == 0), b + k * h * (which == 1))
    want = (4 * at(1) - 3 * at(0) - at(2)) / (2 * h)
    assert np.all(np.abs(got - want) <= 3e-4 * (np.abs(want) + at(0) / (a + b)))


@pytest.mark.parametrize("mode", ["forward", "backward"])
def test10_its_ends(mode):
    a = np.float32([0, 0, 1e-38, np.inf, 1, 1e30, 3e38, 0])
    b = np.float32([0, 1e-38, 0, 1, np.inf, 1e30, 0, 3e38])
    share = linear_share(ns.Float(a), ns.Float(b)).numpy()
    assert np.allclose(share, [0.5, 0.5, 0.5, 0, 0, 0, 0, 0], atol=1e-8)
    assert np.all(np.isfinite(slope_of(lambda x: linear_share(x, ns.Float(b)), a, mode)))
    assert np.all(np.isfinite(slope_of(lambda y: linear_share(ns.Float(a), y), b, mode)))


def test11_the_polynomial_of_thin_steps_is_as_good_as_stated():
    # In double precision, where its coefficients are all that errs.
    total, r = np.meshgrid(np.linspace(2e-3, 2.999, 31), np.linspace(-1, 1, 31))
    a, b = (0.5 * total * (1 - r)).ravel(), (0.5 * total * (1 + r)).ravel()
    assert np.abs(linear_share(ns.Float64(a), ns.Float64(b)).numpy() - exact_linear_share(a, b)).max() < 2e-8
