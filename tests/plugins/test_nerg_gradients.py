"""Derivatives of images against central differences, and their use by optimisers and ray loaders."""

import drjit as dr
import numpy as np
import pytest

from . import fields
from .scenes import (
    attach,
    camera,
    constant,
    look_at,
    make_observer,
    picture,
    plugin,
    put,
    scene_with,
    sphere,
    square,
    still,
    stored,
    with_gaze,
)

# ---- Derivatives of images from mi.render, against central differences ----

SIZE = 6
COLOR, DEPTH, OPACITY, LAST = [0, 1, 2], [3], [4], [5]


@pytest.fixture(scope="module")
def learnt(tmp_path_factory):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("fields")
    fields.radiance(folder / "field.safetensors", density_scale=1.5)
    fields.radiance(folder / "deferred.safetensors", density_scale=1.5, deferred=True)
    fields.gaze(folder / "gaze.safetensors")
    return folder


def small_camera(mi, origin=(0.3, 0.2, -3), **overrides):
    return still(camera(mi, origin, size=SIZE, **{"fov": 25, **overrides}))


def smooth(**kwargs):
    """An integrator whose images are continuous except at geometric edges."""
    return plugin("nerg", depth="expected", step=0.1, stop=1e-12, color_cutoff=0.0, background=0.3) | kwargs


def neural(mi, files, aovs="depth,opacity,gaze", observer=None, **kwargs):
    overrides = {} if observer is None else {"observer": {"type": "perspective", "to_world": look_at(mi, observer)}}
    volumes = {"field": stored("nerf", files / "field.safetensors")}
    volumes["gaze"] = stored("gazefield", files / "gaze.safetensors")
    return smooth(aovs=aovs, surface_opacity=0.0, **volumes, **overrides) | kwargs


def loss_of(mi, scene, params, channels):
    """A sum with a separate weight for each channel, so that no two of them can cancel."""
    image = mi.render(scene, params=params, spp=1, seed=0)
    mask = np.zeros(image.shape, np.float32)
    mask[..., channels] = np.random.default_rng(0).uniform(0.2, 1, image.shape)[..., channels]
    return dr.sum(image * mi.TensorXf(mask), axis=None)


def check(mi, scene, name, channels, h, picks=3, rtol=0.04):
    """AD against central differences for the entries of ``name`` with the largest derivatives."""
    params = mi.traverse(scene)
    value = type(params[name])(params[name])
    x = type(value)(value)
    dr.enable_grad(x)
    put(params, name, x)
    dr.backward(loss_of(mi, scene, params, channels))
    gradient = dr.grad(x).numpy().ravel()
    assert np.all(np.isfinite(gradient)) and gradient.any()
    base = value.numpy()
    order = np.argsort(-np.abs(gradient))[: picks * 4 : 4] if gradient.size > picks * 4 else np.arange(gradient.size)
    expected = []
    for i in order:
        ends = []
        for sign in (1, -1):
            moved = base.copy()
            moved.flat[i] += sign * h
            put(params, name, type(value)(moved))
            ends.append(np.float64(loss_of(mi, scene, params, channels).numpy().item()))
        expected.append((ends[0] - ends[1]) / (2 * h))
    put(params, name, value)
    got, expected = gradient[order], np.array(expected)
    assert np.allclose(got, expected, rtol=rtol, atol=rtol * np.abs(expected).max()), (got, expected)


DENSITY = [("grid.table", 5e-3), ("density_net.0", 2e-3), ("density_net.1", 2e-3)]
GAZE = ["grid.table", "position_net.0", "direction_net.1", "emit_head.0", "capture_head.0"]
BEHIND = {"aovs": "depth,opacity,visibility", "observer": (-2, 0.5, 2), "falloff": 3.0, "tolerance": 0.05}
CASES = [
    *((f"field.{name}", h, channels, {}) for name, h in DENSITY for channels in (COLOR, DEPTH, OPACITY, LAST)),
    *(
        (f"field.{name}", 2e-3, DEPTH, {"depth": k})
        for name in ("grid.table", "density_net.1")
        for k in ("median", "refined")
    ),
    *((f"field.{name}", 1e-2, COLOR, {}) for name in ("color_net.0", "color_net.2")),
    *((f"gaze.{name}", 1e-2, LAST, {"observer": (-2, 0.5, -2)}) for name in GAZE),
    ("falloff", 1e-2, LAST, BEHIND),
    ("field.density_net.1", 2e-3, LAST, BEHIND),
]


