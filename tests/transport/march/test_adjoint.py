"""Derivatives by marching again, against those that Dr.Jit takes through the march itself, and what they hold in
memory."""

import gc
from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.transport import march as front
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import MarchSettings, march_primal
from nerg_mi.transport.medium import ColorPainter, LocalRay


def scene_of(mi, size, step, quadrature="constant"):
    """Voxels with a colour each: all rays of a camera cross them."""
    rng = np.random.default_rng(2)
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    volume = lambda data: {
        "type": "gridvolume",
        "grid": mi.VolumeGrid(data.astype(np.float32)),
        "to_world": place,
        "raw": True,
    }
    film = {"type": "hdrfilm", "width": size, "height": size, "component_format": "float32", "rfilter": {"type": "box"}}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "nerg",
                "density": volume(0.1 + rng.exponential(1.2, (4, 5, 6))),
                "color": volume(rng.uniform(0.1, 0.9, (4, 5, 6, 3))),
                "step": step,
                "stop": 0.0,
                "color_cutoff": 0.0,
                "quadrature": quadrature,
                "depth": "expected",
                "aovs": "depth,opacity",
            },
            "sensor": {
                "type": "perspective",
                "fov": 20,
                "to_world": mi.ScalarTransform4f().look_at([0.3, 0.2, -3], [0, 0, 0], [0, 1, 0]),
                "film": film,
                "sampler": {"type": "stratified", "jitter": False, "sample_count": 1},
            },
        }
    )


def gradients(mi, scene):
    """Of one weighted sum of all channels with respect to all voxels."""
    params = mi.traverse(scene)
    keys = ["integrator.density.data", "integrator.color.data"]
    for key in keys:
        params[key] = dr.detach(params[key])
        dr.enable_grad(params[key])
    params.update()
    image = mi.render(scene, params, spp=1)
    weights = np.random.default_rng(0).uniform(0.2, 1, image.shape).astype(np.float32)
    dr.backward(dr.sum(image * mi.TensorXf(weights), axis=None))
    return [dr.grad(params[key]).numpy() for key in keys]


@pytest.mark.parametrize("quadrature", ["constant", "linear"])
def test01_equal_to_derivatives_through_the_loop(rgb, monkeypatch, quadrature):
    scene = scene_of(rgb, 5, 0.4, quadrature)
    got = gradients(rgb, scene)

    def through_the_loop(ray, t0, t1, request):
        # Every step is evaluated, and stays in memory until its derivative has been taken.
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
            settings = replace(request.settings, color_cutoff=0.0)
            return march_primal(ray, t0, t1, replace(request, settings=settings))

    called = []
    monkeypatch.setattr(front, "differentiable_march", lambda operation, *a: called.append(1) or through_the_loop(*a))
    expected = gradients(rgb, scene)
    assert called
    for g, e in zip(got, expected):
        assert np.abs(e).max() > 0 and np.linalg.norm(g - e) < 1e-5 * np.linalg.norm(e)


def test02_memory_does_not_grow_with_samples(rgb):
    peaks = []
    for samples in (16, 512):
        scene = scene_of(rgb, 32, 2 / samples)
        gradients(rgb, scene)  # compiles, and makes what stays
        gc.collect()
        dr.sync_thread()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        before = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
        gradients(rgb, scene)
        dr.sync_thread()
        peaks.append(dr.detail.malloc_watermark(dr.JitBackend.LLVM) - before)
    # Storing one number of each sample would add 2 MB.
    assert 0 < peaks[0] < 1e6 and abs(peaks[1] - peaks[0]) < 0.1 * peaks[0], peaks


# ------------------------------------------------------------------------
#  Entry, exit and position, in closed form
# ------------------------------------------------------------------------


