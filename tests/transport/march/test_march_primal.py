"""Tests of `nerg_mi.transport.march_primal`."""

import math
from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.occupancy import OccupancyGrid
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.maths.geometry import Box
from nerg_mi.transport.depth import DEPTHS, MarchContext, penetration_depth
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import (
    DEFAULT_HITS_STOP,
    MarchResult,
    MarchSettings,
    OcclusionQuery,
    default_step,
    default_stop,
    next_step,
    skip_empty_cells,
    step_length,
)
from nerg_mi.transport.medium import ColorShader, VoxelCells
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.occlusion import trace_from_observer
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.formats.splats.writers import random_splats
from tests.reference import march_numpy as reference
from tests.reference.splats import trace
from tests.transport.test_splat_medium import medium_of, rays, stack

# ---- Hits ----
#
# Depth, opacity and colour of Gaussian splats against closed forms and a brute-force float64 reference.

SETTINGS = MarchSettings(0.01, stop=DEFAULT_HITS_STOP)


def marched(mi, medium, o, d, t1=np.inf, kinds=("expected", "median", "refined"), **options):
    """``(result, depth of each kind)``."""
    ray = medium.ray_to_local(mi.Point3f(np.atleast_2d(o).T), mi.Vector3f(np.atleast_2d(d).T))
    t0, t1, active = dr.maximum(ray.t_near, 0), dr.minimum(ray.t_far, t1), mi.Bool(True)
    result = march(medium, ray, t0, t1, active, SETTINGS, **options)
    depths = [DEPTHS.find(k).inside(MarchContext(result, medium, ray, t0, t1, active, SETTINGS)).numpy() for k in kinds]
    return result, depths


def test_random_splats_match_float64(rgb):
    splats, (o, d) = random_splats(60, degree=3, size=0.3), rays(400)
    medium = medium_of(splats)
    result, depths = marched(rgb, medium, o, d, color=ColorShader(rgb.Color3f), count=True)
    opacity, color, expected, median = trace(splats, o, d, stop=DEFAULT_HITS_STOP)
    assert np.abs(result.opacity.numpy() - opacity).max() < 2e-6
    assert np.abs(result.color.numpy().T - color).max() < 5e-6
    assert np.abs(depths[0] - expected).max() < 1e-5
    # Due to rounding, either of two Gaussians can reach half of the opacity.
    assert (np.abs(depths[1] - median) < 1e-5).mean() > 0.995 and np.array_equal(depths[1], depths[2])
    assert result.color_evals.numpy().mean() < result.density_evals.numpy().mean() < 200


def test_stacked_gaussians_match_manual_sums(rgb):
    medium = medium_of(stack([3, 1, 2], [0.5, 0.3, 0.8]))
    result, depths = marched(rgb, medium, (0, 0, 0), (0, 0, 1))
    weights = np.array([0.3, 0.7 * 0.8, 0.7 * 0.2 * 0.5])
    assert np.isclose(result.opacity[0], weights.sum(), atol=1e-6)
    assert (
        np.isclose(depths[0][0], weights @ [1, 2, 3] / weights.sum(), atol=1e-6) and depths[1][0] == depths[2][0] == 2
    )
    # A ray that ends in front of the second, as on a shape, and one that starts in the middle of the third.
    result, depths = marched(rgb, medium, (0, 0, 0), (0, 0, 1), t1=1.9)
    assert np.isclose(result.opacity[0], 0.3, atol=1e-6) and np.isclose(depths[1][0], 1)
    result, _ = marched(rgb, medium, (0, 0, 2.9999), (0, 0, 1))
    assert np.isclose(result.opacity[0], 0.5, atol=1e-5)
    result, depths = marched(rgb, medium, (0, 0, 3.001), (0, 0, 1))
    assert result.opacity[0] == 0 and depths[0][0] == depths[1][0] == 0


def test_off_axis_opacity_is_the_gaussian(rgb):
    result, depths = marched(rgb, medium_of(stack([2], [0.8])), (0.15, 0, 0), (0, 0, 1))
    assert np.isclose(result.opacity[0], 0.8 * np.exp(-0.5 * 1.5**2), atol=1e-6) and np.isclose(depths[0][0], 2)
    result, _ = marched(rgb, medium_of(stack([2], [0.8])), (0.31, 0, 0), (0, 0, 1))
    assert result.opacity[0] == 0