@pytest.mark.parametrize("name, h, channels, more", CASES)
def test01_weights_and_falloff(rgb, learnt, name, h, channels, more):
    scene = scene_with(rgb, neural(rgb, learnt, **more), small_camera(rgb))
    check(rgb, scene, f"integrator.{name}", channels, h, rtol=0.05 if more else 0.04)


@pytest.mark.parametrize("name, h", [("grid.table", 5e-3), ("density_net.1", 2e-3), ("color_net.0", 1e-2)])
def test02_deferred_field(rgb, learnt, name, h):
    field = stored("nerf", learnt / "deferred.safetensors")
    scene = scene_with(rgb, neural(rgb, learnt, field=field), small_camera(rgb))
    check(rgb, scene, f"integrator.field.{name}", COLOR, h)


@pytest.mark.parametrize("quadrature", ["constant", "linear"])
def test07_gridvolume(rgb, quadrature):
    data = np.random.default_rng(0).exponential(1, (4, 5, 6)).astype(np.float32)
    data[1] = 0  # empty voxels have derivatives, too
    place = rgb.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    color = {"type": "constvolume", "value": {"type": "rgb", "value": [0.8, 0.5, 0.2]}}
    density = plugin("gridvolume", grid=rgb.VolumeGrid(data), to_world=place)
    integrator = smooth(aovs="depth,opacity", quadrature=quadrature, density=density, color=color)
    scene = scene_with(rgb, integrator, small_camera(rgb))
    params = rgb.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("density.data"))
    # One-sided at 0, where density is clamped: raise the empty voxels slightly.
    put(params, key, rgb.TensorXf(np.maximum(params[key].numpy(), 0.02)))
    for channels in (COLOR, DEPTH, OPACITY):
        check(rgb, scene, key, channels, 1e-2, rtol=0.03)


@pytest.mark.parametrize("visible", [False, True])
def test08_observer_position(rgb, learnt, visible):
    aovs = "depth,opacity,visibility" if visible else "depth,opacity,gaze"
    how = {"observer": (-2.0, 0.5, -2.0), "falloff": 3.0, "tolerance": 0.05, "occlusion": visible}
    scene = scene_with(rgb, neural(rgb, learnt, aovs, **how), small_camera(rgb))
    params, key = rgb.traverse(scene), "integrator.observer.to_world"
    base = rgb.Transform4f(params[key])

    def loss(x):
        # A direction in which no edge is crossed; gaze is piecewise smooth in the observer's cell.
        put(params, key, rgb.Transform4f().translate(rgb.Vector3f(0.3 * x, x, -0.5 * x)) @ base)
        return loss_of(rgb, scene, params, LAST)

    x, h = rgb.Float(0), 2e-3
    dr.enable_grad(x)
    dr.backward(loss(x))
    got = dr.grad(x).numpy().item()
    ends = [loss(rgb.Float(s * h)).numpy().item() for s in (1, -1)]
    assert np.isfinite(got) and got != 0
    assert np.isclose(got, (ends[0] - ends[1]) / (2 * h), rtol=0.05, atol=2e-3)


def test09_rays_without_matter_give_no_nan(rgb, learnt):
    # Most rays miss; half of the others meet almost no matter.
    integrator = neural(rgb, learnt, "depth,opacity,gaze,position,visibility", observer=(-2, 0.5, -2))
    scene = scene_with(rgb, integrator, small_camera(rgb, fov=120))
    params = rgb.traverse(scene)
    keys = ["integrator.field.grid.table", "integrator.gaze.grid.table", "integrator.falloff"]
    attach(params, *keys)
    dr.backward(dr.sum(rgb.render(scene, params=params, spp=1), axis=None))
    for k in keys:
        assert np.all(np.isfinite(dr.grad(params[k]).numpy())), k