class Slanted:
    """Density ``base`` + ``rise`` z, and a colour that is z itself, everywhere."""

    occupancy = cells = step = hits = None

    def __init__(self, base, rise=0.0):
        self.base, self.rise = ns.Float(base), rise

    def parameters(self):
        return [self.base]

    def density(self, p, active):
        return dr.select(active, self.base + self.rise * p.z, 0)

    def density_features(self, p, active):
        return self.density(p, active), [p.z]

    def color(self, features, p, w, active):
        return ns.Array3f(features[0])


def slopes(medium, value, mode, settings, offset=None):
    """Derivative of ``value`` (a function of the march) with respect to entry, exit, the origin's z and the density."""
    z = ns.Array3f(0, 0, 1)
    found = []
    for k in range(4):
        x = [dr.opaque(ns.Float, v) for v in (0.25, 1.125, 0, float(medium.base[0]))]
        dr.enable_grad(*(x if mode == "backward" else [x[k]]))
        medium.base = x[3]
        ray = LocalRay(ns.Array3f(0, 0, x[2]), z, z, dr.opaque(ns.Float, 0), dr.opaque(ns.Float, 2))
        result = value(march(medium, ray, x[0], x[1], True, settings, color=ColorPainter(ns.Array3f), offset=offset))
        if mode == "backward":
            dr.backward(result)
            medium.base = dr.detach(x[3])
            return [dr.grad(v)[0] for v in x]
        dr.forward(x[k])
        medium.base = dr.detach(x[3])
        found.append(dr.grad(result)[0])
    return found


@pytest.mark.parametrize("offset", [None, 0.3])
@pytest.mark.parametrize("quadrature", ["constant", "linear"])
@pytest.mark.parametrize("mode", ["forward", "backward"])
def test03_a_slab_between_entry_and_exit(mode, quadrature, offset):
    sigma, t0, t1 = 1.7, 0.25, 1.125
    length, passed = t1 - t0, np.exp(-1.7 * (1.125 - 0.25))
    settings = MarchSettings(1 / 16, stop=0, color_cutoff=0, quadrature=quadrature)
    offset = None if offset is None else ns.Float(offset)
    of = lambda value: slopes(Slanted(sigma), value, mode, settings, offset)
    assert np.allclose(of(lambda r: r.tau), [-sigma, sigma, 0, length], rtol=1e-5, atol=1e-5)
    # E = t0 + 1 / sigma - L / (exp(sigma L) - 1), the mean distance of absorption, of which the opacity is 1 - passed.
    q = passed / (1 - passed)
    by_length = -q + length * sigma * q / (1 - passed)
    by_density = -1 / sigma**2 + length**2 * q / (1 - passed)
    assert np.allclose(of(lambda r: r.expected_depth), [1 - by_length, by_length, 0, by_density], rtol=1e-4, atol=1e-5)
    half = [1, 0, 0, -np.log(2) / sigma**2]
    assert np.allclose(of(lambda r: r.half), half, rtol=1e-4, atol=1e-5)
    # The colour z is that of the mean absorption: C = opacity (o + E). A step takes it at its middle, or at its mean.
    opacity, mean = 1 - passed, t0 + 1 / sigma - length * q
    want = [
        -sigma * passed * mean + opacity * (1 - by_length),
        sigma * passed * mean + opacity * by_length,
        opacity,
        length * passed * mean + opacity * by_density,
    ]
    assert np.allclose(of(lambda r: r.color.x), want, rtol=2e-2 if quadrature == "constant" else 1e-4)


@pytest.mark.parametrize("mode", ["forward", "backward"])
def test04_density_at_the_ends_is_what_moving_them_takes_in(mode):
    # tau = base (t1 - t0) + rise ((t1 + o)^2 - (t0 + o)^2) / 2, exact by either rule.
    for quadrature in ("constant", "linear"):
        settings = MarchSettings(1 / 16, stop=0, color_cutoff=0, quadrature=quadrature)
        got = slopes(Slanted(0.5, 3.0), lambda r: r.tau, mode, settings)
        assert np.allclose(got, [-(0.5 + 3 * 0.25), 0.5 + 3 * 1.125, 3 * 0.875, 0.875], rtol=1e-4)
