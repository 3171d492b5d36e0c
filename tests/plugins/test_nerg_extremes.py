"""The integrator for extreme densities, sizes and observers; values and derivatives."""

import math

import drjit as dr
import numpy as np
import pytest

from nerg_mi.ranges import POSITIVE_VALUES
from nerg_mi.transport.quadrature import RULES
from tests.reference import march_numpy as reference

from .scenes import (
    GAZE,
    attach,
    camera,
    channels,
    constant,
    make_observer,
    picture,
    plugin,
    points,
    put,
    render,
    scene_with,
    still,
    stored,
    with_gaze,
)

# ---- Densities and sizes ----

SLAB = [1e-6, 1e-3, 1.0, 1e3, 1e6, 1e9]


def slab_scene(mi, kind, sigma, ahead):
    """One ray along +z through the unit cube, whose face is ``ahead`` of the ray's origin."""
    overrides = {"value": float(sigma)}
    if kind == "gridvolume":
        overrides = {"grid": mi.VolumeGrid(np.full((3, 3, 3), sigma, np.float32)), "raw": True}
    integrator = plugin("nerg", density=plugin(kind, **overrides), depth="expected", radiance=False)
    # Mitsuba starts the rays of this sensor slightly in front of it.
    where = {"origin": [0.5, 0.5, -ahead - float(mi.math.RayEpsilon)], "direction": [0, 0, 1]}
    return scene_with(mi, integrator, plugin("radiancemeter", film=camera(mi, size=1)["film"], **where))


def fog(sigma, to_world):
    return {"type": "constvolume", "value": sigma, "to_world": to_world}


@pytest.mark.parametrize("ahead", [0, 1])
@pytest.mark.parametrize("kind", ["constvolume", "gridvolume"])
def test01_slabs_with_default_parameters(rgb, kind, ahead):
    for sigma in SLAB:
        depth, opacity = picture(rgb, slab_scene(rgb, kind, sigma, ahead)).ravel()[3:]
        alpha, expected, _ = reference.slab(sigma, ahead, ahead + 1)
        assert np.isclose(opacity, alpha, rtol=1e-5), sigma
        # With the face at the origin the depth of dense matter is exactly 1/σ.
        assert np.isclose(depth, expected, rtol=1e-5), sigma


@pytest.mark.parametrize("kind", ["constvolume", "gridvolume"])
def test02_slab_derivatives(rgb, kind):
    for sigma in [0.1, 10.0, *SLAB]:
        scene = slab_scene(rgb, kind, sigma, 0)
        params = rgb.traverse(scene)
        key = next(k for k in params.keys() if k.endswith(("value.value", "density.data")))
        got = {}
        for name, channel in (("depth", 3), ("opacity", 4)):
            value = type(params[key])(dr.detach(params[key]))
            dr.enable_grad(value)
            put(params, key, value)
            dr.backward(dr.gather(rgb.Float, rgb.render(scene, params, spp=1).array, channel))
            got[name] = float(np.array(dr.grad(value)).sum())
        slope = math.exp(-sigma)
        near = {"rtol": 1e-4} if slope > 1e-6 else {"rtol": 0, "atol": 1e-6}
        assert np.isclose(got["opacity"], slope, **near), sigma
        if 0.1 <= sigma <= 1e3:
            # Of h(τ) = 1/τ - 1/expm1(τ), the mean absorption depth.
            change = -1 / sigma**2 + (1 / (4 * math.sinh(sigma / 2) ** 2) if sigma < 700 else 0)
            assert np.isclose(got["depth"], change, rtol=1e-4), sigma
        assert np.isfinite(got["depth"])


@pytest.mark.parametrize("quadrature", RULES.names())
def test03_thin_sheets_are_found_with_default_parameters(rgb, quadrature):
    data = np.full((10000, 1, 1), 1e-8, np.float32)
    data[7000] = 1e9
    density = {"type": "gridvolume", "grid": rgb.VolumeGrid(data), "raw": True, "filter_type": "nearest"}
    integrator = {"type": "nerg", "density": density, "quadrature": quadrature}
    out = channels(rgb, integrator, camera(rgb, (0.5, 0.4, -1), (0.5, 0.5, 1), fov=10))
    assert np.all(out["opacity.Y"] == 1)
    # Oblique pixels look from slightly more than 1.7 away.
    assert np.all((out["depth.T"] > 1.68) & (out["depth.T"] < 1.75))


@pytest.mark.parametrize("size", [1e-3, 1e6])
def test04_scenes_of_any_size(rgb, size):
    # The near plane is at a fraction of the scene's size.
    def view(s):
        to_world = rgb.ScalarTransform4f().translate([-s / 2] * 3).scale(s)
        sensor = still(camera(rgb, np.multiply((0.5, 0.4, -3), s), fov=25, near_clip=1e-2 * s, far_clip=1e4 * s))
        return channels(rgb, plugin("nerg", density=fog(3.0 / s, to_world)), sensor)

    a, b = view(1.0), view(size)
    assert np.allclose(a["opacity.Y"], b["opacity.Y"], rtol=1e-4, atol=1e-4)
    hit = a["opacity.Y"] > 1e-2
    assert np.allclose(a["depth.T"][hit], b["depth.T"][hit] / size, rtol=1e-5)


