"""Images of the integrator: seeds, films and variants, closed forms, and a ceiling that cameras look through."""

import math
import subprocess
import sys

import drjit as dr
import numpy as np
import pytest

from nerg_mi.transport.quadrature import RULES

from .scenes import (
    GAZE,
    camera,
    center_rays,
    channels,
    constant,
    look_at,
    make_observer,
    plugin,
    points,
    put,
    render,
    scene_with,
    sphere,
    square,
    still,
    straight,
    with_field,
    with_gaze,
)

# ---- Seeds, films, batches, nesting and variants ----


@pytest.mark.parametrize("rfilter, tolerance", [("box", 0), ("gaussian", 1e-6)])
def test01_equal_seeds(rgb, files, rfilter, tolerance):
    integrator = with_gaze(files, GAZE, jitter=True)
    a, b = (render(rgb, integrator, camera(rgb, rfilter=rfilter), spp=4, seed=7) for _ in range(2))
    assert np.array_equal(a, b) if tolerance == 0 else np.allclose(a, b, atol=tolerance, rtol=1e-6)
    c = render(rgb, integrator, camera(rgb, rfilter=rfilter), spp=4, seed=8)
    assert not np.allclose(a, c, atol=1e-4)


def test01b_integrator_render_uses_the_same_seed_as_mi_render(rgb, files):
    scene = scene_with(rgb, with_field(files))
    separate, other = scene.integrator().render(scene, spp=1), rgb.render(scene, spp=1, seed=1)
    assert np.array_equal(separate, rgb.render(scene, spp=1)) and not np.array_equal(separate, other)


def test02_jitter_alone_makes_seeds_differ(rgb):
    # One ray through the middle of the pixel: only the jitter depends on the seed.
    data = np.random.default_rng(0).exponential(3, (6, 6, 6)).astype(np.float32)
    grid = {"type": "gridvolume", "grid": rgb.VolumeGrid(data)}

    def of_seeds(jitter):
        integrator = constant(density=grid, jitter=jitter, step=0.2)
        return [render(rgb, integrator, straight(rgb, "perspective"), seed=seed) for seed in (1, 2)]

    assert not np.array_equal(*of_seeds(True)) and np.allclose(*of_seeds(False), rtol=1e-3)


def test07_integrator_and_sensor_as_arguments_of_render(rgb, files):
    """The observer is at the rendering camera, not at the scene's own."""
    integrator = with_gaze(files, GAZE)
    expected, elsewhere = render(rgb, integrator), camera(rgb, (2, 1, 2))
    without = rgb.load_dict({"type": "scene", "sensor": camera(rgb)})
    assert np.array_equal(np.array(rgb.render(without, integrator=rgb.load_dict(integrator), spp=1)), expected)
    scene = scene_with(rgb, integrator, elsewhere)
    assert np.array_equal(np.array(rgb.render(scene, sensor=rgb.load_dict(camera(rgb)), spp=1)), expected)


def test09_film_channels_by_name(rgb, files):
    scene = scene_with(rgb, with_gaze(files, "depth,gaze"))
    rgb.render(scene, spp=1)
    layers = [name for name, _ in scene.sensors()[0].film().bitmap().split()]
    assert layers == ["<root>", "depth", "gaze"]


def test10_mono_is_the_luminance_of_rgb(rgb, files):
    integrator = with_gaze(files, GAZE, background={"type": "rgb", "value": [0.1, 0.3, 0.2]})
    a = render(rgb, integrator, still(camera(rgb)))
    rgb.set_variant("llvm_ad_mono")
    b = render(rgb, integrator, still(camera(rgb)))
    assert b.shape[-1] == a.shape[-1] - 2
    assert np.allclose(b[..., 0], a[..., :3] @ [0.212671, 0.715160, 0.072169], atol=1e-4)
    assert np.allclose(b[..., 1:], a[..., 3:], atol=1e-4)


@pytest.mark.parametrize("variant", ["llvm_ad_spectral", "llvm_ad_mono_polarized", "llvm_ad_spectral_polarized"])
def test11_spectral_and_polarized_are_refused(rgb, variant):
    if variant not in rgb.variants():
        pytest.skip(f"{variant} is not in this build of Mitsuba")
    rgb.set_variant(variant)
    try:
        with pytest.raises(RuntimeError, match=f'"nerg" renders rgb and mono variants, not "{variant}".*set_variant'):
            rgb.load_dict(constant())
    finally:
        rgb.set_variant("llvm_ad_rgb")


