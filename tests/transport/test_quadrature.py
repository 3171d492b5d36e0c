"""The quadrature rules: fractions against extended precision, exactness, and a user-defined rule."""

import math
import subprocess
import sys
from dataclasses import dataclass
from fractions import Fraction

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.evaluation import study
from nerg_mi.fields.occupancy import OccupancyGrid
from nerg_mi.maths.arrays import quotient
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.medium import ColorShader, LocalRay, VoxelCells
from nerg_mi.transport.quadrature import (
    RULES,
    MarchStep,
    Registry,
    absorbed_fraction,
    cells_for_rule,
    color_sample_fraction,
    find_linear_crossing,
    linear_mean_depth_fraction,
    mean_depth_fraction,
    register_quadrature,
)
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.evaluation.subjects import make_subject
from tests.plugins.scenes import camera, channels, constant, named, render
from tests.reference import march_numpy as reference

# ---- Constant density: against integrals in extended precision, and invariances ----

TAU = np.logspace(-8, 8, 1601).astype(np.float32)


def exact_share(tau):
    """1/τ - 1/expm1(τ) by rational arithmetic (the series of exp), without cancellation."""
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
    got = mean_depth_fraction(ns.Float(tau)).numpy()
    assert np.all(np.abs(got - exact_share(tau)) <= 1e-6 * exact_share(tau))


def test03_mean_depth_fraction_limits():
    got = mean_depth_fraction(ns.Float([0, 1e-38, 3e38, np.inf])).numpy()
    assert got[0] == pytest.approx(0.5) and got[1] == pytest.approx(0.5) and abs(got[2]) < 1e-34 and abs(got[3]) < 1e-34


def slope_of(function, x, mode):
    """Derivative, lane by lane, of a function of the array ``x``. Forward and reverse mode meet different
    infinities."""
    v = ns.Float(x)
    dr.enable_grad(v)
    result = function(v)
    if mode == "backward":
        dr.backward(dr.sum(result))
        return dr.grad(v).numpy()
    dr.forward(v)
    return dr.grad(result).numpy()


@pytest.mark.parametrize("mode", ["forward", "backward"])
def test04_derivatives_are_finite_and_correct(mode):
    tau = np.concatenate([[0], TAU[::8], [np.inf]]).astype(np.float32)
    got = slope_of(mean_depth_fraction, tau, mode)
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
    full = ns.Float(tau)
    behind = dr.exp(-a) * absorbed_fraction(b)
    assert np.allclose((absorbed_fraction(a) + behind).numpy(), absorbed_fraction(full).numpy(), rtol=1e-6)
    moment = absorbed_fraction(a) * share * mean_depth_fraction(a) + behind * (
        share + (1 - share) * mean_depth_fraction(b)
    )
    expected = (absorbed_fraction(full) * mean_depth_fraction(full)).numpy()
    assert np.allclose(moment.numpy(), expected, rtol=2e-6)


# ------------------------------------------------------------------------
#  Linear density
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
    """Pairs of densities times length: from 0 and 1e-8 to 1e9 each, and nearly equal pairs."""
    grid = np.concatenate([[0], np.logspace(-8, 9, 86)])
    rng = np.random.default_rng(0)
    near = 10 ** rng.uniform(-2, 3, 4000)
    far = np.maximum(near * (1 + rng.normal(size=4000) * 10 ** rng.uniform(-7, 0, 4000)), 0)
    a, b = (np.ravel(v) for v in np.meshgrid(grid, grid))
    return np.concatenate([a[1:], near]).astype(np.float32), np.concatenate([b[1:], far]).astype(np.float32)