def test_opaque_gaussian_occludes(rgb):
    result, depths = marched(rgb, medium_of(stack([1, 2], [1, 1])), (0, 0, 0), (0, 0, 1))
    assert result.opacity[0] >= 0.9999 and np.isclose(depths[0][0], 1, atol=2e-4) and result.median_depth[0] == 1
    assert penetration_depth("median", result, result.median_depth)[0] == 0


@pytest.mark.parametrize(("before", "hides", "decided", "far"), [(1.5, 1.4, True, True), (3, 2.9, True, False)])
def test_occlusion_query_ends_the_march(rgb, before, hides, decided, far):
    medium = medium_of(stack([2, 4], [0.9, 0.9]))
    question = OcclusionQuery(rgb.Float(before), rgb.Float(hides), 0.5)
    result, _ = marched(rgb, medium, (0, 0, 0), (0, 0, 1), kinds=(), occlusion=question)
    assert result.decided[0] == decided and np.isinf(result.median_depth[0]) == far


def test_default_stop_of_splats(rgb):
    medium = medium_of(stack([2], [0.9]))
    assert default_stop(medium) == DEFAULT_HITS_STOP and default_stop(None) == MarchSettings.stop


# ---- Occlusion ----
#
# Rays that end once the occlusion query is decided: the same answers with fewer evaluations.

COUNT = 2000


@pytest.fixture
def clouds(rgb):
    """A scene of air, fog and walls, with points that cameras and observers look at from all sides."""
    rng = np.random.default_rng(0)
    data = np.where(rng.random((12, 12, 12)) < 0.25, np.exp(rng.uniform(-2, 6, (12, 12, 12))), 0)
    grid = rgb.VolumeGrid(data.astype(np.float32)[..., None])
    medium = VolumeMedium(rgb.load_dict({"type": "gridvolume", "grid": grid, "filter_type": "nearest"}))
    turned = rng.normal(size=(2, COUNT, 3))
    positions = 0.5 + 2 * turned / np.linalg.norm(turned, axis=-1, keepdims=True)
    return SceneGeometry(medium), *positions, rng.uniform(0.1, 0.9, (COUNT, 3))


def sights(mi, clouds, settings, falloff):
    """For all points, with full rays and with early ends."""
    place, camera, observer, at = clouds
    o, d = camera, (at - camera) / np.linalg.norm(at - camera, axis=1, keepdims=True)
    ray = mi.Ray3f(mi.Point3f(o.T), mi.Vector3f(d.T))
    metadata = place, ray, mi.Point3f(at.T), mi.Point3f(observer.T), 0, mi.Bool(True), mi.Float(falloff), settings
    return [trace_from_observer(*metadata, count=True, needs_depth=full) for full in (True, False)]


@pytest.mark.parametrize(
    "depth, surface_opacity, falloff",
    [("median", 0.5, 0.2), ("median", 0.9, 0.0), ("median", 0.0, 0.1), ("refined", 0.3, 0.05), ("expected", 0.5, 0.1)],
)
def test_occlusion_query_matches_full_march(rgb, clouds, depth, surface_opacity, falloff):
    settings = ObserverSettings(march=MarchSettings(0.02), depth=depth, surface_opacity=surface_opacity, tolerance=0.05)
    full, short = sights(rgb, clouds, settings, falloff)
    seen, evaluations = full.visibility.numpy(), [s.density_evals.numpy().mean() for s in (full, short)]
    assert np.array_equal(short.visibility.numpy(), seen)
    assert 0.1 < seen.mean() < 0.9
    # Where gaze is not 0, its surface point is the same.
    assert np.array_equal(np.array(short.p_od)[:, seen > 0], np.array(full.p_od)[:, seen > 0])
    if depth == "expected":
        # Matter behind the point moves a mean: there is no early end.
        assert evaluations[0] == evaluations[1]
    else:
        assert evaluations[1] < 0.9 * evaluations[0]


def test_depth_of_hidden_points_is_in_front(rgb, clouds):
    settings = ObserverSettings(march=MarchSettings(0.02), tolerance=0.05)
    full, short = sights(rgb, clouds, settings, 0.0)
    hidden = full.visibility.numpy() == 0
    before = np.linalg.norm(clouds[3] - clouds[2], axis=1)[hidden]
    assert np.all(short.depth.numpy()[hidden] < before)
    # On opaque rays the surface itself; on others it lies behind.
    result, surface = short.depth.numpy()[hidden], full.depth.numpy()[hidden]
    assert np.mean(np.isclose(result, surface, rtol=1e-5)) > 0.5 and np.all(result > surface - 1e-4)