def test12_scalar_variants_are_refused(files):
    # In a separate process: registrations of scalar_rgb persist.
    code = f"""
import nerg_mi, mitsuba as mi
mi.set_variant("scalar_rgb")
try:
    mi.load_dict({{"type": "nerg"}})
except RuntimeError as e:
    assert '"nerg" needs a variant with compiled kernels' in str(e), e
else:
    raise SystemExit("not refused")
mi.set_variant("llvm_ad_rgb")
mi.load_dict({{"type": "nerf", "filename": r"{files / "field.safetensors"}"}})
mi.load_dict({{"type": "nerg", "field": {{"type": "nerf", "filename": r"{files / "field.safetensors"}"}}}})
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-2000:]


# ---- Images against closed forms, and of grids with empty space ----


@pytest.mark.parametrize("kind", ["orthographic", "perspective"])
@pytest.mark.parametrize("depth", ["expected", "median"])
def test01_unit_cube(rgb_and_mono, kind, depth):
    mi = rgb_and_mono
    out = channels(mi, constant(3.0, depth=depth), straight(mi, kind))
    assert np.isclose(out["opacity.Y"].item(), 1 - math.exp(-3), rtol=1e-5)
    inside = {"expected": 1 / 3 - 1 / math.expm1(3), "median": -math.log((1 + math.exp(-3)) / 2) / 3}[depth]
    # Distance from the ray's own origin, which is on the near plane.
    assert abs(out["depth.T"].item() - (2 - 0.01 + inside)) < 1e-4


@pytest.mark.parametrize("sigma", [0.05, 3.0])
def test03_colour_of_a_homogeneous_volume(rgb_and_mono, sigma):
    # α C + (1 - α) L_behind, even if each step weighs less than color_cutoff.
    mi = rgb_and_mono
    color = {"type": "constvolume", "value": {"type": "rgb", "value": [0.9, 0.5, 0.2]}}
    background = {"type": "rgb", "value": [0.1, 0.2, 0.4]}
    integrator = constant(sigma, color=color, background=background, aovs="")
    image = render(mi, integrator, straight(mi, "perspective")).ravel()
    α = -math.expm1(-sigma)
    expected = α * np.array([0.9, 0.5, 0.2]) + (1 - α) * np.array([0.1, 0.2, 0.4])
    if "mono" in mi.variant():
        expected = expected @ [0.212671, 0.715160, 0.072169]
    assert np.allclose(image, expected, rtol=2e-3)


def test04_environment_replaces_the_background(rgb):
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.4, 0.8]}}
    image = render(rgb, constant(3.0, background=9.0, aovs=""), straight(rgb, "perspective"), sky=sky).ravel()
    assert np.allclose(image, math.exp(-3) * np.array([0.2, 0.4, 0.8]), rtol=1e-4)
    hidden = render(rgb, constant(3.0, hide_emitters=True, aovs=""), straight(rgb, "perspective"), sky=sky).ravel()
    assert not hidden.any()


def test05_envmap_orientation(rgb):
    data = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    sky = {"type": "envmap", "bitmap": rgb.Bitmap(data)}
    path, nerg = (render(rgb, i, seed=1, sky=sky) for i in ({"type": "path"}, constant(0.0, aovs="")))
    assert np.allclose(path, nerg, atol=1e-5) and path.std() > 0.01


@pytest.mark.parametrize("angle", [45, 90, 180])
def test06_rotated_grid_is_not_skipped(rgb, angle):
    # A small dense block of a large empty grid, rotated: its position differs from its indices.
    data = np.zeros((32, 32, 32), np.float32)
    data[14:18, 2:6, 2:6] = 50
    turn = rgb.ScalarTransform4f().rotate([0, 0, 1], angle).translate([-0.5, -0.5, -0.5])
    density = {"type": "gridvolume", "grid": rgb.VolumeGrid(data), "to_world": turn}
    x, y = (np.array(turn.matrix) @ [4 / 32, 4 / 32, 0.5, 1])[:2].tolist()
    sensor = camera(rgb, (x, y, -2), (x, y, 0), fov=1e-3, size=1)
    out = channels(rgb, {"type": "nerg", "density": density, "aovs": "opacity"}, sensor)
    assert out["opacity.Y"].item() > 0.9


def test07_repeating_grid_is_bounded(rgb):
    # The last half voxel interpolates with the first voxel of the next repetition.
    data = np.zeros((8, 8, 8), np.float32)
    data[0] = 40
    opacity = {}
    for wrap in ("clamp", "repeat"):
        density = {"type": "gridvolume", "grid": rgb.VolumeGrid(data), "wrap_mode": wrap}
        sensor = camera(rgb, (-2, 0.5, 0.99), (0, 0.5, 0.99), fov=1e-3, size=1)
        out = channels(rgb, {"type": "nerg", "density": density, "aovs": "opacity"}, sensor)
        opacity[wrap] = out["opacity.Y"].item()
    assert opacity["clamp"] == 0
    assert np.isclose(opacity["repeat"], 1 - math.exp(-40 * (0.5 - 0.01 * 8)), rtol=1e-4)


@pytest.mark.parametrize("quadrature", RULES.names())
def test08_quadrature_rules_converge_to_the_same_image(rgb, quadrature):
    data = np.random.default_rng(0).exponential(2, (4, 5, 6)).astype(np.float32)
    place = rgb.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    density = plugin("gridvolume", grid=rgb.VolumeGrid(data), to_world=place)
    make = lambda **more: channels(rgb, plugin("nerg", density=density, stop=1e-9, **more), still(camera(rgb, size=6)))
    fine, got = make(step=1e-3), make(step=2e-3 if quadrature == "constant" else 0.02, quadrature=quadrature)
    for c in fine:
        assert np.allclose(got[c], fine[c], rtol=1e-3, atol=1e-4), c


# ---- A ceiling that cameras above it look through ----

SIGMA, HEIGHT = 3.0, 0.6


def above(mi):
    """A camera over the unit cube, y up."""
    to_world = look_at(mi, (0.4, 3.0, 0.5), (0.5, 0.0, 0.5), (0, 0, 1))
    return still(camera(mi, fov=12) | {"to_world": to_world})


def cut(**overrides):
    return constant(SIGMA, ceiling=HEIGHT, up=[0.0, 2.0, 0.0], aovs="depth,opacity,position", **overrides)


def test01_ceiling_clips_and_depths_start_at_the_camera(rgb):
    out = channels(rgb, cut(depth="median", step=1e-3), above(rgb))
    ray = center_rays(rgb, above(rgb))
    o, d = np.array(ray.o, float).T, np.array(ray.d, float).T
    t0, t1 = ((o[:, 1] - y) / -d[:, 1] for y in (HEIGHT, 0.0))
    opacity = (1 - np.exp(-SIGMA * (t1 - t0))).reshape(12, 12)
    # Where half of the absorption below the plane is reached.
    depth = t0.reshape(12, 12) - np.log1p(-opacity / 2) / SIGMA
    assert np.allclose(out["opacity.Y"], opacity, atol=1e-4) and np.allclose(out["depth.T"], depth, atol=1e-4)
    assert np.allclose(points(out).reshape(-1, 3), o + d * depth.reshape(-1, 1), atol=2e-4)


def test02_camera_below_the_ceiling_is_unaffected(rgb):
    sensor = camera(rgb, origin=(0.5, 0.3, -3), target=(0.5, 0.8, 0.5))
    full = channels(rgb, constant(SIGMA, aovs="depth,opacity"), sensor)
    same = channels(rgb, constant(SIGMA, aovs="depth,opacity", ceiling=HEIGHT, up=[0.0, 1.0, 0.0]), sensor)
    assert all(np.array_equal(full[k], same[k]) for k in full) and full["opacity.Y"].max() > 0.5


def test03_ceiling_clips_camera_rays_only(rgb):
    sensor = camera(rgb, origin=(0.1, 0, -3), target=(0, 0, 0))
    lid, floor = sphere(rgb, 0, 0, -1, radius=0.4), square(rgb, 1.0, size=5.0)
    arguments = {
        "type": "nerg",
        "aovs": "depth,visibility",
        "observer": make_observer(rgb, 0, 0, -3),
        "up": [0.0, 0.0, -1.0],
    }
    middle = lambda out, name: out[name][6, 6]
    full = channels(rgb, arguments, sensor, lid=lid, floor=floor)
    out = channels(rgb, {**arguments, "ceiling": 0.5}, sensor, lid=lid, floor=floor)
    assert middle(full, "depth.T") < 2 and middle(full, "visibility.Y") == 1
    assert middle(out, "depth.T") == pytest.approx(4, abs=0.02) and middle(out, "visibility.Y") == 0


def test04_ceiling_depth_derivatives(rgb):
    sensor = above(rgb)
    scene = scene_with(rgb, cut(step=1e-3), sensor)
    params = rgb.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("sensor.to_world"))
    # Upwards by h: all depths grow like that of a fixed plane.
    h = rgb.Float(0)
    dr.enable_grad(h)
    put(params, key, rgb.Transform4f().translate(rgb.Vector3f(0, h, 0)) @ rgb.Transform4f(sensor["to_world"]))
    depth = rgb.render(scene, params, spp=1)[:, :, 3]
    dr.forward(h)
    # Matter begins at the plane, so its expected depth moves by the ray's length per unit of height.
    assert np.allclose(np.ravel(dr.grad(depth)), 1 / -np.array(center_rays(rgb, sensor).d)[1], rtol=1e-3)


@pytest.mark.parametrize(
    "parameters, why",
    [({"ceiling": "high"}, "ceiling"), ({"up": [0.0] * 3, "ceiling": 1.0}, "up"), ({"up": 1.0}, "three")],
)
def test05_invalid_ceiling_is_refused(rgb, parameters, why):
    with pytest.raises(RuntimeError, match=why):
        rgb.load_dict({"type": "nerg", **parameters})
