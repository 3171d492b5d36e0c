"""The integrator at the ends of what a scene may ask for: densities, sizes, observers, films; forwards and
backwards."""

import math

import drjit as dr
import numpy as np
import pytest

from nerg_mi.transport.quadrature import RULES
from tests.reference import march_numpy as reference

from .scenes import GAZE, camera, channels, constant, look_at, observer_at, render, with_gaze

DEPTH_SLOPE = 1e-4
SLAB = [1e-6, 1e-3, 1.0, 1e3, 1e6, 1e9]


def probe(mi, ahead):
    """One ray along +z through the unit cube, whose face lies ``ahead`` of the ray's origin."""
    # Mitsuba starts the rays of this sensor a hair in front of it.
    return {
        "type": "radiancemeter",
        "origin": [0.5, 0.5, -ahead - float(mi.math.RayEpsilon)],
        "direction": [0, 0, 1],
        "sampler": {"type": "independent", "sample_count": 1},
        "film": {"type": "hdrfilm", "width": 1, "height": 1, "component_format": "float32", "rfilter": {"type": "box"}},
    }


def volume(mi, kind, sigma):
    if kind == "constvolume":
        return {"type": "constvolume", "value": float(sigma)}
    return {"type": "gridvolume", "grid": mi.VolumeGrid(np.full((3, 3, 3), sigma, np.float32)), "raw": True}


def slab_scene(mi, kind, sigma, ahead):
    integrator = {
        "type": "nerg",
        "id": "integrator",
        "density": volume(mi, kind, sigma),
        "depth": "expected",
        "radiance": False,
    }
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": probe(mi, ahead)})


@pytest.mark.parametrize("ahead", [0, 1])
@pytest.mark.parametrize("kind", ["constvolume", "gridvolume"])
def test01_slabs_with_nothing_set(rgb, kind, ahead):
    for sigma in SLAB:
        depth, opacity = np.array(rgb.render(slab_scene(rgb, kind, sigma, ahead), spp=1)).ravel()[3:]
        alpha, expected, _ = reference.slab(sigma, ahead, ahead + 1)
        assert np.isclose(opacity, alpha, rtol=1e-5), sigma
        # With the face at the origin the depth of dense matter is 1/σ and nothing else.
        assert np.isclose(depth, expected, rtol=1e-5), sigma


@pytest.mark.parametrize("kind", ["constvolume", "gridvolume"])
def test02_their_derivatives(rgb, kind):
    for sigma in [0.1, 10.0, *SLAB]:
        scene = slab_scene(rgb, kind, sigma, 0)
        params = rgb.traverse(scene)
        key = next(k for k in params.keys() if k.endswith(("value.value", "density.data")))
        got = {}
        for name, channel in (("depth", 3), ("opacity", 4)):
            value = type(params[key])(dr.detach(params[key]))
            dr.enable_grad(value)
            params[key] = value
            params.update()
            dr.backward(dr.gather(rgb.Float, rgb.render(scene, params, spp=1).array, channel))
            got[name] = float(np.array(dr.grad(value)).sum())
        slope = math.exp(-sigma)
        assert np.isclose(got["opacity"], slope, rtol=1e-4 if slope > 1e-6 else 0, atol=0 if slope > 1e-6 else 1e-6), (
            sigma
        )
        # h(τ) = 1/τ - 1/expm1(τ), the mean depth of absorption.
        change = (
            -1 / sigma**2 + (1 / (4 * math.sinh(sigma / 2) ** 2) if sigma < 700 else 0) if sigma > 0.01 else -1 / 12
        )
        if 0.1 <= sigma <= 1e3:
            assert np.isclose(got["depth"], change, rtol=DEPTH_SLOPE), sigma
        assert np.isfinite(got["depth"])


@pytest.mark.parametrize("quadrature", RULES.names())
def test03_thin_sheets_in_a_near_vacuum_are_met_with_nothing_else_set(rgb, quadrature):
    data = np.full((10000, 1, 1), 1e-8, np.float32)
    data[7000] = 1e9
    density = {"type": "gridvolume", "grid": rgb.VolumeGrid(data), "raw": True, "filter_type": "nearest"}
    integrator = {"type": "nerg", "density": density, "quadrature": quadrature}
    out = channels(rgb, integrator, camera(rgb, (0.5, 0.4, -1), (0.5, 0.5, 1), fov=10))
    assert np.all(out["opacity.Y"] == 1)
    # The oblique pixels look from a little more than 1.7 away.
    assert np.all((out["depth.T"] > 1.68) & (out["depth.T"] < 1.75))