def test_occlusion_query_with_shapes(rgb, clouds):
    ball = {"type": "sphere", "center": [0.5, 0.5, 0.5], "radius": 0.3}
    scene = rgb.load_dict({"type": "scene", "ball": ball})
    place = SceneGeometry(clouds[0].medium, scene)
    settings = ObserverSettings(march=MarchSettings(0.02), tolerance=0.05)
    full, short = sights(rgb, (place, *clouds[1:]), settings, 0.1)
    assert np.array_equal(short.visibility.numpy(), full.visibility.numpy())
    assert short.density_evals.numpy().mean() < full.density_evals.numpy().mean()


def test_occlusion_query_is_ignored_with_gradients(rgb, clouds):
    import drjit as dr

    settings = ObserverSettings(march=MarchSettings(0.02), tolerance=0.05)
    place, camera, observer, at = clouds
    p_o = rgb.Point3f(observer.T)
    dr.enable_grad(p_o)
    d = (at - camera) / np.linalg.norm(at - camera, axis=1, keepdims=True)
    ray = rgb.Ray3f(rgb.Point3f(camera.T), rgb.Vector3f(d.T))
    sight = trace_from_observer(
        place, ray, rgb.Point3f(at.T), p_o, 0, rgb.Bool(True), rgb.Float(0.3), settings, needs_depth=False
    )
    dr.backward(dr.sum(sight.visibility))
    assert np.all(np.isfinite(np.array(p_o.grad))) and np.abs(np.array(p_o.grad)).max() > 0


def test_occlusion_query_limits(rgb):
    requested = OcclusionQuery(rgb.Float(2), rgb.Float(1.5), 0.5)
    quarter, half = -math.log(0.75), math.log(2)
    t = rgb.Float([1.9, 2.0, 2.0])
    assert requested.is_clear(t, rgb.Float([0, 0.99 * quarter, 1.01 * quarter])).numpy().tolist() == [
        False,
        True,
        False,
    ]
    t = rgb.Float([1.4, 1.4, 1.6])
    assert requested.is_hidden(t, rgb.Float([0.99 * half, 1.01 * half, 9])).numpy().tolist() == [False, True, False]
    # All light must be absorbed, which no ray can decide before its end.
    assert not np.any(replace(requested, surface_opacity=1.0).is_hidden(t, rgb.Float(100.0)).numpy())


# ---- Primal ----
#
# The march against closed forms and a float64 march: slabs of all densities, grids, skipping, jitter, early stop.

DIAGONAL = 3**0.5
DEFAULT = MarchSettings(DIAGONAL / 1024)


def slab(mi, sigma, near=0.0, length=1.0):
    """A box from z = ``near``, ``length`` deep and wide."""
    to_world = mi.ScalarTransform4f().translate([0, 0, near]).scale(length)
    return VolumeMedium(mi.load_dict({"type": "constvolume", "value": float(sigma), "to_world": to_world}))


def grid(mi, data, **kwargs):
    return VolumeMedium(mi.load_dict({"type": "gridvolume", "grid": mi.VolumeGrid(data.astype(np.float32)), **kwargs}))


def run(mi, medium, o, d, settings=DEFAULT, **kwargs):
    o, d = np.atleast_2d(np.asarray(o, np.float32)), np.atleast_2d(np.asarray(d, np.float32))
    ray = medium.ray_to_local(mi.Point3f(o.T), mi.Vector3f(d.T))
    t0 = dr.maximum(ray.t_near, 0)
    return march(medium, ray, t0, ray.t_far, True, settings, **kwargs)


def one(x):
    return float(x.numpy()[0])


# ------------------------------------------------------------------------
#  Homogeneous slabs
# ------------------------------------------------------------------------


@pytest.mark.parametrize("near", [0, 1, 10])
@pytest.mark.parametrize("sigma", [1e-8, 1e-6, 1e-3, 1, 3, 1e3, 1e6, 1e9])
def test01_slab(rgb, sigma, near):
    r = run(rgb, slab(rgb, sigma, near), (0.5, 0.5, 0), (0, 0, 1))
    opacity, expected, median = reference.slab(sigma, near, near + 1)
    assert np.isclose(one(r.opacity), opacity, rtol=1e-5)
    assert np.isclose(one(r.expected_depth), expected, rtol=1e-5)
    if sigma > 1:
        assert np.isclose(one(r.median_depth), near + math.log(2) / sigma, rtol=1e-5)
    else:
        assert one(r.median_depth) == (np.inf if sigma < 0.69 else pytest.approx(near + math.log(2) / sigma))