def test05_scene_far_from_the_origin(rgb):
    # 1e5 units away positions are 0.008 apart: opacity is unchanged, depth is accurate to that.
    to_world = rgb.ScalarTransform4f().translate([1e5, 0, 0])
    integrator = plugin("nerg", density=fog(3.0, to_world), depth="expected")
    out = channels(rgb, integrator, camera(rgb, (1e5 + 0.5, 0.5, -2), (1e5 + 0.5, 0.5, 0), fov=2))
    alpha, expected, _ = reference.slab(3, 1.99, 2.99)
    assert np.allclose(out["opacity.Y"], alpha, rtol=1e-2)
    assert np.allclose(out["depth.T"], expected, atol=0.03)


@pytest.mark.parametrize("step, spp", [(10.0, 1), (1 / 4096, 1), (0.05, 4096)])
def test06_sample_counts(rgb, step, spp):
    # Constant density is exact for any step, and so is the mean of equal samples.
    to_world = rgb.ScalarTransform4f().translate([-9, -9, 0]).scale([18, 18, 1])
    integrator = plugin("nerg", density=fog(2.0, to_world), depth="expected", step=step)
    sensor = camera(rgb, (0, 0, -1), (0, 0, 0), "orthographic", size=2, near_clip=0.5)
    out = channels(rgb, integrator, sensor, spp=spp)
    alpha, expected, _ = reference.slab(2, 0.5, 1.5)
    assert np.allclose(out["opacity.Y"], alpha, rtol=1e-5) and np.allclose(out["depth.T"], expected, rtol=1e-5)


# ---- Observers ----


@pytest.mark.parametrize("kind", ["depth", "transmittance", "map"])
@pytest.mark.parametrize("falloff", [0.0, 1e-38, 1e30])
def test08_extreme_observers_and_falloffs(rgb, files, kind, falloff):
    for origin in ((0, 0, -1), (0.1, 0.1, 0.1), (0.6, 0.5, -5), (1e6, 0, -1e6), (1e-30, 0, 0)):
        how = {"visibility": kind, "falloff": falloff, "map_height": 32, "surface_opacity": 0.0}
        out = channels(rgb, with_gaze(files, GAZE, observer=make_observer(rgb, *origin), **how))
        assert all(np.all(np.isfinite(v)) for v in out.values()), origin
        assert out["visibility.Y"].min() >= 0 and out["visibility.Y"].max() <= 1 + 1e-6


@pytest.mark.parametrize("kind", ["depth", "transmittance", "map"])
def test09_observer_inside_solid_matter_sees_nothing(rgb, kind):
    density = fog(1e3, rgb.ScalarTransform4f().translate([-1, -1, -1]).scale(2))
    how = {"aovs": "visibility", "visibility": kind, "observer": make_observer(rgb, 0, 0, 0), "map_height": 64}
    out = channels(rgb, plugin("nerg", density=density, **how), camera(rgb, fov=20))
    assert np.all(out["visibility.Y"] <= 1e-6)  # the marches' "stop"


@pytest.mark.parametrize("origin", [(0.5, 0.4, -3), (0, 0, -1), (0.2, 0.1, 0.1)])
def test10_degenerate_observers_give_finite_derivatives(rgb, files, origin):
    how = {"observer": make_observer(rgb, *origin), "surface_opacity": 0.0, "falloff": 0.5}
    scene = scene_with(rgb, with_gaze(files, "gaze,visibility,depth", **how), camera(rgb, size=4))
    params, key = rgb.traverse(scene), "integrator.field.density_net.1"
    attach(params, key)
    dr.backward(dr.sum(rgb.render(scene, params, spp=1), axis=None))
    assert np.all(np.isfinite(np.array(dr.grad(params[key]))))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test11_observers_without_finite_position_are_refused(rgb, bad):
    matrix = np.eye(4)
    matrix[0, 3] = bad
    with pytest.raises(Exception, match='"observer"'):
        rgb.load_dict(constant(observer=plugin("perspective", to_world=rgb.ScalarTransform4f(matrix))))


@pytest.mark.parametrize("visibility", ["depth", "map", "transmittance"])
@pytest.mark.parametrize("tolerance", [1e20, POSITIVE_VALUES.high])
def test_observer_depth_is_finite_for_any_tolerance(rgb, tolerance, visibility):
    how = {"visibility": visibility, "map_height": 16, "observer": make_observer(rgb, -3, 0.5, 0.5)}
    integrator = constant(1.0, aovs="observer_depth,visibility,position", tolerance=tolerance, **how)
    image = render(rgb, integrator, camera(rgb, size=6))
    assert image[..., 3].max() > 1e17 and np.all(np.isfinite(image))


# ---- Fields and silhouettes ----