@pytest.mark.parametrize("size", [1e-3, 1e6])
def test04_places_of_any_size(rgb, size):
    # The near plane is at a share of the place's size.
    def view(s):
        to_world = rgb.ScalarTransform4f().translate([-s / 2] * 3).scale(s)
        integrator = {"type": "nerg", "density": {"type": "constvolume", "value": 3.0 / s, "to_world": to_world}}
        sensor = {
            **camera(rgb, fov=25),
            "to_world": look_at(rgb, np.multiply((0.5, 0.4, -3), s)),
            "near_clip": 1e-2 * s,
            "far_clip": 1e4 * s,
            "sampler": {"type": "stratified", "jitter": False, "sample_count": 1},
        }
        return channels(rgb, integrator, sensor)

    a, b = view(1.0), view(size)
    assert np.allclose(a["opacity.Y"], b["opacity.Y"], rtol=1e-4, atol=1e-4)
    hit = a["opacity.Y"] > 1e-2
    assert np.allclose(a["depth.T"][hit], b["depth.T"][hit] / size, rtol=1e-5)


def test05_a_place_far_from_the_origin_keeps_what_floats_hold(rgb):
    # 1e5 units away positions are 0.008 apart: opacity stays, depth is good to that.
    to_world = rgb.ScalarTransform4f().translate([1e5, 0, 0])
    integrator = {
        "type": "nerg",
        "density": {"type": "constvolume", "value": 3.0, "to_world": to_world},
        "depth": "expected",
    }
    out = channels(rgb, integrator, camera(rgb, (1e5 + 0.5, 0.5, -2), (1e5 + 0.5, 0.5, 0), fov=2))
    alpha, expected, _ = reference.slab(3, 1.99, 2.99)
    assert np.allclose(out["opacity.Y"], alpha, rtol=1e-2)
    assert np.allclose(out["depth.T"], expected, atol=0.03)


@pytest.mark.parametrize("step, spp", [(10.0, 1), (0.5, 1), (1 / 4096, 1), (0.05, 4096)])
def test06_samples(rgb, step, spp):
    # Constant density is exact at any step, and so is the mean of equal samples.
    to_world = rgb.ScalarTransform4f().translate([-9, -9, 0]).scale([18, 18, 1])
    integrator = {
        "type": "nerg",
        "density": {"type": "constvolume", "value": 2.0, "to_world": to_world},
        "depth": "expected",
        "step": step,
    }
    sensor = {
        "type": "orthographic",
        "to_world": rgb.ScalarTransform4f().translate([0, 0, -1]),
        "film": camera(rgb, size=2)["film"],
        "sampler": {"type": "independent"},
        "near_clip": 0.5,
    }
    out = channels(rgb, integrator, sensor, spp=spp)
    alpha, expected, _ = reference.slab(2, 0.5, 1.5)
    assert np.allclose(out["opacity.Y"], alpha, rtol=1e-5) and np.allclose(out["depth.T"], expected, rtol=1e-5)


def test07_a_crop_of_one_pixel(rgb):
    still = {"sampler": {"type": "stratified", "jitter": False, "sample_count": 1}}
    integrator = constant(2.0)
    sensor = lambda film=(): camera(rgb, (0.5, 0.4, -2), (0.5, 0.5, 0.5), film=film) | still
    whole = render(rgb, integrator, sensor())
    for x, y in ((0, 0), (11, 11), (6, 5)):
        crop = {"crop_offset_x": x, "crop_offset_y": y, "crop_width": 1, "crop_height": 1}
        assert np.allclose(render(rgb, integrator, sensor(crop)), whole[y : y + 1, x : x + 1], rtol=1e-5, atol=1e-6)


# ------------------------------------------------------------------------
#  Observers
# ------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["depth", "transmittance", "map"])
@pytest.mark.parametrize("falloff", [0.0, 1e-38, 1e30])
def test08_observers_anywhere_with_any_falloff(rgb, files, kind, falloff):
    for origin in ((0, 0, -1), (0.1, 0.1, 0.1), (0.6, 0.5, -5), (1e6, 0, -1e6), (1e-30, 0, 0)):
        integrator = with_gaze(
            files,
            GAZE,
            observer=observer_at(rgb, *origin),
            visibility=kind,
            falloff=falloff,
            map_height=32,
            surface_opacity=0.0,
        )
        out = channels(rgb, integrator)
        assert all(np.all(np.isfinite(v)) for v in out.values()), origin
        assert out["visibility.Y"].min() >= 0 and out["visibility.Y"].max() <= 1 + 1e-6


def test09_who_stands_in_solid_matter_sees_nothing_of_its_outside(rgb):
    to_world = rgb.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    for kind in ("depth", "transmittance", "map"):
        integrator = {
            "type": "nerg",
            "density": {"type": "constvolume", "value": 1e3, "to_world": to_world},
            "aovs": "visibility",
            "visibility": kind,
            "observer": observer_at(rgb, 0, 0, 0),
            "map_height": 64,
        }
        assert np.all(channels(rgb, integrator, camera(rgb, fov=20))["visibility.Y"] <= 1e-6)  # the marches' "stop"