def test07_the_linear_reference_agrees_with_closed_forms():
    assert np.allclose(exact_linear_share(TAU[::40], TAU[::40]), exact_share(TAU[::40]), rtol=1e-13)
    # From 0 up a half-normal distribution, down to 0 Dawson's integral.
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
    got = linear_mean_depth_fraction(ns.Float(a), ns.Float(b)).numpy()
    assert np.abs(got / exact_linear_share(a, b) - 1).max() < 1e-6
    equal = linear_mean_depth_fraction(ns.Float(TAU), ns.Float(TAU)).numpy()
    assert np.allclose(equal, mean_depth_fraction(ns.Float(TAU)).numpy(), rtol=1e-6)


@pytest.mark.parametrize("mode", ["forward", "backward"])
@pytest.mark.parametrize("which", [0, 1])
def test09_linear_mean_depth_derivatives(which, mode):
    a, b = ends()
    got = slope_of(
        lambda x: (
            linear_mean_depth_fraction(x, ns.Float(b)) if which == 0 else linear_mean_depth_fraction(ns.Float(a), x)
        ),
        (a, b)[which],
        mode,
    )
    assert np.all(np.isfinite(got))
    a, b = a.astype(float), b.astype(float)
    # One-sided differences of second order: densities are not negative.
    h = 1e-4 * (np.minimum(np.maximum(a, np.sqrt(a + b)), a + b) if which == 0 else a + b)
    at = lambda k: exact_linear_share(a + k * h * (which == 0), b + k * h * (which == 1))
    want = (4 * at(1) - 3 * at(0) - at(2)) / (2 * h)
    assert np.all(np.abs(got - want) <= 3e-4 * (np.abs(want) + at(0) / (a + b)))


@pytest.mark.parametrize("mode", ["forward", "backward"])
def test10_mean_depth_fraction_limits(mode):
    a = np.float32([0, 0, 1e-38, np.inf, 1, 1e30, 3e38, 0])
    b = np.float32([0, 1e-38, 0, 1, np.inf, 1e30, 0, 3e38])
    share = linear_mean_depth_fraction(ns.Float(a), ns.Float(b)).numpy()
    assert np.allclose(share, [0.5, 0.5, 0.5, 0, 0, 0, 0, 0], atol=1e-8)
    assert np.all(np.isfinite(slope_of(lambda x: linear_mean_depth_fraction(x, ns.Float(b)), a, mode)))
    assert np.all(np.isfinite(slope_of(lambda y: linear_mean_depth_fraction(ns.Float(a), y), b, mode)))


def test11_polynomial_of_thin_steps_is_accurate():
    # In double precision, where only its coefficients cause errors.
    total, r = np.meshgrid(np.linspace(2e-3, 2.999, 31), np.linspace(-1, 1, 31))
    a, b = (0.5 * total * (1 - r)).ravel(), (0.5 * total * (1 + r)).ravel()
    assert (
        np.abs(linear_mean_depth_fraction(ns.Float64(a), ns.Float64(b)).numpy() - exact_linear_share(a, b)).max() < 2e-8
    )


# ---- Registry: registration, unknown names, and order ----


@dataclass(frozen=True)
class Entry:
    name: str
    summary: str


@pytest.fixture
def things():
    made = Registry("flavour")
    for name, summary in (("sweet", "like honey"), ("bitter", "like tea")):
        made.register(Entry(name, summary))
    return made


def test01_names_keep_registration_order(things):
    assert things.names() == ("sweet", "bitter") and [t.name for t in things] == ["sweet", "bitter"]
    assert things.find("bitter").summary == "like tea"
    assert things.format_manual() == "``sweet``: like honey. ``bitter``: like tea."


def test02_unknown_name_lists_alternatives(things):
    with pytest.raises(NergError, match='"flavour".*"sour"'):
        things.find("sour")


def test03_duplicate_names_are_refused_and_can_be_removed(things):
    again = Entry("sweet", "like sugar")
    with pytest.raises(ValueError, match='"sweet".*"flavour"'):
        things.register(again)
    things.unregister("sweet")
    assert things.register(again) is again and things.names() == ("bitter", "sweet")
    with pytest.raises(KeyError):
        things.unregister("sour")


