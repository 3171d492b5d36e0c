"""Derivatives by marching again, against those that Dr.Jit takes through the march itself, and what they hold in memory."""
import gc
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from nerg_mi.transport import adjoint
from nerg_mi.transport.march import march_primal


def scene_of(mi, size, step, quadrature="constant"):
    """Voxels with a colour each: all rays of a camera cross them."""
    rng = np.random.default_rng(2)
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    volume = lambda data: {"type": "gridvolume", "grid": mi.VolumeGrid(data.astype(np.float32)), "to_world": place, "raw": True}
    film = {"type": "hdrfilm", "width": size, "height": size, "component_format": "float32", "rfilter": {"type": "box"}}
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": "nerg", "density": volume(0.1 + rng.exponential(1.2, (4, 5, 6))),
                       "color": volume(rng.uniform(0.1, 0.9, (4, 5, 6, 3))), "step": step, "stop": 0.0, "color_cutoff": 0.0,
                       "quadrature": quadrature, "depth": "expected", "aovs": "depth,opacity"},
        "sensor": {"type": "perspective", "fov": 20, "to_world": mi.ScalarTransform4f().look_at([0.3, 0.2, -3], [0, 0, 0], [0, 1, 0]),
                   "film": film, "sampler": {"type": "stratified", "jitter": False, "sample_count": 1}},
    })  # fmt: skip


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

    def through_the_loop(medium, ray, t0, t1, active, settings, *more):
        # Every step is evaluated, and stays in memory until its derivative has been taken.
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
            return march_primal(medium, ray, t0, t1, active, replace(settings, color_cutoff=0.0), *more)

    called = []
    monkeypatch.setattr(adjoint, "differentiable_march", lambda *a: called.append(1) or through_the_loop(*a))
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
