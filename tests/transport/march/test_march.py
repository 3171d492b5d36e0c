"""Tests of `nerg_mi.transport.march`."""

import gc
from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.splats import quaternions_to_matrices
from nerg_mi.transport import march as front
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import MarchSettings, march_primal
from nerg_mi.transport.medium import ColorShader, LocalRay
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.formats.splats.writers import random_splats
from tests.plugins.scenes import plugin
from tests.reference.splats import peaks, trace
from tests.transport.march.test_march_primal import grid, slab
from tests.transport.test_splat_medium import medium_of, rays, stack

# ---- Adjoint ----
#
# Derivatives by marching again, against those of Dr.Jit through the march itself, and their memory.


def scene_of(mi, size, step, quadrature="constant"):
    """Voxels with one colour each, all crossed by camera rays."""
    rng = np.random.default_rng(2)
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    volume = lambda data: plugin("gridvolume", grid=mi.VolumeGrid(data.astype(np.float32)), to_world=place, raw=True)
    film = {"type": "hdrfilm", "width": size, "height": size, "component_format": "float32", "rfilter": {"type": "box"}}
    return mi.load_dict(
        plugin(
            "scene",
            integrator=plugin(
                "nerg",
                density=volume(0.1 + rng.exponential(1.2, (4, 5, 6))),
                color=volume(rng.uniform(0.1, 0.9, (4, 5, 6, 3))),
                step=step,
                stop=0.0,
                color_cutoff=0.0,
                quadrature=quadrature,
                depth="expected",
                aovs="depth,opacity",
            ),
            sensor=plugin(
                "perspective",
                fov=20,
                to_world=mi.ScalarTransform4f().look_at([0.3, 0.2, -3], [0, 0, 0], [0, 1, 0]),
                film=film,
                sampler={"type": "stratified", "jitter": False, "sample_count": 1},
            ),
        )
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
        # Every step is evaluated and stays in memory until it is differentiated.
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
            settings = replace(request.settings, color_cutoff=0.0)
            return march_primal(ray, t0, t1, replace(request, settings=settings))

    called = []
    monkeypatch.setattr(front, "march_differentiably", lambda operation, *a: called.append(1) or through_the_loop(*a))
    expected = gradients(rgb, scene)
    assert called
    for g, e in zip(got, expected):
        assert np.abs(e).max() > 0 and np.linalg.norm(g - e) < 1e-5 * np.linalg.norm(e)


def test02_memory_does_not_grow_with_samples(rgb):
    peaks = []
    for samples in (16, 512):
        scene = scene_of(rgb, 32, 2 / samples)
        gradients(rgb, scene)  # compiles, and allocates what is kept
        gc.collect()
        dr.sync_thread()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        before = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
        gradients(rgb, scene)
        dr.sync_thread()
        peaks.append(dr.detail.malloc_watermark(dr.JitBackend.LLVM) - before)
    # Storing one number per sample would add 2 MB.
    assert 0 < peaks[0] < 1e6 and abs(peaks[1] - peaks[0]) < 0.1 * peaks[0], peaks


# ------------------------------------------------------------------------
#  Entry, exit and position, in closed form
# ------------------------------------------------------------------------


class Slanted:
    """Density ``base`` + ``rise`` z, with the colour z, everywhere."""

    occupancy = cells = step = hits = None
    is_density_separate = False

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
    results = []
    for k in range(4):
        x = [dr.opaque(ns.Float, v) for v in (0.25, 1.125, 0, float(medium.base[0]))]
        dr.enable_grad(*(x if mode == "backward" else [x[k]]))
        medium.base = x[3]
        ray = LocalRay(ns.Array3f(0, 0, x[2]), z, z, dr.opaque(ns.Float, 0), dr.opaque(ns.Float, 2))
        result = value(march(medium, ray, x[0], x[1], True, settings, color=ColorShader(ns.Array3f), offset=offset))
        if mode == "backward":
            dr.backward(result)
            medium.base = dr.detach(x[3])
            return [dr.grad(v)[0] for v in x]
        dr.forward(x[k])
        medium.base = dr.detach(x[3])
        results.append(dr.grad(result)[0])
    return results


@pytest.mark.parametrize("offset", [None, 0.3])
@pytest.mark.parametrize("quadrature", ["constant", "linear"])
@pytest.mark.parametrize("mode", ["forward", "backward"])
def test03_slab_derivatives_in_closed_form(mode, quadrature, offset):
    sigma, t0, t1 = 1.7, 0.25, 1.125
    length, passed = t1 - t0, np.exp(-1.7 * (1.125 - 0.25))
    settings = MarchSettings(1 / 16, stop=0, color_cutoff=0, quadrature=quadrature)
    offset = None if offset is None else ns.Float(offset)
    make = lambda value: slopes(Slanted(sigma), value, mode, settings, offset)
    assert np.allclose(make(lambda r: r.tau), [-sigma, sigma, 0, length], rtol=1e-5, atol=1e-5)
    # E = t0 + 1 / sigma - L / (exp(sigma L) - 1), the mean distance of absorption, of which the opacity is 1 - passed.
    q = passed / (1 - passed)
    by_length = -q + length * sigma * q / (1 - passed)
    by_density = -1 / sigma**2 + length**2 * q / (1 - passed)
    assert np.allclose(
        make(lambda r: r.expected_depth), [1 - by_length, by_length, 0, by_density], rtol=1e-4, atol=1e-5
    )
    half = [1, 0, 0, -np.log(2) / sigma**2]
    assert np.allclose(make(lambda r: r.median_depth), half, rtol=1e-4, atol=1e-5)
    # The colour z is that of the mean absorption: C = opacity (o + E). A step samples it at its middle, or at its mean.
    opacity, mean = 1 - passed, t0 + 1 / sigma - length * q
    want = [
        -sigma * passed * mean + opacity * (1 - by_length),
        sigma * passed * mean + opacity * by_length,
        opacity,
        length * passed * mean + opacity * by_density,
    ]
    assert np.allclose(make(lambda r: r.color.x), want, rtol=2e-2 if quadrature == "constant" else 1e-4)


@pytest.mark.parametrize("mode", ["forward", "backward"])
def test04_derivatives_at_the_ends_equal_the_density(mode):
    # tau = base (t1 - t0) + rise ((t1 + o)^2 - (t0 + o)^2) / 2, exact for both rules.
    for quadrature in ("constant", "linear"):
        settings = MarchSettings(1 / 16, stop=0, color_cutoff=0, quadrature=quadrature)
        got = slopes(Slanted(0.5, 3.0), lambda r: r.tau, mode, settings)
        assert np.allclose(got, [-(0.5 + 3 * 0.25), 0.5 + 3 * 1.125, 3 * 0.875, 0.875], rtol=1e-4)


# ---- Derivatives of splats against float64 central differences, for the ray and the Gaussians ----


# No end of the march, so that the sums are smooth except at the rims of Gaussians.
SETTINGS = MarchSettings(0.01, stop=0.0)
NAMES = ("centers", "scales", "rotations", "opacities", "harmonics")
STEP = 1e-5


class Double:
    """Splats in float64, with one array replaced."""

    def __init__(self, splats, name="", value=None):
        self.degree = splats.degree
        for n in NAMES:
            setattr(self, n, value if n == name else getattr(splats, n).astype(np.float64))

    def axes(self):
        return quaternions_to_matrices(self.rotations / np.linalg.norm(self.rotations, axis=1, keepdims=True))


def outputs(mi, medium, o, d):
    """A number that depends on all sums of a march."""
    ray = medium.ray_to_local(o, d)
    result = march(medium, ray, mi.Float(0), ray.t_far, True, SETTINGS, color=ColorShader(mi.Color3f))
    half = dr.select(dr.isfinite(result.median_depth), result.median_depth, 0)
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
    # The rims of Gaussians, where they jump by a hundredth, do not cross a ray within the step of these differences.
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
        result = (np.array(dr.grad(value)).reshape(base.shape) * along).sum()
        assert abs(wanted) > 0.02 and np.isclose(result, wanted, rtol=1e-3, atol=2e-4), name


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
    result = dr.grad(shift if mode == "backward" else loss)[0]
    assert np.isclose(result, (ends[0] - ends[1]) / (2 * STEP), rtol=1e-3)


@pytest.mark.nightly
def test_memory_does_not_grow_with_hits(rgb):
    medium, count = medium_of(stack(np.arange(1, 151) * 0.5, np.full(150, 0.01))), 1 << 13

    def gradient(end):
        o = rgb.Point3f(dr.linspace(rgb.Float, -0.1, 0.1, count), 0, 0)
        dr.enable_grad(o)
        ray = medium.ray_to_local(o, rgb.Vector3f(0, 0, 1))
        result = march(medium, ray, rgb.Float(0), rgb.Float(end), True, SETTINGS, color=ColorShader(rgb.Color3f))
        dr.backward(result.tau + result.color.x)
        dr.eval(dr.grad(o))
        return result.tau.numpy().mean()

    results, memory = [], []
    for end in (2.2, 80.0):
        gradient(end)
        gc.collect()
        dr.sync_thread()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        before = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
        results.append(gradient(end))
        dr.sync_thread()
        memory.append(dr.detail.malloc_watermark(dr.JitBackend.LLVM) - before)
    # Four hits and 150; one number per hit would take 5 MB.
    assert results[1] > 30 * results[0] > 0 and abs(memory[1] - memory[0]) < 5e5, memory


# ---- Dispatch: primal or differentiable march, and the coarse pre-pass ----


@pytest.fixture
def taken(monkeypatch):
    """One entry per differentiable march."""
    calls, made = [], front.march_differentiably
    monkeypatch.setattr(front, "march_differentiably", lambda *a: calls.append(1) or made(*a))
    return calls


def through(mi, medium, settings, z=None, march=front.march, **overrides):
    ray = medium.ray_to_local(mi.Point3f(0.5, 0.5, 0 if z is None else z), mi.Vector3f(0, 0, 1))
    return march(medium, ray, dr.maximum(ray.t_near, 0), ray.t_far, mi.Bool(True), settings, **overrides)


def test01_differentiable_march_only_with_gradients(rgb, taken):
    settings, medium, z = MarchSettings(0.01), slab(rgb, 2, 1), rgb.Float(0)
    through(rgb, medium, settings, z)
    assert not taken
    dr.enable_grad(z)
    attached = through(rgb, medium, settings, z)
    assert len(taken) == 1 and dr.grad_enabled(attached.expected_depth)
    with dr.suspend_grad():
        through(rgb, medium, settings, z)
    assert len(taken) == 1


def test02_both_marches_give_equal_results(rgb):
    z = rgb.Float(0)
    medium, settings = slab(rgb, 2, 1), MarchSettings(0.01)
    plain = through(rgb, medium, settings, z, count=True)
    dr.enable_grad(z)
    attached = through(rgb, medium, settings, z, count=True)
    for name in (
        "tau",
        "moment",
        "median_depth",
        "median_depth_slope",
        "crossing_start",
        "crossing_start_tau",
        "density_evals",
        "start_distance",
    ):
        assert np.array_equal(getattr(plain, name).numpy(), dr.detach(getattr(attached, name)).numpy()), name
    tracked = {
        name
        for name in ("median_depth", "median_depth_slope", "crossing_start", "crossing_start_tau")
        if dr.grad_enabled(getattr(attached, name))
    }
    assert tracked == {"median_depth"}


def test03_goal_carries_derivatives(rgb):
    goal = rgb.Float(0.4)
    dr.enable_grad(goal)
    result = through(rgb, slab(rgb, 2, 1), MarchSettings(0.01), until=goal)
    dr.backward(result.median_depth)
    # At σ s = goal: the crossing moves by 1 / σ per unit of the goal.
    assert np.isclose(result.median_depth[0], 1.2, rtol=1e-5) and np.isclose(dr.grad(goal)[0], 0.5, rtol=1e-4)


def test04_fine_steps_begin_in_front_of_matter(rgb):
    """One coarse step before the first trace of matter, so that no matter is marched coarsely."""
    for face in (0.3, 0.55, 0.9):
        data = np.zeros((200, 1, 1))
        data[round(200 * face) :] = 30
        medium = grid(rgb, data, filter_type="nearest")
        ray = medium.ray_to_local(rgb.Point3f(0.5, 0.5, 0), rgb.Vector3f(0, 0, 1))
        settings = MarchSettings(0.01, coarse=8)
        start, evals = front.find_fine_start(medium, ray, rgb.Float(0), rgb.Float(1), rgb.Bool(True), settings)
        assert face - 2.1 * 0.08 < start[0] < face and 1 <= evals[0] <= 14
    vacuum = grid(rgb, np.zeros((4, 1, 1)))
    assert front.find_fine_start(vacuum, ray, rgb.Float(0), rgb.Float(1), rgb.Bool(True), settings)[0][0] == np.inf


def test05_prepass_saves_evaluations_and_is_counted(rgb):
    data = np.zeros((200, 1, 1))
    data[150:] = 30
    medium = grid(rgb, data, filter_type="nearest")
    # A medium without an occupancy bound: nothing is skipped, and every step is evaluated.
    medium.bound = None
    fine, coarse = MarchSettings(0.005, stop=1e-6), MarchSettings(0.005, stop=1e-6, coarse=8)
    all_fine, scouted = (through(rgb, medium, s, march=front.march_with_prepass, count=True) for s in (fine, coarse))
    assert np.isclose(all_fine.expected_depth[0], scouted.expected_depth[0], atol=2e-3)
    # Most of the 150 steps in front of matter become 17 of the march and 19 of the pre-pass.
    assert 80 < all_fine.density_evals[0] - scouted.density_evals[0] < 115


def test06_unrequested_results_are_none(rgb):
    sigma, tint = (rgb.load_dict({"type": "constvolume", "value": v}) for v in (2.0, 0.25))
    needs_color = VolumeMedium(sigma, tint)
    assert through(rgb, needs_color, MarchSettings(0.01)).color is None
    gathered = through(rgb, needs_color, MarchSettings(0.01, color_cutoff=0), color=ColorShader(rgb.Color3f))
    assert np.allclose(np.array(gathered.color).ravel(), 0.25 * gathered.opacity[0], rtol=1e-5)