# ---- The quadrature rules: exactness, and termination of every march ----


def linear_moments(first, last, n=4000):
    """``(mean absorption distance, distance of half of the optical depth)`` of a linear density over [0, 1]."""
    borders = np.linspace(0, 1, n + 1)
    density = lambda p: first + (last - first) * p[:, 2]
    tau, expected, _, _, _ = reference.march(density, (0, 0, 0), (0, 0, 1), borders)
    return tau, expected


@pytest.mark.parametrize("first, last", [(1, 1), (0, 2), (2, 0), (0.1, 5), (30, 1), (1e-5, 3e-5), (0, 200)])
def test01_linear_share(first, last):
    tau, expected = linear_moments(first, last)
    assert np.isclose(tau, (first + last) / 2, rtol=1e-6)
    got = linear_mean_depth_fraction(ns.Float(first), ns.Float(last)).numpy()[0]
    assert abs(got - expected) < 1e-5


@pytest.mark.parametrize("first, last, length", [(1, 1, 1), (0, 2, 1), (2, 0, 3), (1, 9, 0.1), (5, 1e-3, 1)])
def test02_linear_crossing(first, last, length):
    total = (first + last) / 2 * length
    for share in (0.01, 0.5, 0.99):
        s = find_linear_crossing(ns.Float(first), ns.Float(last), length, ns.Float(share * total)).numpy()[0]
        assert 0 <= s <= length
        assert np.isclose(first * s + (last - first) * s * s / (2 * length), share * total, rtol=1e-4)


def ramp(mi, n=8, gain=4.0):
    """Density that increases linearly with z between the first and the last voxel centre."""
    data = np.broadcast_to(gain * (np.arange(n) + 0.5)[:, None, None] / n, (n, 2, 2)).astype(np.float32).copy()
    return VolumeMedium(mi.load_dict({"type": "gridvolume", "grid": mi.VolumeGrid(data)}))


def gather(mi, medium, o, d, settings, **kwargs):
    ray = medium.ray_to_local(mi.Point3f(*map(float, o)), mi.Vector3f(*map(float, d)))
    return march(medium, ray, dr.maximum(ray.t_near, 0), ray.t_far, True, settings, **kwargs)


@pytest.mark.parametrize("kind", ["linear", "cells"])
@pytest.mark.parametrize("step", [0.5, 0.1])
def test03_exact_in_opacity_for_linear_densities(rgb, kind, step):
    # From inside the ramp, where the interpolant is one line.
    medium = ramp(rgb)
    ray = medium.ray_to_local(rgb.Point3f(0.5, 0.5, 0), rgb.Vector3f(0, 0, 1))
    r = march(medium, ray, rgb.Float(0.0625), rgb.Float(0.9375), True, MarchSettings(step, quadrature=kind, stop=0))
    assert np.isclose(r.tau.numpy()[0], 2 * (0.9375**2 - 0.0625**2), rtol=1e-5)


def test04_cells_are_exact_in_opacity_for_any_grid(rgb):
    data = np.random.default_rng(0).exponential(1, (5, 4, 6)).astype(np.float32)
    medium = VolumeMedium(rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(data)}))
    rng = np.random.default_rng(2)
    for _ in range(5):
        o = rng.uniform(-1, 0, 3)
        d = rng.uniform(0.2, 0.8, 3) - o
        d /= np.linalg.norm(d)
        near, far = reference.box(o, d, (0, 0, 0), (1, 1, 1))
        tau = reference.march(lambda p: reference.trilinear(data, p), o, d, np.linspace(near, far, 8001))[0]
        assert np.isclose(
            gather(rgb, medium, o, d, MarchSettings(1.0, quadrature="cells", stop=0)).tau.numpy()[0], tau, rtol=1e-4
        )


