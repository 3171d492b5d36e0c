"""Derivatives of splats against central differences in float64, of the ray and of what Gaussians are."""

import gc

import drjit as dr
import numpy as np
import pytest

from nerg_mi.fields.splats import matrices_of
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.medium import ColorPainter
from tests.formats.splats.writers import random_splats
from tests.reference.splats import peaks, trace
from tests.transport.media.splats.scenes import medium_of, rays, stack

# Ends nowhere, so that the sums are smooth but for the rims of Gaussians.
SETTINGS = MarchSettings(0.01, stop=0.0)
NAMES = ("centers", "scales", "rotations", "opacities", "harmonics")
STEP = 1e-5


class Double:
    """Splats in float64, with one array of another value."""

    def __init__(self, splats, name="", value=None):
        self.degree = splats.degree
        for n in NAMES:
            setattr(self, n, value if n == name else getattr(splats, n).astype(np.float64))

    def axes(self):
        return matrices_of(self.rotations / np.linalg.norm(self.rotations, axis=1, keepdims=True))


def outputs(mi, medium, o, d):
    """A number that depends on all sums of a march."""
    ray = medium.local(o, d)
    result = march(medium, ray, mi.Float(0), ray.t_far, True, SETTINGS, color=ColorPainter(mi.Color3f))
    half = dr.select(dr.isfinite(result.half), result.half, 0)
    return dr.sum(result.opacity + 0.3 * result.expected_depth + dr.dot(result.color, [0.5, 0.2, 0.1]) + 0.1 * half)


def reference(splats, o, d):
    """The same in float64."""
    opacity, color, expected, _ = trace(splats, o, d, stop=0.0)
    t, absorbed = peaks(splats, o, d)
    order = np.argsort(t, axis=1)
    t, absorbed = (np.take_along_axis(v, order, 1) for v in (t, np.where(t >= 0, absorbed, 0)))
    halved = np.cumprod(1 - absorbed, axis=1) <= 0.5
    half = np.where(halved.any(axis=1), t[np.arange(len(t)), np.argmax(halved, axis=1)], 0)
    return float((opacity + 0.3 * expected + color @ [0.5, 0.2, 0.1] + 0.1 * half).sum())


@pytest.fixture
def case():
    # Rims of Gaussians, where they jump by a hundredth, pass no ray within the step of these differences.
    return random_splats(14, degree=1, size=0.5), *rays(12, size=0.6)


def test_gradients_of_gaussians(rgb, case):
    splats, o, d = case
    medium = medium_of(splats)
    arrays = medium.arrays
    dr.enable_grad(list(arrays.parameters().values()))
    arrays.pack()
    loss = outputs(rgb, medium, rgb.Point3f(o.T), rgb.Vector3f(d.T))
    assert np.isclose(loss[0], reference(Double(splats), o, d), rtol=1e-5)
    dr.backward(loss)
    rng = np.random.default_rng(7)
    for name, value in arrays.parameters().items():
        base = getattr(splats, name).astype(np.float64)
        along = rng.normal(size=base.shape)
        ends = [reference(Double(splats, name, base + s * STEP * along), o, d) for s in (1, -1)]
        wanted = (ends[0] - ends[1]) / (2 * STEP)
        found = (np.array(dr.grad(value)).reshape(base.shape) * along).sum()
        assert abs(wanted) > 0.02 and np.isclose(found, wanted, rtol=1e-3, atol=2e-4), name


@pytest.mark.parametrize("mode", ["backward", "forward"])
def test_gradients_of_rays(rgb, case, mode):
    splats, o, d = case
    along = np.array([0.3, -0.5, 0.8])
    ends = [reference(Double(splats), o + s * STEP * along, d) for s in (1, -1)]
    shift = rgb.Float(0)
    dr.enable_grad(shift)
    at = rgb.Point3f(o.T) + rgb.Vector3f(*along.tolist()) * shift
    loss = outputs(rgb, medium_of(splats), at, rgb.Vector3f(d.T))
    getattr(dr, mode)(loss if mode == "backward" else shift)
    found = dr.grad(shift if mode == "backward" else loss)[0]
    assert np.isclose(found, (ends[0] - ends[1]) / (2 * STEP), rtol=1e-3)


@pytest.mark.nightly
def test_memory_does_not_grow_with_hits(rgb):
    medium, count = medium_of(stack(np.arange(1, 151) * 0.5, np.full(150, 0.01))), 1 << 13

    def gradient(end):
        o = rgb.Point3f(dr.linspace(rgb.Float, -0.1, 0.1, count), 0, 0)
        dr.enable_grad(o)
        ray = medium.local(o, rgb.Vector3f(0, 0, 1))
        result = march(medium, ray, rgb.Float(0), rgb.Float(end), True, SETTINGS, color=ColorPainter(rgb.Color3f))
        dr.backward(result.tau + result.color.x)
        dr.eval(dr.grad(o))
        return result.tau.numpy().mean()

    found, memory = [], []
    for end in (2.2, 80.0):
        gradient(end)
        gc.collect()
        dr.sync_thread()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        before = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
        found.append(gradient(end))
        dr.sync_thread()
        memory.append(dr.detail.malloc_watermark(dr.JitBackend.LLVM) - before)
    # Four hits and 150; a number for each of these would be 5 MB.
    assert found[1] > 30 * found[0] > 0 and abs(memory[1] - memory[0]) < 5e5, memory