@pytest.mark.parametrize("size", [1e-3, 1, 1e6])
def test03_boxes_of_any_size(rgb, size):
    r = run(
        rgb, slab(rgb, 2 / size, size, size), (size / 2, size / 2, 0), (0, 0, 1), MarchSettings(size * DIAGONAL / 1024)
    )
    opacity, expected, _ = reference.slab(2, 1, 2)
    assert np.isclose(one(r.opacity), opacity, rtol=1e-5) and np.isclose(
        one(r.expected_depth) / size, expected, rtol=1e-5
    )


@pytest.mark.parametrize("distance", [100, 1000, 30000])
def test04_distant_slabs(rgb, distance):
    # Positions are rounded to float32; optical depth must be neither counted twice nor lost.
    r = run(rgb, slab(rgb, 1e-3, distance), (0.5, 0.5, 0), (0, 0, 1))
    assert np.isclose(one(r.tau), 1e-3, rtol=2e-4)
    assert np.isclose(one(r.expected_depth), distance + 0.5, rtol=1e-5)


def test05_tiny_steps_lose_no_optical_depth(rgb):
    r = run(rgb, slab(rgb, 3, 1e5), (0.5, 0.5, 0), (0, 0, 1))
    assert np.isclose(one(r.opacity), 1 - math.exp(-3), rtol=0.02)


@pytest.mark.parametrize("sigma", [0, 1e-38])
def test06_vacuum(rgb, sigma):
    r = run(rgb, slab(rgb, sigma, 1), (0.5, 0.5, 0), (0, 0, 1))
    assert one(r.opacity) < 1e-30 and np.isfinite(one(r.expected_depth)) and one(r.median_depth) == np.inf


def test07_misses_and_masks(rgb):
    medium = slab(rgb, 5, 1)
    r = run(rgb, medium, [(0.5, 0.5, 0), (2, 0.5, 0), (0.5, 0.5, 5), (0.5, 0.5, 1.75)], [(0, 0, 1)] * 4)
    assert np.allclose(r.opacity.numpy(), [1 - math.exp(-5), 0, 0, 1 - math.exp(-1.25)], rtol=1e-5)
    assert r.expected_depth.numpy()[1:3].tolist() == [0, 0]
    ray = medium.ray_to_local(rgb.Point3f(0.5, 0.5, 0), rgb.Vector3f(0, 0, 1))
    masked = march(medium, ray, rgb.Float([1, 1]), rgb.Float([2, 2]), rgb.Bool([True, False]), DEFAULT, count=True)
    assert masked.opacity.numpy()[1] == 0 < masked.opacity.numpy()[0] and masked.density_evals.numpy()[1] == 0
    empty = march(medium, ray, rgb.Float([1.5, 1.7]), rgb.Float([1.5, 1.6]), True, DEFAULT)
    assert empty.opacity.numpy().tolist() == [0, 0]


@pytest.mark.parametrize("sigma", [np.inf, 3e38])
def test08_infinite_density(rgb, sigma):
    r = run(rgb, slab(rgb, sigma, 1), (0.5, 0.5, 0), (0, 0, 1))
    assert (one(r.opacity), one(r.expected_depth), one(r.median_depth)) == (1, 1, 1)


@pytest.mark.parametrize("samples", [1, 2, 4096])
def test09_any_number_of_steps_is_exact_in_constant_density(rgb, samples):
    r = run(rgb, slab(rgb, 3), (0.5, 0.5, -1), (0, 0, 1), MarchSettings(1 / samples), count=True)
    opacity, expected, _ = reference.slab(3, 1, 2)
    assert np.isclose(one(r.opacity), opacity, rtol=1e-5) and np.isclose(one(r.expected_depth), expected, rtol=1e-5)
    assert samples <= one(r.density_evals) <= samples + 1


# ------------------------------------------------------------------------
#  Grids, against the float64 march
# ------------------------------------------------------------------------