@pytest.mark.parametrize("gain", [1e3, 1e6, -1e6])
def test14_overflowing_activations(rgb, files, gain):
    # exp(log σ) would overflow, or underflow, and the sigmoids of the colour saturate.
    scene = scene_with(rgb, with_gaze(files, "depth,opacity,gaze"), camera(rgb, size=4))
    params = rgb.traverse(scene)
    keys = [f"integrator.{name}" for name in ("field.density_net.1", "field.color_net.2", "gaze.capture_head.0")]
    for key in keys:
        params[key] = params[key] * gain
    attach(params, *keys)
    image = rgb.render(scene, params, spp=1)
    assert np.all(np.isfinite(np.array(image)))
    dr.backward(dr.sum(image, axis=None))
    for key in keys:
        assert np.all(np.isfinite(np.array(dr.grad(params[key])))), key


def test15_median_depth_lies_in_matter(rgb):
    # A sphere with a soft edge in front of a wall: at its silhouette the mean of both depths lies between them.
    n = 48
    z, y, x = np.meshgrid(*[(np.arange(n) + 0.5) / n * 2 - 1] * 3, indexing="ij")
    radius = np.sqrt(x**2 + y**2 + (z + 0.4) ** 2) / 0.5
    data = np.where(z > 0.8, 1e3, 200 * np.clip((1.05 - radius) / 0.1, 0, 1)).astype(np.float32)
    place = rgb.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    density = plugin("gridvolume", grid=rgb.VolumeGrid(data), raw=True, to_world=place)
    flying = {}
    for kind in ("expected", "median", "refined"):
        integrator = {"type": "nerg", "density": density, "depth": kind, "radiance": False, "aovs": "position,opacity"}
        out = channels(rgb, integrator, camera(rgb, (0, 0, -6), fov=16, size=48))
        p = points(out)
        off = np.linalg.norm(p - (0, 0, -0.4), axis=-1) > 0.6
        flying[kind] = np.sum((out["opacity.Y"] > 0.5) & off & (p[..., 2] < 0.7))
    assert flying["median"] == flying["refined"] == 0 < flying["expected"]


def test16_nan_weights_are_empty_space(rgb, files):
    scene = scene_with(rgb, with_gaze(files, "depth,opacity,visibility"))
    params, key = rgb.traverse(scene), "integrator.field.density_net.1"
    put(params, key, params[key] * math.nan)
    out = picture(rgb, scene)
    assert np.all(out[..., 3:] == 0) and np.all(np.isfinite(out))


# ---- No derivative is NaN: in vacuum, in solid matter, and for observers on surfaces ----

# In front of the fog, on it, in it, on the sphere, and at the camera.
EYES = ((-2.0, 0.3, -2.0), (0.0, 0.0, -1.0), (0.1, 0.2, 0.3), (0.0, 0.9, -0.3), (0.5, 0.4, -3.0))


@pytest.mark.nightly
@pytest.mark.parametrize(
    "visibility, depth, eyes", [("depth", "median", EYES), ("transmittance", "expected", EYES[2::2])]
)
def test01_extreme_parameters(rgb, files, visibility, depth, eyes):
    """Of all AOVs, summed, with respect to density, falloff, gaze weights, and the positions of observer, camera and a
    shape."""
    density = fog(1.0, rgb.ScalarTransform4f().translate(-1).scale(2))
    gaze, observer = stored("gazefield", files / "gaze.safetensors"), make_observer(rgb, *EYES[0])
    how = {"visibility": visibility, "depth": depth, "step": 0.2, "surface_opacity": 0.0, "falloff": 1.0}
    integrator = plugin("nerg", density=density, aovs=GAZE, gaze=gaze, observer=observer, **how)
    ball = {"type": "sphere", "center": [0, 0.9, 0], "radius": 0.3}
    scene = scene_with(rgb, integrator, camera(rgb, size=4), ball=ball)
    params, poses = rgb.traverse(scene), ["sensor.to_world", "ball.to_world"]
    rest = ["integrator.gaze.grid.table", "integrator.gaze.capture_head.0"]
    start = {key: rgb.Transform4f(params[key]) for key in poses}
    weights = {key: type(params[key])(params[key]) for key in rest}
    for sigma in (0.0, 1e-30, 1e9):
        for eye in eyes:
            x = rgb.Float(0)
            dr.enable_grad(x)
            params["integrator.density.value.value"] = rgb.Float(sigma) + x
            params["integrator.falloff"] = x
            params["integrator.observer.to_world"] = rgb.Transform4f().translate(rgb.Vector3f(*eye) + x)
            for key in poses:
                params[key] = rgb.Transform4f().translate(rgb.Vector3f(x, 0.5 * x, -x)) @ start[key]
            for key in rest:
                params[key] = weights[key] + x
            params.update()
            picture = rgb.render(scene, params, spp=1)
            assert np.isfinite(picture.numpy()).all(), (sigma, eye)
            dr.backward(dr.sum(picture, axis=None))
            assert np.isfinite(dr.grad(x).numpy().item()), (sigma, eye)