@pytest.mark.parametrize("kind", RULES.names())
def test05_homogeneous_matter_is_exact_for_all_rules(rgb, kind):
    medium = VolumeMedium(
        rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(np.full((4, 4, 4), 3, np.float32))})
    )
    r = gather(rgb, medium, (0.5, 0.5, -1), (0, 0, 1), MarchSettings(0.05, quadrature=kind))
    opacity, expected, median = reference.slab(3, 1, 2)
    assert np.isclose(r.opacity.numpy()[0], opacity, rtol=1e-5)
    assert np.isclose(r.expected_depth.numpy()[0], expected, rtol=1e-4)
    assert np.isclose(r.median_depth.numpy()[0], 1 + math.log(2) / 3, rtol=1e-4)


def test06_invalid_rules_are_refused(rgb):
    medium = VolumeMedium(rgb.load_dict({"type": "constvolume", "value": 1.0}))
    with pytest.raises(ValueError, match='axis-aligned "gridvolume"'):
        cells_for_rule(RULES.find("cells"), medium)
    with pytest.raises(ValueError, match='"quadrature".*"simpson"'):
        RULES.find("simpson")


class Colored:
    """Density and colour that depend on z only: ``density(z, x)``, ``color(z)``; ``x`` carries the gradients."""

    occupancy = cells = step = hits = None
    is_density_separate = False

    def __init__(self, density, color, x):
        self._density, self._color, self.x = density, color, x

    def parameters(self):
        return [self.x]

    def density(self, p, active):
        return dr.select(active, self._density(p.z, self.x), 0)

    def density_features(self, p, active):
        return self.density(p, active), [p.z]

    def color(self, features, p, w, active):
        return ns.Array3f(self._color(features[0]))


def along_z(medium, n, **controls):
    z, t0, t1 = ns.Array3f(0, 0, 1), dr.opaque(ns.Float, 0), dr.opaque(ns.Float, 1)
    ray = LocalRay(ns.Array3f(0), z, z, t0, t1)
    return march(
        medium,
        ray,
        t0,
        t1,
        True,
        MarchSettings(1 / n, stop=0, color_cutoff=0, **controls),
        color=ColorShader(ns.Array3f),
    )


@pytest.mark.parametrize("n", [1, 3, 10, 64])
def test08_wall_color_ignores_the_air_in_front(n):
    wall = lambda z, x: dr.select((z > 0.487) & (z < 0.513 + 1 / n), 1e4 * x, 1e-6)
    tint = lambda z: dr.select((z > 0.48) & (z < 0.52 + 1 / n), 0.25, -9)
    r = along_z(Colored(wall, tint, ns.Float(1)), n, quadrature="linear")
    if r.opacity.numpy()[0] > 0.5:
        assert np.isclose(np.array(r.color)[0, 0], 0.25, rtol=1e-3)
    assert n < 3 or r.opacity.numpy()[0] > 0.5


def smooth(z, x, exp=dr.exp, sin=dr.sin):
    return x * 4 * exp(-2 * z) * (1.2 + sin(9 * z))


def test09_color_converges_with_second_order():
    tint = lambda z, exp=dr.exp: exp(-z) * z
    total = reference.march(
        lambda p: smooth(p[:, 2], 1, np.exp, np.sin),
        (0, 0, 0),
        (0, 0, 1),
        np.linspace(0, 1, 20001),
        lambda p: tint(p[:, 2:], np.exp),
    )[3][0]
    errors = [
        abs(np.array(along_z(Colored(smooth, tint, ns.Float(1)), n, quadrature="linear").color)[0, 0] - total)
        for n in (8, 16, 32, 64)
    ]
    assert errors[3] < errors[0] / 40, errors