def rays_primal(n=40, seed=1):
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(n, 3))
    o = (0.5 + 1.5 * o / np.linalg.norm(o, axis=-1, keepdims=True)).astype(np.float32)
    d = rng.uniform(0.1, 0.9, (n, 3)) - o
    return o, (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("gain, dt_gamma", [(1e-3, 0), (1, 0), (10, 0), (10, 0.01), (1e3, 0), (1e6, 0)])
def test10_gridvolume_equals_the_numpy_march(rgb, gain, dt_gamma):
    data = np.random.default_rng(0).exponential(1, (5, 4, 6)) * gain
    o, d = rays_primal()
    settings = MarchSettings(1 / 64, dt_gamma=dt_gamma, stop=1e-9)
    medium = grid(rgb, data)
    r = run(rgb, medium, o, d, settings)
    for i in range(len(o)):
        o_i, d_i = o[i].astype(float), d[i].astype(float)
        near, far = reference.box(o_i, d_i, (0, 0, 0), (1, 1, 1))
        borders = reference.steps(max(near, 0), far, 1 / 64, dt_gamma)
        tau, expected, _, _, _ = reference.march(lambda p: reference.trilinear(data, p), o_i, d_i, borders)
        # The march can stop once it is opaque: compare opacities, and depth.
        assert np.isclose(r.opacity.numpy()[i], -math.expm1(-tau), rtol=2e-5)
        assert np.isclose(r.expected_depth.numpy()[i], expected, rtol=2e-5)


def test11_halving_the_step_converges_with_second_order(rgb):
    data = np.random.default_rng(3).exponential(2, (4, 4, 4))
    o, d = rays_primal(30)
    fine = []
    for i in range(len(o)):
        near, far = reference.box(o[i].astype(float), d[i].astype(float), (0, 0, 0), (1, 1, 1))
        borders = np.linspace(near, far, 4001)
        fine.append(reference.march(lambda p: reference.trilinear(data, p), o[i], d[i], borders)[0])
    errors = []
    for n in (8, 16, 32, 64):
        tau = run(rgb, grid(rgb, data), o, d, MarchSettings(1 / n, stop=0)).tau.numpy()
        errors.append(np.sqrt(np.mean((tau - fine) ** 2)))
    # The midpoint rule is of second order except at kinks of the interpolant and for the last, shorter step.
    assert errors[3] < errors[0] / 16 and all(b < a for a, b in zip(errors, errors[1:]))


def test12_colour(rgb):
    data = np.random.default_rng(0).exponential(3, (4, 4, 4))
    tint = np.random.default_rng(1).random((3, 5, 4, 3))
    medium = VolumeMedium(
        rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(data.astype(np.float32)), "raw": True}),
        rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(tint.astype(np.float32)), "raw": True}),
    )
    o, d = rays_primal(20)
    r = run(rgb, medium, o, d, MarchSettings(1 / 64, stop=1e-9, color_cutoff=0), color=ColorShader(rgb.Color3f))
    for i in range(len(o)):
        near, far = reference.box(o[i].astype(float), d[i].astype(float), (0, 0, 0), (1, 1, 1))
        total = reference.march(
            lambda p: reference.trilinear(data, p),
            o[i],
            d[i],
            reference.steps(near, far, 1 / 64),
            lambda p: reference.trilinear(tint, p),
        )[3]
        assert np.allclose(np.array(r.color)[:, i], total, rtol=5e-5)


# ------------------------------------------------------------------------
#  Settings
# ------------------------------------------------------------------------


@pytest.mark.parametrize("stop", [0, 1e-6, 1e-2])
def test13_early_stop(rgb, stop):
    medium = slab(rgb, 50, 1)
    full = run(rgb, medium, (0.5, 0.5, 0), (0, 0, 1), MarchSettings(0.01, stop=stop), count=True)
    assert 1 - stop - 1e-6 <= one(full.opacity) <= 1
    steps = 100 if stop == 0 else math.ceil(-math.log(stop) / 0.5)
    assert abs(one(full.density_evals) - steps) <= 1
    assert abs(one(full.expected_depth) - 1.02) < 2e-3 + 2 * stop


@pytest.mark.parametrize("offset", [0.0, 1e-6, 0.25, 0.999999])
def test14_jitter_moves_borders_only(rgb, offset):
    # For constant density the boundaries of the steps do not matter.
    for near in (0, 1, 50):
        r = run(rgb, slab(rgb, 3, near), (0.5, 0.5, 0), (0, 0, 1), MarchSettings(0.01), offset=rgb.Float(offset))
        opacity, expected, _ = reference.slab(3, near, near + 1)
        assert np.isclose(one(r.opacity), opacity, rtol=2e-4), (near, offset)
        assert np.isclose(one(r.expected_depth), expected, rtol=2e-4)