def test10_sensor_on_its_near_plane(rgb, learnt):
    # Rays of a panorama start at the observer: where they miss, surface and observer coincide.
    sensor = still(camera(rgb, kind="panorama", film={"width": 8, "height": 4}))
    sensor["to_world"] = rgb.ScalarTransform4f().translate([0, 0, -3])
    scene = scene_with(rgb, neural(rgb, learnt) | {"observer": dict(sensor)}, sensor)
    params, key, x = rgb.traverse(scene), "integrator.observer.to_world", rgb.Float(0)
    dr.enable_grad(x)
    put(params, key, rgb.Transform4f().translate([x, 0, 0]) @ rgb.Transform4f(params[key]))
    dr.backward(dr.sum(rgb.render(scene, params=params, spp=1), axis=None))
    assert np.isfinite(dr.grad(x).numpy().item())


def test11_forward_mode(rgb, learnt):
    scene = scene_with(rgb, neural(rgb, learnt), small_camera(rgb))
    params, key, x = rgb.traverse(scene), "integrator.field.density_net.1", rgb.Float(1)
    value = rgb.TensorXf(params[key])
    dr.enable_grad(x)
    put(params, key, value * x)
    image = rgb.render(scene, params=params, spp=1)
    dr.forward(x)
    got, ends = dr.grad(image).numpy(), []
    for s in (1.002, 0.998):
        put(params, key, value * s)
        ends.append(picture(rgb, scene))
    expected = (ends[0] - ends[1]) / 0.004
    assert np.abs(expected).max() > 0.01
    assert np.allclose(got[..., :5], expected[..., :5], atol=0.03 * np.abs(expected[..., :5]).max())


@pytest.mark.parametrize("whose", ["integrator.observer.to_world", "sensor.b.to_world"])
def test12_batch_poses_support_reverse_mode_only(rgb, whose):
    """Forward mode is refused where Mitsuba would abort the process."""
    film = {**small_camera(rgb)["film"], "width": 2 * SIZE}
    cameras = {n: small_camera(rgb, (x, 0.4, -3)) for n, x in (("a", 0.5), ("b", -0.5))}
    integrator = plugin("nerg", aovs="observer_depth", occlusion=False, observer=make_observer(rgb, 2, 0.1, -3))
    scene = scene_with(rgb, integrator, plugin("batch", film=film, **cameras), s={"type": "sphere"})
    params = rgb.traverse(scene)
    key = next(k for k in params.keys() if k.endswith(whose.split(".", 1)[1]))
    pose = rgb.Transform4f(params[key])

    def total(x):
        dr.enable_grad(x)
        put(params, key, rgb.Transform4f().translate([x, 0, 0]) @ pose)
        return dr.sum(rgb.render(scene, params=params, spp=1)[..., 3], axis=None)

    x = rgb.Float(0)
    value = total(x)
    with pytest.raises(ValueError, match="one by one"):
        dr.forward(x)
    del value
    x = rgb.Float(0)
    dr.backward(total(x))
    assert np.isfinite(dr.grad(x).numpy().item()) and dr.grad(x).numpy().item() != 0


# ---- Optimisation with Mitsuba's optimisers and ray loaders: parameters and gaze are recovered ----

SEEN, HELD_OUT = ((0.5, 0.4, -3), (-1.5, 0.3, -2.6), (2.0, -0.5, -2.2)), (1.3, 0.0, -2.7)


def learn(params, opt, loss, steps):
    """Minimise ``loss``, a function of the step, with ``opt``; returns the losses."""
    params.update(opt)
    losses = []
    for i in range(steps):
        value = loss(i)
        dr.backward(value)
        opt.step()
        params.update(opt)
        losses.append(value.numpy().item())
    return losses


def test01_adam_recovers_falloff_and_density(rgb):
    """Both at once: visibility determines the first, opacity the second, in fog that camera and observer see from two
    sides."""
    fog = plugin("constvolume", value=1.5, to_world=rgb.ScalarTransform4f().translate(-1).scale(2))
    overrides = {"density": fog, "observer": make_observer(rgb, -2, 0.3, 2), "falloff": 2.0}
    scene = scene_with(rgb, constant(aovs="opacity,visibility") | overrides, still(camera(rgb, size=6)))
    target, params = rgb.render(scene, spp=1), rgb.traverse(scene)
    falloff, density = "integrator.falloff", "integrator.density.value.value"
    opt = rgb.ad.Adam(lr=0.05, params={falloff: rgb.Float(1.0), density: rgb.Float(0.6)})
    off = lambda i: dr.mean(dr.square(rgb.render(scene, params, spp=1, seed=i) - target), axis=None)
    losses = learn(params, opt, off, 100)
    assert losses[-1] < 1e-3 * losses[0]
    assert opt[falloff].numpy().item() == pytest.approx(2.0, rel=0.02)
    assert opt[density].numpy().item() == pytest.approx(1.5, rel=0.02)


