"""Tests of `nerg_mi.transport.geometry`."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import (
    Ceiling,
    SceneGeometry,
    Shading,
    default_march_settings,
    pixel_directions,
    pixel_solid_angles,
    trace_depth,
)
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.plugins.scenes import plugin

# ---- Ceiling: clipping of rays that start above a plane ----


def ray(mi, origins, directions, kind="RayDifferential3f"):
    o, d = (np.array(v, np.float32).T for v in np.broadcast_arrays(origins, directions))
    return getattr(mi, kind)(mi.Point3f(np.ascontiguousarray(o)), mi.Vector3f(np.ascontiguousarray(d)))


@pytest.mark.parametrize("scale", [1.0, 7.0])
def test01_ceiling_clips_rays(rgb, scale):
    directions = [[0, 0, -1], [0.6, 0, -0.8], [1, 0, 0], [0, 0, 1], [0.6, 0, -0.8]]
    origins = [[0, 0, 3]] * 4 + [[0, 0, 0.5]]
    arguments = ray(rgb, origins, directions)
    arguments.maxt = rgb.Float(10)
    moved, ahead = Ceiling(1.0, (0, 0, scale)).clip_ray(arguments)
    assert np.allclose(ahead, [2, 2.5, 0, 0, 0])
    assert np.allclose(np.array(moved.o).T[:2], [[0, 0, 1], [1.5, 0, 1]]) and np.allclose(
        moved.maxt, [8, 7.5, 10, 10, 10]
    )
    assert np.allclose(np.array(moved.o).T[2:], origins[2:]) and np.array_equal(moved.d, arguments.d)


def test02_ceiling_with_any_up_and_ray_differentials(rgb):
    rng = np.random.default_rng(3)
    up, o, d = rng.normal(size=3), rng.normal(size=(50, 3)) * 4, rng.normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    arguments = ray(rgb, o, d)
    arguments.o_x, arguments.d_x, arguments.o_y, arguments.d_y = arguments.o + 1, arguments.d, arguments.o, arguments.d
    moved, ahead = Ceiling(0.3, up).clip_ray(arguments)
    unit = up / np.linalg.norm(up)
    over, fall = o @ unit - 0.3, -(d @ unit)
    cuts = (over > 0) & (fall > 0)
    expected = np.where(cuts, over / np.where(cuts, fall, 1), 0)
    assert 5 < cuts.sum() < 45 and np.allclose(ahead, expected, rtol=1e-4)
    assert np.allclose(np.array(moved.o).T, o + expected[:, None] * d, rtol=1e-4, atol=1e-4)
    assert np.allclose(moved.o_x - moved.o, 1, atol=1e-4) and np.allclose(moved.o_y - moved.o, 0, atol=1e-4)


def test03_ceiling_height_reuses_the_kernel(rgb):
    arguments = ray(rgb, [[0, 0, 3]] * 4, [[0, 0, -1]] * 4, "Ray3f")
    kernels = []
    for height in (1.0, 1.5, 2.0):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(Ceiling(height).clip_ray(arguments)[1])
            kernels.append({k["hash"] for k in dr.kernel_history([dr.KernelType.JIT])})
    assert kernels[0] == kernels[1] == kernels[2] and kernels[0]


@pytest.mark.parametrize("up", [(0, 0, 0), (np.nan, 0, 1), (np.inf, 0, 0)])
def test04_invalid_up_is_refused(rgb, up):
    with pytest.raises(NergError, match='"up" must be a direction'):
        Ceiling(1.0, up)


# ---- The mapping of a full-sphere image: closed forms and round trips ----

SIZES = [(1, 2), (2, 3), (16, 8), (33, 17), (256, 128)]


@pytest.mark.parametrize("width, height", SIZES)
def test01_solid_angles_sum_to_the_sphere(width, height):
    ω = pixel_solid_angles(width, height)
    assert ω.shape == (height, width) and (ω > 0).all()
    assert np.isclose(ω.sum(), 4 * np.pi, rtol=1e-13)


def test02_integrals_over_the_sphere():
    # ∫ z² dω = 4π/3, and the integral of a direction is zero
    v, ω = pixel_directions(256, 128), pixel_solid_angles(256, 128)
    assert np.allclose((v**2 * ω[..., None]).sum((0, 1)), 4 * np.pi / 3, rtol=1e-3)
    assert np.allclose((v * ω[..., None]).sum((0, 1)), 0, atol=1e-12)


def test04_axes():
    v = pixel_directions(8, 5)
    assert np.allclose(np.linalg.norm(v, axis=-1), 1)
    # Up is the first row; +Z lies between the two middle columns, +X a quarter of the way along.
    assert np.allclose(v[0], [0, 1, 0]) and np.allclose(v[-1], [0, -1, 0])
    middle = v[2, 3:5].mean(axis=0), v[2, 1:3].mean(axis=0)
    assert np.allclose([m / np.linalg.norm(m) for m in middle], [[0, 0, 1], [1, 0, 0]])


def test05_too_small():
    with pytest.raises(NergError, match="at least 1 x 2 pixels"):
        pixel_solid_angles(4, 1)


# ---- Rays through shapes behind a medium, and derivatives of the distances ----

SETTINGS = MarchSettings(0.01)


def look(mi, place, o):
    """Rays along +z from the points ``o``, one row per ray."""
    return place.trace(mi.Ray3f(mi.Point3f(np.asarray(o, np.float32).T), mi.Vector3f(0, 0, 1)), True, SETTINGS)


@pytest.mark.parametrize("sigma", [0.3, 2.0])
def test_opacity_of_shape_and_medium(rgb, sigma):
    medium = VolumeMedium(rgb.load_dict({"type": "constvolume", "value": sigma}))
    ball = rgb.load_dict({"type": "scene", "ball": {"type": "sphere", "center": [0.25, 0.25, 3], "radius": 0.2}})
    # Through the unit cube to the sphere, past the sphere, and past both.
    view = look(rgb, SceneGeometry(medium, ball), [(0.25, 0.25, -1), (0.75, 0.75, -1), (1.75, 0.75, -1)])
    thick = -np.expm1(-sigma)
    assert np.allclose(view.opacity.numpy(), [1, thick, 0], rtol=1e-5)
    assert np.allclose(view.medium_opacity.numpy(), [thick, thick, 0], rtol=1e-5)
    assert view.hits_shape.numpy().tolist() == [True, False, False]
    assert view.has_surface(0.5).numpy().tolist() == [True, thick > 0.5, False]
    assert view.has_surface(0.0).numpy().tolist() == [True, True, False]


def test_shape_distance_derivative_of_the_ray(rgb):
    place = SceneGeometry(
        None, rgb.load_dict({"type": "scene", "ball": {"type": "sphere", "center": [0, 0, 5], "radius": 2.0}})
    )
    x, z = np.float32([-1.0, 0.0, 0.5, 1.2]), rgb.Float([0, 0, 0, 0])
    across = rgb.Float(x)
    dr.enable_grad(across, z)
    distance = place.trace(rgb.Ray3f(rgb.Point3f(across, 0, z), rgb.Vector3f(0, 0, 1)), True, SETTINGS).shape_distance
    dr.backward(dr.sum(distance))
    assert np.allclose(distance.numpy(), 5 - np.sqrt(4 - x**2), rtol=1e-5)
    assert np.allclose(dr.grad(across).numpy(), x / np.sqrt(4 - x**2), rtol=1e-4, atol=1e-6)
    assert np.allclose(dr.grad(z).numpy(), -1, rtol=1e-5)


def test_shape_distance_derivative_of_the_shape(rgb):
    scene = rgb.load_dict(
        {"type": "scene", "plate": {"type": "rectangle", "to_world": rgb.ScalarTransform4f().translate([0, 0, 4])}}
    )
    params, lift = rgb.traverse(scene), rgb.Float(0)
    dr.enable_grad(lift)
    key = next(k for k in params.keys() if k.endswith("to_world"))
    # Twice the displacement, anywhere on it.
    params[key] = rgb.Transform4f().translate(rgb.Point3f(0, 0, 4 + 2 * lift))
    params.update()
    view = look(rgb, SceneGeometry(None, scene), [(0, 0, 0), (0.4, -0.7, 1)])
    dr.forward(lift)
    assert np.allclose(view.shape_distance.numpy(), [4, 3]) and np.allclose(
        dr.grad(view.shape_distance).numpy(), 2, rtol=1e-5
    )


# ---- Shading ----
#
# Radiance from behind a medium: lit shapes, shapes with a headlight, an environment emitter, or the background.

BACKGROUND = 0.125
SAMPLES = 1 << 14


def scene_of(mi, *emitters, shapes=True):
    """A square in the plane z = 2 of albedo 0.25, 0.5, 0.75, whose half with x > 0 is hit by rays along +z."""
    square = plugin(
        "rectangle",
        to_world=mi.ScalarTransform4f().translate([1, 0, 2]).rotate([1, 0, 0], 180),
        bsdf={"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.25, 0.5, 0.75]}},
    )
    lights = {f"light{i}": emitter for i, emitter in enumerate(emitters)}
    return mi.load_dict({"type": "scene", **({"square": square} if shapes else {}), **lights})


def shade(mi, scene, nested=None, medium=None, hide=False):
    """``(radiance, AOVs, shown)`` of a ray that hits the square and of one that misses it, averaged over many samples;
    one array row each."""
    place = SceneGeometry(medium, scene)
    across = mi.Float(np.repeat(np.float32([0.5, -0.5]), SAMPLES))
    ray = mi.RayDifferential3f(mi.Point3f(across, 0.5, -1), mi.Vector3f(0, 0, 1))
    active = dr.full(mi.Bool, True, 2 * SAMPLES)
    view = place.trace(ray, active, MarchSettings(0.01))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 2 * SAMPLES)
    shading = Shading(None if nested is None else mi.load_dict(nested))
    color, aovs, shown = shading.radiance(scene, sampler, ray, None, view, mi.Color3f(BACKGROUND), hide, active)
    of_two = lambda value: np.array(value + dr.zeros(mi.Float, 2 * SAMPLES)).reshape(2, SAMPLES).mean(axis=1)
    shown = of_two(dr.select(shown, mi.Float(1), 0))
    return np.stack([of_two(c) for c in color], axis=1), [of_two(a) for a in aovs], shown, shading


SKY = {"type": "constant", "radiance": 2.0}


def test01_shapes_without_light_show_their_albedo_where_they_face_the_ray(rgb):
    color, aovs, shown, shading = shade(rgb, scene_of(rgb))
    assert np.allclose(color, [[0.25, 0.5, 0.75], [BACKGROUND] * 3], atol=1e-6)
    assert shown.tolist() == [True, False] and aovs == [] and shading.aov_names() == []


@pytest.mark.parametrize("headlight", [0.0, 0.7, 1.0])
def test_headlight_depends_on_the_angle(rgb, headlight):
    scene = scene_of(rgb)
    ray = rgb.RayDifferential3f(rgb.Point3f(1, 0, 0), dr.normalize(rgb.Vector3f(0.5, 0, 2)))
    view = SceneGeometry(None, scene).trace(ray, rgb.Bool(True), MarchSettings(0.01))
    sampler = rgb.load_dict({"type": "independent"})
    color = Shading(headlight=headlight).radiance(
        scene, sampler, ray, None, view, rgb.Color3f(0), False, rgb.Bool(True)
    )[0]
    cosine = 2 / np.hypot(0.5, 2)
    assert np.allclose(np.ravel(color), np.array([0.25, 0.5, 0.75]) * (1 - headlight + headlight * cosine), atol=1e-6)


def test02_shapes_with_emitters_are_lit_by_path(rgb):
    color, _, shown, _ = shade(rgb, scene_of(rgb, SKY))
    # Under a uniform environment of radiance 2, a plane that sees nothing else reflects twice its albedo.
    assert np.allclose(color, [[0.5, 1.0, 1.5], [2, 2, 2]], rtol=0.02) and shown.tolist() == [True, True]


def test03_hidden_environment_leaves_the_background(rgb):
    color, _, shown, _ = shade(rgb, scene_of(rgb, SKY), hide=True)
    assert np.allclose(color, [[0.5, 1.0, 1.5], [BACKGROUND] * 3], rtol=0.02) and shown.tolist() == [True, False]


def test04_environment_without_shapes(rgb):
    color, _, shown, _ = shade(rgb, scene_of(rgb, SKY, shapes=False), medium=fog(rgb, 1.0))
    assert np.allclose(color, 2) and shown.tolist() == [True, True]


def fog(mi, sigma):
    to_world = mi.ScalarTransform4f().translate([-1, 0, 0]).scale([2, 1, 1])
    return VolumeMedium(mi.load_dict({"type": "constvolume", "value": sigma, "to_world": to_world}))


def test05_occluded_shapes_are_not_shaded(rgb):
    color, _, _, _ = shade(rgb, scene_of(rgb, SKY), medium=fog(rgb, 1e6))
    # The weight of what is behind is zero: no path was traced to the square.
    assert np.allclose(color[0], 2)


def test06_nested_integrator_lights_and_adds_aovs(rgb):
    nested = {"type": "aov", "aovs": "far:depth", "light": {"type": "direct"}}
    color, aovs, shown, shading = shade(rgb, scene_of(rgb, SKY), nested)
    assert np.allclose(color, [[0.5, 1.0, 1.5], [2, 2, 2]], rtol=0.02)
    assert shading.aov_names()[-1] == "far.T" and np.allclose(aovs[-1], [3, 0]) and shown.tolist()[0]


@pytest.mark.parametrize("nested", [{"type": "aov", "aovs": "far:depth"}, {"type": "moment"}])
def test_nested_integrators_without_light_are_refused(rgb, nested):
    Shading(rgb.load_dict({**nested, "light": {"type": "direct"}}))
    with pytest.raises(NergError, match="contains no integrator"):
        Shading(rgb.load_dict(nested))


def test07_nested_integrator_keeps_the_background(rgb):
    lamp = {"type": "point", "position": [0.5, 0.5, 0], "intensity": 4.0}
    color, _, shown, _ = shade(rgb, scene_of(rgb, lamp), {"type": "direct"})
    # Directly above the hit point, two units away: albedo / π times 4 / 2².
    assert np.allclose(color, [np.array([0.25, 0.5, 0.75]) / np.pi, [BACKGROUND] * 3], rtol=1e-4)
    assert shown.tolist() == [True, False]


@pytest.mark.parametrize("kind, name", [("ptracer", "AdjointIntegrator"), ("nerg", "NergIntegrator")])
def test08_integrators_that_cannot_light_shapes_are_refused(rgb, kind, name):
    with pytest.raises(NergError, match=name):
        Shading(rgb.load_dict({"type": kind}))


# ---- Batched depth tracing: closed forms, both array types, independence of the batch size ----


@pytest.fixture
def slab(rgb):
    """The unit cube of density 3."""
    return VolumeMedium(rgb.load_dict({"type": "constvolume", "value": 3.0}))


@pytest.fixture
def wall(rgb):
    """Opaque for x > 0.5, empty elsewhere."""
    data = np.zeros((4, 4, 4, 1), np.float32)
    data[:, :, 2:] = 1000
    return VolumeMedium(rgb.load_dict({"type": "gridvolume", "data": rgb.TensorXf(data), "filter_type": "nearest"}))


O = np.array([[-1.0, 0.3, 0.4], [-1.0, 0.3, 0.4], [0.25, 0.5, 0.5]], np.float32)
D = np.array([[1.0, 0, 0], [-1.0, 0, 0], [1.0, 0, 0]], np.float32)


def test_constant_density_in_closed_form(slab):
    depth, opacity = trace_depth(slab, O, D)
    assert depth.dtype == opacity.dtype == np.float32
    alpha = 1 - np.exp(-3)
    np.testing.assert_allclose(opacity, [alpha, 0, 1 - np.exp(-3 * 0.75)], rtol=1e-5, atol=1e-7)
    half = lambda a: -np.log(1 - 0.5 * a) / 3
    np.testing.assert_allclose(depth, [1 + half(alpha), 0, half(opacity[2])], atol=1e-4)


def test_expected_depth_in_closed_form(slab):
    depth, _ = trace_depth(slab, O[:1], D[:1], kind="expected")
    mean = 1 / 3 - np.exp(-3) / (1 - np.exp(-3))
    assert depth[0] == pytest.approx(1 + mean, abs=1e-4)


def test_wall_depth(wall):
    rng = np.random.default_rng(0)
    d = rng.normal(size=(200, 3))
    d[:, 0] = np.abs(d[:, 0]) + 0.5
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o = np.tile([0.1, 0.5, 0.5], (200, 1))
    depth, opacity = trace_depth(wall, o, d)
    hit = np.abs(0.5 + d[:, 1:] * (0.4 / d[:, :1]) - 0.5).max(axis=1) < 0.49
    assert hit.sum() > 50
    np.testing.assert_allclose(depth[hit], 0.4 / d[hit, 0], atol=default_march_settings(wall).step)
    assert (opacity[hit] > 0.999).all()


def _shares_in_front(rgb, opacity, rule, kind, width=2, count=300):
    """Fraction of rays whose depth is on the first of two slabs, which has this ``opacity``; the second is opaque."""
    data = np.zeros((2, 2, 32, 1), np.float32)
    data[:, :, 8 : 8 + width] = -np.log1p(-opacity) / (width / 32)
    data[:, :, 24:28] = 1e5
    medium = VolumeMedium(rgb.load_dict({"type": "gridvolume", "data": rgb.TensorXf(data), "filter_type": "nearest"}))
    # Rays from inside the box, whose steps begin anywhere relative to the slabs.
    o = np.stack([np.linspace(0.1, 0.2, count), *np.full((2, count), 0.4)], axis=1)
    settings = replace(default_march_settings(medium), quadrature=rule)
    depth, _ = trace_depth(medium, o, np.tile([1.0, 0, 0], (count, 1)), settings, kind)
    return float(np.mean(o[:, 0] + depth < 0.7)), 0.5 * np.log(2) / (width / 32) * settings.step


@pytest.mark.parametrize("kind", ["median", "refined"])
@pytest.mark.parametrize("rule", ["constant", "linear", "cells"])
def test_median_is_on_the_right_slab_beyond_a_bound_from_one_half(rgb, rule, kind):
    """docs/explanation/numerics.md states the bound: half the optical depth of a step in the first slab."""
    _, bound = _shares_in_front(rgb, 0.5, rule, kind)
    bound = 1e-5 if rule == "cells" else 1.02 * bound
    assert _shares_in_front(rgb, 0.5 - bound, rule, kind)[0] == 0
    assert _shares_in_front(rgb, 0.5 + bound, rule, kind)[0] == 1
    if rule != "cells":
        # Within the bound, the slab depends on where steps begin: the bound is not too wide by more than a factor of 2.
        shares = [_shares_in_front(rgb, 0.5 + sign * 0.5 * bound, rule, kind)[0] for sign in (-1, 1)]
        assert shares[0] > 0 or shares[1] < 1


@pytest.mark.parametrize("batch", [1, 2, 100])
def test_batches_and_array_types_agree(slab, rgb, batch):
    ns = namespace("llvm")
    expected = trace_depth(slab, O, D)
    result = trace_depth(slab, O, D, batch=batch)
    jit = trace_depth(slab, ns.Array3f(O.T), ns.Array3f(D.T), batch=batch)
    for e, f, j in zip(expected, result, jit):
        np.testing.assert_array_equal(f, e)
        assert dr.is_array_v(j)
        np.testing.assert_array_equal(np.array(j), e)


def test_scaled_field_has_scaled_depth(rgb):
    ns = namespace("llvm")
    config = RadianceConfig(grid=HashGridConfig(levels=2, log2_rows=8, base=4, finest=8), width=16, density_scale=20.0)
    field = RadianceNetwork.random(config, Box((-1, -1, -1), (1, 1, 1)), ns, 1, march_step=1 / 64)
    scaled = FieldMedium(field, Similarity(np.diag([10.0, 10, 10, 1])))
    near, a = trace_depth(FieldMedium(field), O[:1], D[:1])
    far, b = trace_depth(scaled, 10 * O[:1], D[:1])
    assert a[0] > 0.5
    np.testing.assert_allclose(far, 10 * near, rtol=1e-4)
    np.testing.assert_allclose(a, b, rtol=1e-4)


def test_trace_depth_is_detached(slab):
    ns = namespace("llvm")
    o = ns.Array3f(O.T)
    dr.enable_grad(o)
    depth, opacity = trace_depth(slab, o, ns.Array3f(D.T))
    assert not dr.grad_enabled(depth) and not dr.grad_enabled(opacity)


def test_mismatched_shapes_are_refused(slab):
    with pytest.raises(ValueError, match=r"\(N, 3\)"):
        trace_depth(slab, O, D[:2])
    with pytest.raises(ValueError, match="median"):
        trace_depth(slab, O, D, kind="first")
    with pytest.raises(ValueError, match="at least 1 ray"):
        trace_depth(slab, O, D, batch=0)