def test10_color_derivatives_match_the_shown_color():
    # The sample position of the colour moves with the density, and the colour with it.
    tint = lambda z: dr.sin(7 * z)
    for density in (smooth, lambda z, x: x * dr.select(z > 0.43, 30.0, 0.5)):
        x = ns.Float(1)
        dr.enable_grad(x)
        dr.backward(dr.sum(along_z(Colored(density, tint, x), 6, quadrature="linear").color.x))
        shown = [
            along_z(Colored(density, tint, ns.Float(1 + h)), 6, quadrature="linear").color.x[0] for h in (-4e-3, 4e-3)
        ]
        assert np.isclose(dr.grad(x)[0], (shown[1] - shown[0]) / 8e-3, rtol=3e-3)


@pytest.mark.parametrize("gain", [1, 100, 1e4])
def test11_cells_rule_steps_between_voxel_boundaries(rgb, gain):
    data = (gain * np.random.default_rng(0).exponential(1, (8, 8, 8))).astype(np.float32)
    medium = VolumeMedium(rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(data), "raw": True}))
    o, d = np.array((0.21, 0.34, -1)), np.array((0.1, 0.17, 1)) / math.sqrt(1 + 0.1**2 + 0.17**2)
    near, far = reference.box(o, d, (0, 0, 0), (1, 1, 1))
    borders = np.unique(
        np.concatenate([np.linspace(near, far, 20001), np.linspace(near, min(far, near + 100 / gain), 20001)])
    )
    tau, expected, _, _, _ = reference.march(lambda p: reference.trilinear(data, p), o, d, borders)
    r = gather(rgb, medium, o, d, MarchSettings(1e-3, quadrature="cells", stop=0), count=True)
    assert np.isclose(r.tau.numpy()[0], tau, rtol=1e-5)
    # The density is the line through two samples of a cubic: accurate to about a hundredth of a voxel.
    assert abs(r.expected_depth.numpy()[0] - expected) < 0.015 / 8
    assert r.density_evals.numpy()[0] <= 2 * (9 + 3 + 3)
    short = gather(rgb, medium, o, d, MarchSettings(1e-3, quadrature="cells", stop=0, cell_step=1 / 80), count=True)
    assert short.density_evals.numpy()[0] > 2 * 80 and abs(short.expected_depth.numpy()[0] - expected) < 2e-4 / 8


@pytest.mark.parametrize("offset", [None, 0.4])
def test12_skipping_resets_the_carried_density(offset):
    # Increasing density everywhere; steps with their middle in an empty cell are skipped, the others are trapezia.
    rise = lambda z, x: 1 + 6 * z * z
    medium, n, occupied = Colored(rise, lambda z: z, ns.Float(1)), 32, np.array([1, 0, 1, 1, 0, 0, 0, 1], bool)
    bits = np.broadcast_to(occupied[:, None, None], (8, 2, 2))
    medium.occupancy, medium.to_unit, medium.vector_to_unit = OccupancyGrid(bits, ns, 0), lambda p: p, lambda d: d
    z, t0, t1 = ns.Array3f(0, 0, 1), dr.opaque(ns.Float, 0), dr.opaque(ns.Float, 1)
    ray = LocalRay(ns.Array3f(0.3, 0.3, 0), z, z, t0, t1)
    share = None if offset is None else ns.Float(offset)
    got = march(medium, ray, t0, t1, True, MarchSettings(1 / n, stop=0, quadrature="linear"), offset=share, count=True)
    first = 1 if offset is None else offset
    borders = np.minimum(np.concatenate([[0], (first + np.arange(n + 1)) / n]), 1)
    a, b = borders[:-1], borders[1:]
    selected = (b > a) & occupied[np.minimum((4 * (a + b)).astype(int), 7)]
    ends = 1 + 6 * np.stack([a, b]) ** 2
    assert np.isclose(got.tau[0], (ends.mean(0) * (b - a))[selected].sum(), rtol=1e-5)
    # A shared end of two steps is evaluated once.
    assert got.density_evals[0] == selected.sum() + np.count_nonzero(
        selected & ~np.concatenate([[False], selected[:-1]])
    )