@pytest.fixture
def improves(rgb, files):
    """Whether gaze weights can be trained on ``batches(scene, views)``, a function of the step that returns a sensor
    and the reference gaze. The gaze grows with x, by a factor of e per unit, so all cameras are consistent."""
    integrator = with_gaze(
        files, "gaze,position", falloff=2.0, radiance=False, observer=make_observer(rgb, -2, 0.3, -2)
    )
    sensors = {f"camera{i}": still(camera(rgb, origin, size=8)) for i, origin in enumerate((*SEEN, HELD_OUT))}
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, **sensors})
    pictures = [np.array(rgb.render(scene, sensor=s, spp=1)) for s in scene.sensors()]
    views, params = [p[..., 3] * np.exp(p[..., 4]) for p in pictures], rgb.traverse(scene)

    def error():
        """Relative error of a held-out camera."""
        got = np.array(rgb.render(scene, sensor=len(SEEN), spp=1))[..., 3]
        return np.linalg.norm(got - views[-1]) / np.linalg.norm(views[-1])

    def improves(batches):
        next_batch, before = batches(scene, views[:3]), error()
        keys = [key for key in params.keys() if key.startswith("integrator.gaze.")]

        def loss(i):
            sensor, target = next_batch(i)
            result = rgb.render(scene, params, sensor=sensor, spp=1, seed=i)[..., 3]
            return dr.mean(dr.square(result - target), axis=None) / np.mean(np.square(views))

        losses = learn(params, rgb.ad.Adam(lr=0.02, params={key: params[key] for key in keys}), loss, 36)
        return np.mean(losses[-3:]) < 0.4 * np.mean(losses[:3]) and error() < 0.5 * before

    return improves


def test02_gaze_weights_train_on_whole_views(rgb, improves):
    assert improves(lambda scene, views: lambda i: (i % 3, rgb.TensorXf(views[i % 3])))


@pytest.mark.nightly
def test03_gaze_weights_train_on_ray_batches(rgb, improves):
    """Random pixels of all cameras per step, with their targets in the loader's colours."""

    def batches(scene, views):
        colors = [rgb.TensorXf(np.repeat(view[..., None], 3, -1)) for view in views]
        how = {"pixels_per_batch": 64, "regular_reshuffle": True, "tile_size": 1}
        loader = rgb.ad.loaders.RayDataLoader(scene.sensors()[:3], colors, **how)

        def batch(_):
            target, rays = loader.next()
            return rays, target[..., 0]

        return batch

    assert improves(batches)