def test15_jitter_equals_the_numpy_march(rgb):
    data = np.random.default_rng(0).exponential(5, (5, 4, 6))
    o, d = rays_primal()
    shares = np.random.default_rng(2).uniform(0.01, 1, len(o)).astype(np.float32)
    r = run(rgb, grid(rgb, data), o, d, MarchSettings(1 / 16, stop=1e-9), offset=rgb.Float(shares))
    plain = run(rgb, grid(rgb, data), o, d, MarchSettings(1 / 16, stop=1e-9))
    for i in range(len(o)):
        near, far = reference.box(o[i].astype(float), d[i].astype(float), (0, 0, 0), (1, 1, 1))
        borders = reference.steps(near, far, 1 / 16, offset=float(shares[i]))
        tau = reference.march(lambda p: reference.trilinear(data, p), o[i], d[i], borders)[0]
        assert np.isclose(r.tau.numpy()[i], tau, rtol=3e-5)
    assert np.abs(r.tau.numpy() - plain.tau.numpy()).max() > 1e-3


def test16_until_ends_at_an_optical_depth(rgb):
    medium = slab(rgb, 4, 1)
    for goal in (1e-6, 0.1, 1.0, 3.9):
        r = run(rgb, medium, (0.5, 0.5, 0), (0, 0, 1), MarchSettings(0.01), until=rgb.Float(goal), count=True)
        assert np.isclose(one(r.median_depth), 1 + goal / 4, rtol=1e-5)
        assert one(r.density_evals) <= goal / 0.04 + 2
    assert (
        one(run(rgb, medium, (0.5, 0.5, 0), (0, 0, 1), MarchSettings(0.01), until=rgb.Float(4.5)).median_depth)
        == np.inf
    )


def field_with(bits, seed=0, gain=1.0):
    """A field of visible density, and the same without its occupancy grid."""
    import drjit.llvm.ad as ns

    config = RadianceConfig(
        HashGridConfig(levels=2, log2_rows=10, base=4, finest=16), width=16, geometry=3, sh_degree=2
    )
    out = []
    for occupancy in (OccupancyGrid(bits, ns, 0.01), None):
        f = RadianceNetwork.random(config, Box((0, 0, 0), (1, 1, 1)), ns, seed, occupancy=occupancy)
        rng = np.random.default_rng(seed)
        f.set_parameters({"grid.table": ns.Float((gain * rng.normal(size=len(f.grid.table))).astype(np.float32))})
        out.append(FieldMedium(f))
    return out


class Masked:
    """A medium whose density is 0 in the empty cells of ``bits``, marched without skipping."""

    def __init__(self, medium, bits):
        self.medium, self.occupancy = medium, None
        self.bits = bits

    def __getattr__(self, name):
        return getattr(self.medium, name)

    def _full(self, p):
        import drjit.llvm.ad as ns

        grid = OccupancyGrid(self.bits, ns, 0)
        return grid.distance_to_occupied(self.medium.to_unit(p)) == 0

    def density(self, p, active):
        return dr.select(self._full(p), self.medium.density(p, active), 0)

    def density_features(self, p, active):
        sigma, features = self.medium.density_features(p, active)
        return dr.select(self._full(p), sigma, 0), features


@pytest.mark.parametrize("dt_gamma", [0.0, 0.004])
@pytest.mark.parametrize("offset", [None, 0.37])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.5, 1.0])
def test17_skipping_equals_marching_every_step(rgb, share, offset, dt_gamma):
    bits = np.random.default_rng(4).random((16, 16, 16)) < share
    leaping, plain = field_with(bits)
    o, d = rays_primal(64, 5)
    d[0], o[0] = (0, 0, 1), (0.4, 0.6, -1)  # along an axis
    d[1], o[1] = (-1, 0, 0), (0.5, 0.6, 0.2)  # from inside
    settings = MarchSettings(1 / 200, dt_gamma=dt_gamma, stop=0)
    kwargs = dict(color=ColorShader(rgb.Color3f), count=True, offset=None if offset is None else rgb.Float(offset))
    a = run(rgb, leaping, o, d, settings, **kwargs)
    b = run(rgb, Masked(plain, bits), o, d, settings, **kwargs)
    # Rounding of t can move a midpoint across a cell boundary occasionally. Growing steps start elsewhere after skipped
    # cells, which samples the same scene differently.
    error = np.abs(a.opacity.numpy() - b.opacity.numpy())
    if dt_gamma == 0:
        assert np.quantile(error, 0.9) < 2e-5 and error.mean() < 1e-4
    else:
        assert error.max() < 0.05 and error.mean() < 0.01
    counted = a.density_evals.numpy()
    if share == 0:
        assert not counted.any() and not a.tau.numpy().any()
    elif share == 1:
        assert np.allclose(counted, b.density_evals.numpy(), atol=1)
    else:
        # Evaluations are made in occupied cells only, the minimum possible.
        assert counted.sum() < 1.15 * (share + 0.02) * b.density_evals.numpy().sum() + 10
        assert b.tau.numpy().sum() > 0


