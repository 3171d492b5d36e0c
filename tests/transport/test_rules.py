"""The quadrature rules: what each is exact for, and that every march ends."""
import math
import subprocess
import sys

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.transport.march import MarchSettings, march
from nerg_mi.transport.media import VolumeMedium
from nerg_mi.transport.rules import KINDS, linear_crossing, linear_share, rule

from ..reference import march_numpy as reference


def linear_moments(first, last, n=4000):
    """``(mean absorption distance, distance of half of the optical depth)`` of a linear density over [0, 1]."""
    borders = np.linspace(0, 1, n + 1)
    density = lambda p: first + (last - first) * p[:, 2]  # noqa: E731
    tau, expected, _, _, _ = reference.march(density, (0, 0, 0), (0, 0, 1), borders)
    return tau, expected


@pytest.mark.parametrize("first, last", [(1, 1), (0, 2), (2, 0), (0.1, 5), (30, 1), (1e-5, 3e-5), (0, 200)])
def test01_linear_share(first, last):
    tau, expected = linear_moments(first, last)
    assert np.isclose(tau, (first + last) / 2, rtol=1e-6)
    got = linear_share(ns.Float(first), ns.Float(last)).numpy()[0]
    assert abs(got - expected) < 1e-5


@pytest.mark.parametrize("first, last, length", [(1, 1, 1), (0, 2, 1), (2, 0, 3), (1, 9, 0.1), (5, 1e-3, 1)])
def test02_linear_crossing(first, last, length):
    total = (first + last) / 2 * length
    for share in (0.01, 0.5, 0.99):
        s = linear_crossing(ns.Float(first), ns.Float(last), length, ns.Float(share * total)).numpy()[0]
        assert 0 <= s <= length
        assert np.isclose(first * s + (last - first) * s * s / (2 * length), share * total, rtol=1e-4)


def ramp(mi, n=8, gain=4.0):
    """Density that rises linearly with z between the first and the last voxel centre."""
    data = np.broadcast_to(gain * (np.arange(n) + 0.5)[:, None, None] / n, (n, 2, 2)).astype(np.float32).copy()
    return VolumeMedium(mi.load_dict({"type": "gridvolume", "grid": mi.VolumeGrid(data)}))


def gather(mi, medium, o, d, settings, **kwargs):
    ray = medium.local(mi.Point3f(*map(float, o)), mi.Vector3f(*map(float, d)))
    return march(medium, ray, dr.maximum(ray.t_near, 0), ray.t_far, True, settings, **kwargs)


@pytest.mark.parametrize("kind", ["linear", "cells"])
@pytest.mark.parametrize("step", [0.5, 0.1])
def test03_exact_in_opacity_for_linear_densities(rgb, kind, step):
    # From inside the ramp, where the interpolant is one line.
    medium = ramp(rgb)
    ray = medium.local(rgb.Point3f(0.5, 0.5, 0), rgb.Vector3f(0, 0, 1))
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
        assert np.isclose(gather(rgb, medium, o, d, MarchSettings(1.0, quadrature="cells", stop=0)).tau.numpy()[0], tau, rtol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test05_homogeneous_matter_is_exact_for_every_rule(rgb, kind):
    medium = VolumeMedium(rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(np.full((4, 4, 4), 3, np.float32))}))
    r = gather(rgb, medium, (0.5, 0.5, -1), (0, 0, 1), MarchSettings(0.05, quadrature=kind))
    opacity, expected, median = reference.slab(3, 1, 2)
    assert np.isclose(r.opacity.numpy()[0], opacity, rtol=1e-5)
    assert np.isclose(r.expected_depth.numpy()[0], expected, rtol=1e-4)
    assert np.isclose(r.half.numpy()[0], 1 + math.log(2) / 3, rtol=1e-4)


def test06_wrong_rules(rgb):
    medium = VolumeMedium(rgb.load_dict({"type": "constvolume", "value": 1.0}))
    with pytest.raises(ValueError, match='axis-aligned "gridvolume"'):
        rule("cells", medium)
    with pytest.raises(ValueError, match='"quadrature" must be one of constant, linear, cells, got "simpson"'):
        rule("simpson", medium)


@pytest.mark.parametrize("kind", KINDS)
def test07_every_march_ends(kind):
    # Far away the voxels are as small as the spacing of floats. In a process of its own, which can be ended.
    code = f"""
import nerg_mi, numpy as np, mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
from nerg_mi.transport.march import MarchSettings, march
from nerg_mi.transport.media import VolumeMedium
data = np.full((64, 64, 64), 1.5, np.float32)
data[::2] = 0.5
medium = VolumeMedium(mi.load_dict({{"type": "gridvolume", "grid": mi.VolumeGrid(data)}}))
rng = np.random.default_rng(0)
for distance in (3, 30, 300, 3e4):
    o = (distance * rng.normal(size=(3, 500))).astype(np.float32)
    d = rng.random((3, 500)) - o
    d = (d / np.linalg.norm(d, axis=0)).astype(np.float32)
    ray = medium.local(mi.Point3f(o), mi.Vector3f(d))
    r = march(medium, ray, dr.maximum(ray.t_near, 0), ray.t_far, True, MarchSettings(1 / 64, quadrature="{kind}", stop=0))
    length = np.maximum(ray.t_far.numpy() - ray.t_near.numpy(), 0)
    mean = r.tau.numpy().sum() / length.sum()
    assert 0.95 < mean < 1.05, (distance, mean)
"""
    try:
        run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=25)
    except subprocess.TimeoutExpired:
        pytest.fail("the march does not end")
    assert run.returncode == 0, run.stderr[-1500:]
