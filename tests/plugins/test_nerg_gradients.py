"""Derivatives of pictures, as mi.render gives them, against central differences of pictures."""

import drjit as dr
import numpy as np
import pytest

from . import fields

SIZE = 6


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("fields")
    fields.radiance(folder / "field.safetensors", density_scale=1.5)
    fields.radiance(folder / "deferred.safetensors", density_scale=1.5, deferred=True)
    fields.gaze(folder / "gaze.safetensors")
    return folder


def camera(mi, origin=(0.3, 0.2, -3)):
    return {
        "type": "perspective",
        "fov": 25,
        "to_world": mi.ScalarTransform4f().look_at(list(origin), [0, 0, 0], [0, 1, 0]),
        "sampler": {"type": "stratified", "jitter": False, "sample_count": 1},
        "film": {
            "type": "hdrfilm",
            "width": SIZE,
            "height": SIZE,
            "component_format": "float32",
            "pixel_format": "rgb",
            "rfilter": {"type": "box"},
        },
    }


def neural(mi, files, aovs="depth,opacity,gaze", observer=None, **kwargs):
    out = {
        "type": "nerg",
        "depth": "expected",
        "field": {"type": "nerf", "filename": str(files / "field.safetensors")},
        "gaze": {"type": "gazefield", "filename": str(files / "gaze.safetensors")},
        "aovs": aovs,
        "step": 0.1,
        "stop": 1e-12,
        "color_cutoff": 0.0,
        "surface_opacity": 0.0,
        "background": 0.3,
        **kwargs,
    }
    if observer:
        out["observer"] = {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at(list(observer), [0, 0, 0], [0, 1, 0]),
        }
    return out


def scene_of(mi, integrator):
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": camera(mi)})


def weights(shape, seed=0):
    """Of each channel in the loss, so that no two of them can cancel."""
    return np.random.default_rng(seed).uniform(0.2, 1, shape).astype(np.float32)


def loss_of(mi, scene, params, channels):
    image = mi.render(scene, params=params, spp=1, seed=0)
    mask = np.zeros(image.shape, np.float32)
    mask[..., channels] = weights(image.shape)[..., channels]
    return dr.sum(image * mi.TensorXf(mask), axis=None)


def check(mi, scene, name, channels, h, picks=4, rtol=0.02):
    """AD against central differences for the entries of ``name`` with the largest derivatives."""
    params = mi.traverse(scene)
    value = type(params[name])(params[name])
    x = type(value)(value)
    dr.enable_grad(x)
    params[name] = x
    params.update()
    dr.backward(loss_of(mi, scene, params, channels))
    gradient = dr.grad(x).numpy().ravel()
    assert np.all(np.isfinite(gradient)) and gradient.any()
    base = value.numpy()
    order = np.argsort(-np.abs(gradient))[: picks * 4 : 4] if gradient.size > picks * 4 else np.arange(gradient.size)
    got, expected = [], []
    for i in order:
        ends = []
        for sign in (1, -1):
            moved = base.copy()
            moved.flat[i] += sign * h
            params[name] = type(value)(moved)
            params.update()
            ends.append(np.float64(loss_of(mi, scene, params, channels).numpy().item()))
        got.append(gradient[i])
        expected.append((ends[0] - ends[1]) / (2 * h))
    params[name] = value
    params.update()
    got, expected = np.array(got), np.array(expected)
    assert np.allclose(got, expected, rtol=rtol, atol=rtol * np.abs(expected).max()), (got, expected)


COLOR, DEPTH, OPACITY, GAZE = [0, 1, 2], [3], [4], [5]


@pytest.mark.parametrize("channels", [COLOR, DEPTH, OPACITY, GAZE])
@pytest.mark.parametrize("name, h", [("grid.table", 5e-3), ("density_net.0", 2e-3), ("density_net.1", 2e-3)])
def test01_density(rgb, files, name, h, channels):
    check(rgb, scene_of(rgb, neural(rgb, files)), f"integrator.field.{name}", channels, h, picks=3, rtol=0.04)


@pytest.mark.parametrize("name", ["color_net.0", "color_net.2"])
def test02_colour_net(rgb, files, name):
    check(rgb, scene_of(rgb, neural(rgb, files)), f"integrator.field.{name}", COLOR, 1e-2)