def test10_observers_in_odd_places_give_finite_derivatives(rgb, files):
    for origin in ((0.5, 0.4, -3), (0, 0, -1), (0.2, 0.1, 0.1)):
        integrator = {
            **with_gaze(
                files, "gaze,visibility,depth", observer=observer_at(rgb, *origin), surface_opacity=0.0, falloff=0.5
            ),
            "id": "integrator",
        }
        scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": camera(rgb, size=4)})
        params = rgb.traverse(scene)
        key = "integrator.field.density_net.1"
        value = type(params[key])(params[key])
        dr.enable_grad(value)
        params[key] = value
        params.update()
        dr.backward(dr.sum(rgb.render(scene, params, spp=1), axis=None))
        assert np.all(np.isfinite(np.array(dr.grad(value)))), origin


def test11_observers_who_are_nowhere_are_refused(rgb):
    for bad in (math.nan, math.inf):
        matrix = np.eye(4)
        matrix[0, 3] = bad
        observer = {"type": "perspective", "to_world": rgb.ScalarTransform4f(matrix)}
        with pytest.raises(Exception, match='"observer"'):
            rgb.load_dict(constant(observer=observer))


# ------------------------------------------------------------------------
#  Densities that are none
# ------------------------------------------------------------------------


@pytest.mark.parametrize("sigma, opacity", [(0, 0), (-1, 0), (math.nan, 0), (math.inf, 1), (3e38, 1)])
def test12_foreign_densities_that_are_none_are_masked(rgb, sigma, opacity):
    scene = slab_scene(rgb, "constvolume", sigma, 1)
    assert np.allclose(np.array(rgb.render(scene, spp=1)).ravel()[3:], [opacity, opacity], atol=1e-6)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test13_grids_with_such_values_are_refused_by_name(rgb, bad):
    data = np.ones((2, 3, 4), np.float32)
    data[1, 2, 3] = bad
    integrator = {"type": "nerg", "density": {"type": "gridvolume", "grid": rgb.VolumeGrid(data), "raw": True}}
    with pytest.raises(Exception, match='"density".*1.*1.*2.*3'):
        rgb.load_dict(integrator)


# ------------------------------------------------------------------------
#  Fields and silhouettes
# ------------------------------------------------------------------------


@pytest.mark.parametrize("gain", [1e3, 1e6, -1e6])
def test14_activations_past_their_overflow(rgb, files, gain):
    # exp(log σ) would overflow, or vanish, and the sigmoids of the colour saturate.
    integrator = {**with_gaze(files, "depth,opacity,gaze"), "id": "integrator"}
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": camera(rgb, size=4)})
    params = rgb.traverse(scene)
    keys = ["integrator.field.density_net.1", "integrator.field.color_net.2", "integrator.gaze.capture_head.0"]
    for key in keys:
        value = params[key] * gain
        dr.enable_grad(value)
        params[key] = value
    params.update()
    image = rgb.render(scene, params, spp=1)
    assert np.all(np.isfinite(np.array(image)))
    dr.backward(dr.sum(image, axis=None))
    for key in keys:
        assert np.all(np.isfinite(np.array(dr.grad(params[key])))), key


def test15_the_median_puts_no_surface_in_mid_air(rgb):
    # A ball with a soft edge before a wall: at its silhouette the mean of both depths lies between them.
    n = 48
    z, y, x = np.meshgrid(*[(np.arange(n) + 0.5) / n * 2 - 1] * 3, indexing="ij")
    radius = np.sqrt(x**2 + y**2 + (z + 0.4) ** 2) / 0.5
    data = np.where(z > 0.8, 1e3, 200 * np.clip((1.05 - radius) / 0.1, 0, 1)).astype(np.float32)
    density = {
        "type": "gridvolume",
        "grid": rgb.VolumeGrid(data),
        "raw": True,
        "to_world": rgb.ScalarTransform4f().translate([-1, -1, -1]).scale(2),
    }
    flying = {}
    for kind in ("expected", "median", "refined"):
        integrator = {"type": "nerg", "density": density, "depth": kind, "radiance": False, "aovs": "position,opacity"}
        out = channels(rgb, integrator, camera(rgb, (0, 0, -6), fov=16, size=48))
        p = np.stack([out[f"position.{c}"] for c in "XYZ"], -1)
        off = np.linalg.norm(p - (0, 0, -0.4), axis=-1) > 0.6
        flying[kind] = np.sum((out["opacity.Y"] > 0.5) & off & (p[..., 2] < 0.7))
    assert flying["median"] == flying["refined"] == 0 < flying["expected"]


def test16_weights_set_to_nan_are_empty_space(rgb, files):
    scene = rgb.load_dict(
        {"type": "scene", "integrator": with_gaze(files, "depth,opacity,visibility"), "sensor": camera(rgb)}
    )
    params = rgb.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("field.density_net.1"))
    params[key] = params[key] * math.nan
    params.update()
    out = np.array(rgb.render(scene, spp=1))
    assert np.all(out[..., 3:] == 0) and np.all(np.isfinite(out))