def test18_color_cutoff_saves_evaluations(rgb):
    bits = np.ones((4, 4, 4), bool)
    medium, _ = field_with(bits)
    o, d = rays_primal(16)
    settings = {c: MarchSettings(1 / 64, color_cutoff=c) for c in (0, 1e-2, 1)}
    r = {c: run(rgb, medium, o, d, s, color=ColorShader(rgb.Color3f), count=True) for c, s in settings.items()}
    assert np.array_equal(r[0].color_evals.numpy(), r[0].density_evals.numpy())
    assert 0 < r[1e-2].color_evals.numpy().sum() < r[0].color_evals.numpy().sum()
    assert not np.array(r[1].color).any() and not r[1].color_evals.numpy().any()
    assert all(np.array_equal(r[0].tau.numpy(), r[c].tau.numpy()) for c in r)


@pytest.mark.parametrize("quadrature", ["constant", "linear"])
def test20_goals_are_never_missed(rgb, quadrature):
    sigma, n = 2.9, 1000
    # Goals within a few floating-point spacings of the optical depth at each step's end.
    t = np.add.accumulate(np.concatenate([[np.float32(1)], np.full(n - 1, np.float32(1 / n))]), dtype=np.float32)[1:]
    goals = np.float32(sigma * (t.astype(float) - 1))[:, None]
    goals = (goals + np.arange(-8, 9) * np.spacing(goals)).astype(np.float32).ravel()
    medium = slab(rgb, sigma, 1)
    r = run(
        rgb,
        medium,
        np.tile(np.float32([0.5, 0.5, 0]), (len(goals), 1)),
        np.tile(np.float32([0, 0, 1]), (len(goals), 1)),
        MarchSettings(1 / n, quadrature=quadrature),
        until=rgb.Float(goals),
    )
    assert np.allclose(np.array(r.median_depth), 1 + goals / sigma, rtol=1e-6)


# ---- Settings and results of a march ----


@pytest.mark.parametrize("stop, depth", [(0.0, math.inf), (1.0, 0.0), (1e-4, -math.log(1e-4))])
def test01_maximum_optical_depth(stop, depth):
    assert MarchSettings(0.1, stop=stop).max_optical_depth == depth


@pytest.mark.parametrize(
    "medium, step",
    [
        (None, 1),
        (SimpleNamespace(default_step=None, length_scale=512), 0.5),
        (SimpleNamespace(default_step=0.3, length_scale=9), 0.3),
    ],
)
def test03_default_step(medium, step):
    assert default_step(medium) == step


def test04_opacity_and_expected_depth():
    tau, moment = ns.Float([0, 1e-9, math.log(2), 40]), ns.Float([0, 3e-9, 1, 2])
    zeros = dict.fromkeys(
        (
            "tau_compensation",
            "moment_compensation",
            "median_depth",
            "median_depth_slope",
            "crossing_start",
            "crossing_start_tau",
        ),
        ns.Float(0),
    )
    result = MarchResult(tau=tau, moment=moment, **zeros, start_distance=ns.Float(10))
    assert np.allclose(result.opacity.numpy(), [0, 1e-9, 0.5, 1], rtol=1e-6)
    # The first ray meets nothing; distances on the others exceed the start of the march.
    assert np.allclose(result.expected_depth.numpy(), [0, 13, 12, 12], rtol=1e-6)


# ---- Single steps: length, progress, and skipping ----


@pytest.mark.parametrize("distance", [0, 3, 300, 3e4, 1e6])
def test01_every_step_advances(rgb, distance):
    """Also from a voxel boundary that was just reached, and for voxels below the spacing of floats."""
    planes = VoxelCells((0, 0, 0), (1, 1, 1), (64, 64, 64), 0.5)
    medium = grid(rgb, np.ones((64, 64, 64)))
    wall = np.float32(distance + (np.arange(64) + 0.5) / 64)
    t = rgb.Float(np.concatenate([wall, np.nextafter(wall, np.float32(0)), np.nextafter(wall, np.float32(2e6))]))
    ray = medium.ray_to_local(rgb.Point3f(0.4, 0.6, -float(distance)), rgb.Vector3f(0, 0, 1))
    for step in (1e-12, 1e-3, 0.5):
        _, begin, delta, after = next_step(
            medium, ray, t, rgb.Float(1e9), rgb.Float(1), MarchSettings(step, cell_step=step), rgb.Bool(True), planes
        )
        assert (after.numpy() > begin.numpy()).all() and np.array_equal(delta.numpy(), after.numpy() - begin.numpy())