@pytest.mark.parametrize("name, h", [("grid.table", 5e-3), ("density_net.1", 2e-3), ("color_net.0", 1e-2)])
def test02b_a_deferred_field(rgb, files, name, h):
    field = {"type": "nerf", "filename": str(files / "deferred.safetensors")}
    check(rgb, scene_of(rgb, neural(rgb, files, field=field)), f"integrator.field.{name}", COLOR, h, picks=3, rtol=0.04)


@pytest.mark.parametrize("name", ["grid.table", "position_net.0", "direction_net.1", "emit_head.0", "capture_head.0"])
def test03_gaze_weights(rgb, files, name):
    check(
        rgb, scene_of(rgb, neural(rgb, files, observer=(-2, 0.5, -2))), f"integrator.gaze.{name}", GAZE, 1e-2, rtol=0.05
    )


@pytest.mark.parametrize("depth", ["median", "refined"])
@pytest.mark.parametrize("name", ["grid.table", "density_net.1"])
def test04_median_depth(rgb, files, name, depth):
    check(
        rgb, scene_of(rgb, neural(rgb, files, depth=depth)), f"integrator.field.{name}", DEPTH, 2e-3, picks=3, rtol=0.05
    )


def test05_falloff(rgb, files):
    integrator = neural(rgb, files, "depth,opacity,visibility", observer=(-2, 0.5, 2), falloff=3.0, tolerance=0.05)
    check(rgb, scene_of(rgb, integrator), "integrator.falloff", [5], 1e-2)


def test06_visibility_with_respect_to_density(rgb, files):
    integrator = neural(rgb, files, "depth,opacity,visibility", observer=(-2, 0.5, 2), falloff=3.0, tolerance=0.05)
    check(rgb, scene_of(rgb, integrator), "integrator.field.density_net.1", [5], 2e-3, picks=3, rtol=0.05)


@pytest.mark.parametrize("quadrature", ["constant", "linear"])
def test07_gridvolume(rgb, quadrature):
    data = np.random.default_rng(0).exponential(1, (4, 5, 6)).astype(np.float32)
    data[1] = 0  # empty voxels have derivatives too
    integrator = {
        "type": "nerg",
        "depth": "expected",
        "aovs": "depth,opacity",
        "step": 0.1,
        "stop": 1e-12,
        "color_cutoff": 0.0,
        "background": 0.3,
        "quadrature": quadrature,
        "density": {
            "type": "gridvolume",
            "grid": rgb.VolumeGrid(data),
            "to_world": rgb.ScalarTransform4f().translate([-1, -1, -1]).scale(2),
        },
        "color": {"type": "constvolume", "value": {"type": "rgb", "value": [0.8, 0.5, 0.2]}},
    }
    scene = scene_of(rgb, integrator)
    key = next(k for k in rgb.traverse(scene).keys() if k.endswith("density.data"))
    # One-sided at 0, where density is clamped: lift the empty voxels a little.
    params = rgb.traverse(scene)
    params[key] = rgb.TensorXf(np.maximum(params[key].numpy(), 0.02))
    params.update()
    for channels in (COLOR, DEPTH, OPACITY):
        check(rgb, scene, key, channels, 1e-2, rtol=0.03)


@pytest.mark.parametrize("visible", [False, True])
def test08_observer_position(rgb, files, visible):
    aovs = "depth,opacity,visibility" if visible else "depth,opacity,gaze"
    origin = (-2.0, 0.5, -2.0)
    scene = scene_of(rgb, neural(rgb, files, aovs, observer=origin, falloff=3.0, tolerance=0.05, occlusion=visible))
    params = rgb.traverse(scene)
    key = "integrator.observer.to_world"
    base = rgb.Transform4f(params[key])

    def loss(offset):
        params[key] = rgb.Transform4f().translate(offset) @ base
        params.update()
        return loss_of(rgb, scene, params, [5])

    # A direction along which no edge is crossed; gaze is piecewise smooth in the observer's cell.
    x = rgb.Float(0)
    dr.enable_grad(x)
    dr.backward(loss(rgb.Vector3f(0.3 * x, x, -0.5 * x)))
    got = dr.grad(x).numpy().item()
    h = 2e-3
    ends = [loss(rgb.Vector3f(0.3 * s * h, s * h, -0.5 * s * h)).numpy().item() for s in (1, -1)]
    assert np.isfinite(got) and got != 0
    assert np.isclose(got, (ends[0] - ends[1]) / (2 * h), rtol=0.05, atol=2e-3)