@pytest.mark.parametrize("kind", RULES.names())
def test07_every_march_ends(kind):
    # Far from the origin, voxels are as small as the spacing of floats. In a separate process, which can be terminated.
    code = f"""
import nerg_mi, numpy as np, mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
from nerg_mi.fields.occupancy import OccupancyGrid
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.medium import LocalRay
from nerg_mi.transport.volume_medium import VolumeMedium
data = np.full((64, 64, 64), 1.5, np.float32)
data[::2] = 0.5
medium = VolumeMedium(mi.load_dict({{"type": "gridvolume", "grid": mi.VolumeGrid(data)}}))
rng = np.random.default_rng(0)
for distance in (3, 30, 300, 3e4):
    o = (distance * rng.normal(size=(3, 500))).astype(np.float32)
    d = rng.random((3, 500)) - o
    d = (d / np.linalg.norm(d, axis=0)).astype(np.float32)
    ray = medium.ray_to_local(mi.Point3f(o), mi.Vector3f(d))
    settings = MarchSettings(1 / 64, quadrature="{kind}", stop=0)
    r = march(medium, ray, dr.maximum(ray.t_near, 0), ray.t_far, True, settings)
    length = np.maximum(ray.t_far.numpy() - ray.t_near.numpy(), 0)
    mean = r.tau.numpy().sum() / length.sum()
    assert 0.95 < mean < 1.05, (distance, mean)
"""
    try:
        run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=25)
    except subprocess.TimeoutExpired:
        pytest.fail("the march does not end")
    assert run.returncode == 0, run.stderr[-1500:]


def test13_color_sample_position():
    # At the mean absorption for equal ends, at the denser end where the other is empty, in between by the square of (b
    # - a) / (a + b).
    first, last = ns.Float([2, 0, 5, 1, 3, 1, 0]), ns.Float([2, 5, 0, 3, 1, 4, 0])
    got = color_sample_fraction(first, last, ns.Float(0.4)).numpy()
    assert np.allclose(got, [0.4, 1, 0, 0.4 + 0.6 / 4, 0.4 - 0.4 / 4, 0.4 + 0.6 * 0.36, 0.4], rtol=1e-5)


def test14_cells_rule_with_features(rgb):
    """For homogeneous density with a colour linear in depth, which steps of any length integrate exactly."""
    medium = Colored(lambda z, x: 3 * x + 0 * z, lambda z: z, ns.Float(1))
    medium.cells = VoxelCells((0, 0, 0), (1, 1, 1), (4, 4, 4), 0.5)
    shown = np.array(along_z(medium, 8, quadrature="cells").color)[0, 0]
    # ∫ z σ exp(-σ z) dz over [0, 1]
    assert np.isclose(shown, (1 - np.exp(-3) * (1 + 3)) / 3, rtol=1e-5)


@pytest.mark.parametrize("kind", RULES.names())
def test15_inactive_steps_add_nothing(kind):
    """For any carry of the previous step: lanes can end between two steps."""
    rule, z = RULES.find(kind), ns.Array3f(0, 0, 1)
    medium = Colored(lambda z, x: 3 * x + 0 * z, lambda z: z, ns.Float(1))
    ray, t, delta = LocalRay(ns.Array3f(0), z, z, ns.Float(0), ns.Float(2)), ns.Float(0), ns.Float(0.5)
    taken = rule.step(medium, ray, t, delta, t + delta, rule.init_carry(ns.Float), ns.Bool(True), False)
    left = rule.step(medium, ray, t + delta, delta, t + 2 * delta, taken.carry, ns.Bool(False), False)
    assert np.isclose(taken.dtau[0], 1.5) and (left.dtau[0], left.evals[0]) == (0, 0)


# ---- A user-defined rule is one object: it marches, renders, is differentiable and appears in the manual ----