def test02_march_advances_from_a_boundary(rgb):
    """For any rounding of the boundary that was just reached, also at the start of the ray."""

    class Reached:
        min_edge = 1 / 64

        def next_boundary(self, ray, t):
            return t - 1e-7

    medium = grid(rgb, np.ones((4, 4, 4)))
    t = rgb.Float([0, 1e-30, 1e-3, 5, 1e6])
    ray = medium.ray_to_local(rgb.Point3f(0.4, 0.6, 0), rgb.Vector3f(0, 0, 1))
    _, begin, delta, after = next_step(
        medium, ray, t, rgb.Float(1e9), rgb.Float(1), MarchSettings(0.01), rgb.Bool(True), Reached()
    )
    assert (after.numpy() > begin.numpy()).all() and (delta.numpy() > 0).all()
    # No matter is skipped.
    assert (delta.numpy() <= 2e-6 * np.maximum(t.numpy(), 0.01)).all()


def test03_step_lengths(rgb):
    t = rgb.Float([0, 1, 10, 1e6])
    assert np.allclose(step_length(t, MarchSettings(0.1)).numpy(), [0.1, 0.1, 0.1, 1e6 * 2.0**-21])
    assert np.allclose(step_length(t, MarchSettings(0.1, dt_gamma=0.02)).numpy(), [0.1, 0.1, 0.2, 2e4])
    # Coarse steps end at the last moment where fine ones begin.
    fine_from = rgb.Float(1.45)
    t = rgb.Float([0, 1, 1.1, 2])
    assert np.allclose(step_length(t, MarchSettings(0.1, coarse=4), fine_from).numpy(), [0.4, 0.4, 0.1, 0.1])


@pytest.mark.parametrize("share", [1.0, 0.3])
def test04_skips_exactly_the_steps_with_empty_midpoints(rgb, share):
    bits = np.zeros((16, 1, 1), bool)
    bits[11] = True
    same = lambda v: v
    medium, grid = SimpleNamespace(to_unit=same, vector_to_unit=same), OccupancyGrid(bits, ns, 0)
    ray = SimpleNamespace(o=ns.Array3f(0.5, 0.5, 0), d=ns.Array3f(0, 0, 1))
    step = 1 / 43
    borders = np.concatenate([[0], (share + np.arange(44)) * step])
    middles = 0.5 * (borders[:-1] + borders[1:])
    want = borders[np.argmax(np.floor(16 * middles) == 11)]
    t, first = skip_empty_cells(
        medium, grid, ray, ns.Float(0), ns.Float(1), ns.Float(share), MarchSettings(step), ns.Bool(True), None
    )
    assert np.isclose(t[0], want, atol=1e-6) and first[0] == 1
    # Inside matter nothing is skipped, and the first step stays short.
    t, first = skip_empty_cells(
        medium, grid, ray, ns.Float(0.7), ns.Float(1), ns.Float(share), MarchSettings(step), ns.Bool(True), None
    )
    assert np.isclose(t[0], 0.7) and np.isclose(first[0], share)
    # Behind all matter, skips lead out of the box.
    t, _ = skip_empty_cells(
        medium, grid, ray, ns.Float(0.8), ns.Float(1), ns.Float(share), MarchSettings(step), ns.Bool(True), None
    )
    assert t[0] >= 1


def test05_coarse_skips_end_where_fine_steps_begin(rgb):
    bits = np.zeros((16, 1, 1), bool)
    bits[11] = True
    same = lambda v: v
    medium, grid = SimpleNamespace(to_unit=same, vector_to_unit=same), OccupancyGrid(bits, ns, 0)
    ray = SimpleNamespace(o=ns.Array3f(0.5, 0.5, 0), d=ns.Array3f(0, 0, 1))
    step, fine = 1 / 43, 0.52
    t, _ = skip_empty_cells(
        medium,
        grid,
        ray,
        ns.Float(0),
        ns.Float(1),
        ns.Float(1),
        MarchSettings(step, coarse=4),
        ns.Bool(True),
        ns.Float(fine),
    )
    middles = fine + (np.arange(22) + 0.5) * step
    assert t.numpy() == pytest.approx(fine + np.argmax(np.floor(16 * middles) == 11) * step, abs=1e-6)