def test09_nothing_met_gives_no_nan(rgb, files):
    # Most rays miss; half of the others meet almost nothing.
    integrator = neural(rgb, files, "depth,opacity,gaze,position,visibility", observer=(-2, 0.5, -2))
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": {**camera(rgb), "fov": 120}})
    params = rgb.traverse(scene)
    keys = ["integrator.field.grid.table", "integrator.gaze.grid.table", "integrator.falloff"]
    for k in keys:
        dr.enable_grad(params[k])
    params.update()
    dr.backward(dr.sum(rgb.render(scene, params=params, spp=1), axis=None))
    for k in keys:
        assert np.all(np.isfinite(dr.grad(params[k]).numpy())), k


def test10_a_sensor_that_stands_on_its_own_near_plane(rgb, files):
    # Rays of a panorama start at the observer: where they miss, surface and observer coincide.
    observer = {
        "type": "panorama",
        "to_world": rgb.ScalarTransform4f().translate([0, 0, -3]),
        "film": {"type": "hdrfilm", "width": 4, "height": 4},
    }
    integrator = {**neural(rgb, files), "observer": {**observer}}
    sensor = {**observer, "film": {**camera(rgb)["film"], "width": 8, "height": 4}, "sampler": camera(rgb)["sampler"]}
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})
    params = rgb.traverse(scene)
    key = "integrator.observer.to_world"
    if key not in params:
        pytest.skip("panorama exposes no to_world")
    x = rgb.Float(0)
    dr.enable_grad(x)
    params[key] = rgb.Transform4f().translate([x, 0, 0]) @ rgb.Transform4f(params[key])
    params.update()
    dr.backward(dr.sum(rgb.render(scene, params=params, spp=1), axis=None))
    assert np.isfinite(dr.grad(x).numpy().item())


def test11_forward_mode(rgb, files):
    scene = scene_of(rgb, neural(rgb, files))
    params = rgb.traverse(scene)
    key = "integrator.field.density_net.1"
    value = rgb.TensorXf(params[key])
    x = rgb.Float(1)
    dr.enable_grad(x)
    params[key] = value * x
    params.update()
    image = rgb.render(scene, params=params, spp=1)
    dr.forward(x)
    got = dr.grad(image).numpy()
    ends = []
    for s in (1.002, 0.998):
        params[key] = value * s
        params.update()
        ends.append(np.array(rgb.render(scene, params=params, spp=1)))
    expected = (ends[0] - ends[1]) / 0.004
    assert np.abs(expected).max() > 0.01
    assert np.allclose(got[..., :5], expected[..., :5], atol=0.03 * np.abs(expected[..., :5]).max())


@pytest.mark.parametrize("whose", ["integrator.observer.to_world", "sensor.b.to_world"])
def test12_poses_in_front_of_a_batch_go_backward_only(rgb, whose):
    """Forward mode is refused where Mitsuba would end the process."""
    sensor = {
        "type": "batch",
        "film": {**camera(rgb)["film"], "width": 2 * SIZE},
        **{n: camera(rgb, (x, 0.4, -3)) for n, x in (("a", 0.5), ("b", -0.5))},
    }
    integrator = {
        "type": "nerg",
        "aovs": "observer_depth",
        "occlusion": False,
        "observer": {"type": "perspective", "to_world": rgb.ScalarTransform4f().translate([2, 0.1, -3])},
    }
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, "s": {"type": "sphere"}})
    params = rgb.traverse(scene)
    key = next(k for k in params.keys() if k.endswith(whose.split(".", 1)[1]))
    pose = rgb.Transform4f(params[key])

    def total(x):
        params[key] = rgb.Transform4f().translate([x, 0, 0]) @ pose
        params.update()
        return dr.sum(rgb.render(scene, params=params, spp=1)[..., 3], axis=None)

    for mode in (dr.forward, dr.backward):
        x = rgb.Float(0)
        dr.enable_grad(x)
        value = total(x)
        if mode is dr.forward:
            with pytest.raises(ValueError, match="one by one"):
                dr.forward(x)
        else:
            dr.backward(value)
            assert np.isfinite(dr.grad(x).numpy().item()) and dr.grad(x).numpy().item() != 0