class Simpson:
    """Three samples per step, which integrate cubic densities exactly."""

    name = "simpson"
    summary = "three samples a step"
    ends_at_cells = False

    def init_carry(self, Float):
        return None

    def step(self, medium, ray, t, delta, t_next, carry, active, needs_color) -> MarchStep:
        first, middle, last = (medium.density(ray.o + ray.d * (t + s * delta), active) for s in (0, 0.5, 1))
        dtau = dr.select(active, (first + 4 * middle + last) * delta / 6, 0)
        p = ray.o + ray.d * (t + 0.5 * delta)
        return MarchStep(
            dtau,
            linear_mean_depth_fraction(first * delta, last * delta),
            lambda missing: delta * quotient(missing, dr.select(dtau > 0, dtau, 1)),
            lambda painter, lit: painter.shade(medium, medium.density_features(p, lit)[1], p, ray.w, lit),
            None,
            dr.select(active, 3.0, 0.0),
            t + 0.5 * delta,
        )


@pytest.fixture
def simpson():
    rule = register_quadrature(Simpson())
    yield rule
    RULES.unregister("simpson")


class Cubic:
    """Density 2 + z³ times ``gain``."""

    occupancy = cells = step = hits = None

    def __init__(self, gain=1.0):
        self.gain = ns.Float(gain)

    def parameters(self):
        return [self.gain]

    def density(self, p, active):
        return dr.select(active, self.gain * (2 + p.z * p.z * p.z), 0)


def marched(medium, rule, n):
    z, t0, t1 = ns.Array3f(0, 0, 1), dr.opaque(ns.Float, 0), dr.opaque(ns.Float, 2)
    settings = MarchSettings(2 / n, stop=0, quadrature=rule)
    return march(medium, LocalRay(ns.Array3f(0), z, z, t0, t1), t0, t1, True, settings, count=True)


def test01_registered_rule_marches(simpson):
    result = marched(Cubic(), "simpson", 1)
    # ∫ 2 + z³ over [0, 2]
    assert np.isclose(result.tau[0], 8, rtol=1e-5) and result.density_evals[0] == 3
    assert abs(marched(Cubic(), "constant", 1).tau[0] - 8) > 1


def test02_registered_rule_is_differentiable(simpson):
    medium = Cubic()
    dr.enable_grad(medium.gain)
    dr.backward(marched(medium, "simpson", 5).tau)
    assert np.isclose(dr.grad(medium.gain)[0], 8, rtol=1e-5)


def test03_registered_rule_renders(rgb, simpson):
    sensor = camera(rgb, (0.5, 0.4, -3), (0.5, 0.5, 0.5))
    tint = {"type": "constvolume", "value": 0.25}
    pictures, counts = [], []
    for rule in ("simpson", "constant"):
        requested = constant(2.0, color=tint, quadrature=rule, step=0.05, aovs="opacity,depth,density_evals")
        picture = render(rgb, requested, sensor)
        pictures.append(picture[..., :-1])
        counts.append(named(rgb, picture, requested)["density_evals.Y"])
    assert counts[0].any() and np.array_equal(counts[0], 3 * counts[1])
    # For homogeneous density every rule is exact.
    assert pictures[1][..., :3].max() > 0.1 and np.allclose(*pictures, rtol=1e-4, atol=1e-6)


def test04_registered_rule_with_shapes_and_all_depths(rgb, simpson):
    plate = {"type": "rectangle", "to_world": rgb.ScalarTransform4f().translate([0, 0, 0.7])}
    for depth in ("median", "refined"):
        result = [
            channels(rgb, constant(5.0, quadrature=rule, depth=depth, step=0.03), plate=plate)["depth.T"]
            for rule in ("simpson", "constant")
        ]
        assert result[1].any() and np.allclose(*result, rtol=1e-4)


def test05_registered_rule_is_listed(rgb, simpson):
    subject = make_subject(1.0)
    assert {s.params.get("quadrature") for s in study.list_rows(subject)} >= {"constant", "linear", "simpson"}
    assert RULES.format_manual().endswith("``simpson``: three samples a step.")