def test04_ray_batch_matches_its_pixels(rgb, files):
    """All channels. Rays are almost parallel, since the loader moves each within its pixel: all cameras show a single
    value."""
    integrator = with_gaze(files, observer=make_observer(rgb, -2, 0.3, -2), falloff=2.0)
    positions = [(0.2 * i - 0.5, 0.3 - 0.1 * i, -3) for i in range(3)]
    sensors = {f"camera{i}": camera(rgb, o, (o[0], o[1], 0), size=6, fov=0.01) for i, o in enumerate(positions)}
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, **sensors})
    pictures = [rgb.render(scene, sensor=s, spp=1) for s in scene.sensors()]
    # A divisor of the number of pixels: without tiles the loader of 3.9.1 otherwise draws pixels beyond the last one.
    how = {"pixels_per_batch": 36, "tile_size": 1}
    colors, rays = rgb.ad.loaders.RayDataLoader(scene.sensors(), [p[..., :3] for p in pictures], **how).next()
    got, selected = np.array(rgb.render(scene, sensor=rays, spp=1))[0], np.array(rays.pixel_idx)
    expected = np.array(pictures).reshape(3 * 36, -1)[selected]
    assert len(np.unique(selected)) == 36 and len(np.unique(selected // 36)) == 3
    assert np.allclose(np.array(colors)[0], expected[:, :3])
    span = np.ptp(expected, axis=0)
    assert np.all(span[:6] > 1e-4) and np.all(np.abs(got - expected) <= 0.1 * span)


# ---- The derivative of something that the march does not depend on ----


@pytest.mark.parametrize(
    "kind, light",
    [
        *((kind, "nested") for kind in ("grid", "gaze")),
        *(pytest.param(kind, "nested", marks=pytest.mark.nightly) for kind in ("field", "refined")),
        *(("grid", light) for light in ("direct", "emitters", "headlight")),
    ],
)
def test_march_beside_a_differentiated_albedo_stays_one_kernel(rgb, learnt, kind, light):
    """Mitsuba evaluates the loops of a derivative: each step would be a kernel, and take seconds per image."""

    def make(step):
        nested = {"nested": {"type": "path", "max_depth": 2}, "direct": {"type": "direct"}}
        path = {"inner": nested[light]} if light in nested else {}
        if kind == "grid":
            data = rgb.TensorXf(np.full((4, 4, 4, 1), 1.5, np.float32))
            integrator = plugin(
                "nerg", step=step, quadrature="constant", density=plugin("gridvolume", data=data), **path
            )
        elif kind == "refined":
            integrator = plugin("nerg", step=step, density=plugin("constvolume", value=1.0), depth="refined", **path)
        else:
            observer = {"observer": make_observer(rgb, -2, 0.3, -2)} if kind == "gaze" else {}
            integrator = plugin(
                "nerg", step=step, field=stored("nerf", learnt / "field.safetensors"), **observer, **path
            )
            if kind == "gaze":
                integrator |= {
                    "gaze": stored("gazefield", learnt / "gaze.safetensors"),
                    "aovs": "depth,gaze,visibility",
                }
        emitters = {} if light == "headlight" else {"light": {"type": "constant"}}
        return scene_with(rgb, integrator, small_camera(rgb), ball=sphere(rgb, 0, 0, 3, radius=1.5), **emitters)

    counts = []
    for step in (0.2, 0.02):
        scene = make(step)
        params = rgb.traverse(scene)
        key = next(k for k in params.keys() if k.endswith("reflectance.value"))
        attach(params, key)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.backward(dr.mean(rgb.render(scene, params, spp=64)[..., :3]))
            slope = np.array(dr.grad(params[key])).ravel().sum()
            counts.append(len(dr.kernel_history([dr.KernelType.JIT])))
    assert counts[0] == counts[1] < 100
    with dr.suspend_grad():
        means = []
        for value in (0.4, 0.6):
            put(params, key, rgb.Color3f(value))
            means.append(np.mean(np.array(rgb.render(scene, spp=64))[..., :3]))
    assert slope == pytest.approx((means[1] - means[0]) / 0.2, rel=0.05)


@pytest.mark.parametrize("nested", [True, False])
@pytest.mark.parametrize("key", ["ball.bsdf.reflectance.value", "light.emitter.radiance.value"])
def test_derivatives_store_no_bounces_of_paths(rgb, nested, key):
    """They would fill the memory: 4 kB a path."""
    counts = []
    for depth in (3, 12) if nested else (None,):
        path = {"inner": {"type": "path", "max_depth": depth}} if nested else {}
        lamp = {"type": "area", "radiance": {"type": "rgb", "value": 2.0}}
        light = plugin("rectangle", to_world=look_at(rgb, (0, 4, 0), (0, 0, 2)).scale([2, 2, 1]), emitter=lamp)
        shapes = {"ball": sphere(rgb, 0, 0, 2, radius=1.2), "floor": square(rgb, 4, size=4.0)}
        scene = scene_with(rgb, constant(0.2, **path), small_camera(rgb), light=light, **shapes)
        params = rgb.traverse(scene)
        attach(params, key)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.backward(dr.mean(rgb.render(scene, params, spp=256)[..., :3]))
            counts.append(len(dr.kernel_history([dr.KernelType.JIT])))
        slope = np.array(dr.grad(params[key])).ravel().sum()
        value = np.array(params[key]).mean()
        with dr.suspend_grad():
            means = []
            for factor in (0.95, 1.05):
                put(params, key, rgb.Color3f(factor * value))
                means.append(np.mean(np.array(rgb.render(scene, spp=256))[..., :3]))
        assert slope == pytest.approx((means[1] - means[0]) / (0.1 * value), rel=0.05) and slope > 0
    assert len(set(counts)) == 1 and counts[0] < 20
