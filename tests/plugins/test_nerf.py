"""The volume `nerf`: values, and images with a background, contracted space, and deferred shading."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.occupancy import OccupancyGrid
from nerg_mi.fields.radiance import Background, BackgroundConfig, RadianceConfig, RadianceNetwork
from nerg_mi.formats.fields import load_radiance, save_radiance
from nerg_mi.maths.color import decode_srgb, encode_srgb
from nerg_mi.maths.geometry import Box, ContractedBox

from . import fields
from .scenes import (
    camera,
    center_rays,
    channels,
    make_observer,
    named,
    picture,
    plugin,
    put,
    render,
    scene_with,
    still,
    stored,
)

# ---- The volume: values, placement, and invalid files ----


@pytest.fixture
def field(tmp_path):
    return fields.radiance(tmp_path / "f.safetensors")


def load(mi, path, **kwargs):
    return mi.load_dict(stored("nerf", path, **kwargs))


def evaluate(mi, volume, p):
    it = dr.zeros(mi.Interaction3f)
    it.p = mi.Point3f(np.asarray(p, np.float32).T)
    return volume.eval_1(it).numpy()


def test01_density_in_scene_units(rgb, tmp_path, field):
    p = np.random.default_rng(0).uniform(-1.2, 1.2, (50, 3)).astype(np.float32)
    expected = field.density(rgb.Point3f(p.T)).numpy()
    assert (expected == 0).any() and (expected > 0).any()
    assert np.allclose(evaluate(rgb, load(rgb, tmp_path / "f.safetensors"), p), expected, rtol=1e-6)
    to_world = rgb.ScalarTransform4f().translate([1, 2, 3]).rotate([0, 1, 0], 90).scale(4)
    volume = load(rgb, tmp_path / "f.safetensors", to_world=to_world)
    q = np.array(to_world.matrix)[:3] @ np.concatenate([p.T, np.ones((1, 50))])
    inside = np.abs(np.abs(p) - 1).min(-1) > 1e-4
    assert np.allclose(evaluate(rgb, volume, q.T)[inside], expected[inside] / 4, rtol=1e-3)
    box = np.array([volume.bbox().min, volume.bbox().max]).reshape(2, 3)
    assert np.allclose(box, [[-3, -2, -1], [5, 6, 7]], atol=1e-5)


def test03_parameters(rgb, tmp_path, field):
    volume = load(rgb, tmp_path / "f.safetensors")
    params = rgb.traverse(volume)
    assert set(field.parameters()) == set(params.keys())
    before = evaluate(rgb, volume, [[0.1, 0.2, 0.3]])
    put(params, "density_net.1", params["density_net.1"] * 2)
    assert not np.isclose(evaluate(rgb, volume, [[0.1, 0.2, 0.3]]), before, rtol=1e-3)


def test05_invalid_files_are_refused(rgb, tmp_path, files):
    (tmp_path / "x.safetensors").write_bytes(b"no")
    for path, overrides, said in (
        (files / "gaze.safetensors", {}, "contains a gaze field"),
        (tmp_path / "x.safetensors", {}, "x.safetensors.*not a readable safetensors file"),
        (files / "field.safetensors", {"bogus": 1.0}, "bogus"),
        (files / "field.safetensors", {"constant_weights": "yes"}, "constant_weights"),
    ):
        with pytest.raises(RuntimeError, match=said):
            load(rgb, path, **overrides)
    with pytest.raises(RuntimeError, match='"filename"'):
        rgb.load_dict({"type": "nerf", "filename": 3.0})


def test07_empty_cells_are_vacuum_for_eval_1(rgb, tmp_path):
    # Training does not sample these cells: the networks' density is arbitrary there, and marching skips them.
    bits = np.zeros((4, 4, 4), bool)
    bits[:, :, 2:] = True
    field = fields.radiance(tmp_path / "half.safetensors", occupancy=OccupancyGrid(bits, ns, 0.01))
    p = np.random.default_rng(1).uniform(-0.99, 0.99, (50, 3)).astype(np.float32)
    raw, got = field.density(rgb.Point3f(p.T)).numpy(), evaluate(rgb, load(rgb, tmp_path / "half.safetensors"), p)
    assert (raw > 0).all() and not got[p[:, 0] < 0].any()
    assert np.allclose(got[p[:, 0] > 0], raw[p[:, 0] > 0], rtol=1e-6) and (p[:, 0] > 0).any()


def medium_scene(mi, files, **kwargs):
    """The field as an absorbing medium, in a cube in front of white light."""
    volume = stored("nerf", files / "field.safetensors", **kwargs)
    interior = {"type": "heterogeneous", "sigma_t": volume, "albedo": {"type": "constvolume", "value": 0.0}}
    scale = kwargs.get("to_world", mi.ScalarTransform4f())
    cube = {"type": "cube", "to_world": scale, "bsdf": {"type": "null"}, "interior": interior}
    integrator, sky = plugin("volpath", max_depth=200, rr_depth=1000), plugin("constant", radiance=1.0)
    return scene_with(mi, integrator, camera(mi, size=8), cube=cube, sky=sky)


@pytest.mark.parametrize("placed", [False, True])
def test_mitsuba_medium_matches_the_march(rgb, files, placed):
    """Analog tracking transmits a path or not: counts of n paths around n T, by a z-test per pixel."""
    spp = 1024
    where = {"to_world": rgb.ScalarTransform4f().translate([0.1, 0, 0]).scale(0.6)} if placed else {}
    through = np.array(rgb.render(medium_scene(rgb, files, max_density=40.0, **where), spp=spp))[..., 0]
    field = stored("nerf", files / "field.safetensors", **where)
    integrator = plugin("nerg", field=field, aovs="opacity", step=0.01, radiance=False)
    T = 1 - channels(rgb, integrator, camera(rgb, size=8), spp=256)["opacity.Y"].astype(float)
    # T varies within a pixel, across silhouettes too much for a mean of 256.
    inside = binary_erosion(T < 0.6)
    z = (through - T)[inside] / np.sqrt((T * (1 - T))[inside] / spp)
    assert inside.sum() > 8 and np.abs(z).max() < 4.5 and np.mean(z**2) < 1.6


def test_medium_needs_max_density(rgb, files):
    with pytest.raises(RuntimeError, match='"max_density"'):
        medium_scene(rgb, files)
    p = np.random.default_rng(0).uniform(-0.9, 0.9, (100, 3))
    path = files / "field.safetensors"
    free, capped = (evaluate(rgb, load(rgb, path, **overrides), p) for overrides in ({}, {"max_density": 2.2}))
    assert free.max() > 2.2 and np.allclose(capped, np.minimum(free, 2.2))


def test_constant_weights_change_no_density(rgb, files):
    p = np.random.default_rng(0).uniform(-0.9, 0.9, (100, 3))
    plain, constant = (load(rgb, files / "field.safetensors", constant_weights=c) for c in (False, True))
    assert constant.field.color_net.has_constant_weights and not plain.field.color_net.has_constant_weights
    result = evaluate(rgb, plain, p)
    assert np.ptp(result) > 0 and np.array_equal(evaluate(rgb, constant, p), result)


# ---- A background network behind a field: composited in the field's colour space ----


@pytest.mark.parametrize("scale, density", [(1.0, 1e-9), (2.5, 1e-9), (1.0, 0.4)])
def test01_background_network_behind_the_field(rgb, tmp_path, scale, density):
    grid = HashGridConfig(levels=2, log2_rows=8, base=4, finest=16, dimensions=2)
    behind = Background.random(BackgroundConfig(3.0, grid, 16, sh_degree=2), ns)
    table = np.random.default_rng(0).normal(size=len(behind.grid.table)).astype(np.float32)
    behind.grid.table = ns.Float(table)
    fields.radiance(tmp_path / "field.safetensors", density_scale=density)
    field = fields.radiance(tmp_path / "behind.safetensors", density_scale=density, background=behind)
    again, _ = load_radiance(tmp_path / "behind.safetensors", ns)
    assert again.background.config == behind.config and np.array_equal(again.background.grid.table.numpy(), table)

    to_world = rgb.ScalarTransform4f().scale(scale)
    sensor = still(camera(rgb, (0.5 * scale, 0.4 * scale, -2.5 * scale), size=8))

    def shown(name, **overrides):
        field = stored("nerf", tmp_path / f"{name}.safetensors", to_world=to_world)
        return render(rgb, plugin("nerg", field=field, aovs="opacity", color_cutoff=0.0), sensor, **overrides)

    image, without = shown("behind"), shown("field")
    alpha = image[..., 3:4]
    assert np.allclose(alpha, without[..., 3:4])
    ray = center_rays(rgb, sensor)
    learnt = np.array(field.background(ns.Array3f(np.array(ray.o) / scale), ns.Array3f(np.array(ray.d))))
    learnt = learnt.T.reshape(8, 8, 3)
    # C from α lin(C / α)
    ratio = encode_srgb(without[..., :3] / np.where(alpha > 0, alpha, 1))
    expected = decode_srgb(alpha * ratio + (1 - alpha) * learnt)
    assert np.allclose(image[..., :3], expected, rtol=1e-3, atol=1e-5) and np.ptp(learnt) > 0.05
    # An environment emitter of the scene replaces it.
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.4, 0.8]}}
    assert np.allclose(shown("behind", sky=sky), shown("field", sky=sky))


# ---- Contracted space: depths in scene units beyond the box, for cameras and observers ----


@pytest.fixture
def endless(tmp_path):
    """σ = 0.25 / m², m the maximum norm in half edges (2 units), at least 1."""
    grid = HashGridConfig(levels=2, log2_rows=8, base=4, finest=16)
    config = RadianceConfig(grid, width=16, geometry=3, sh_degree=2, density_scale=0.25)
    box = ContractedBox(Box((-2, -2, -2), (2, 2, 2)), 16)
    made = RadianceNetwork.random(config, box, ns, march_step=0.02, march_growth=1 / 128)
    made.set_parameters({k: dr.zeros(type(v), v.shape) for k, v in made.parameters().items() if "density" in k})
    save_radiance(made, tmp_path / "f.safetensors", {})
    return stored("nerf", tmp_path / "f.safetensors")


def median(start: float) -> float:
    """Distance along z, from ``start`` on the axis, at which half of the total absorption is reached, by a float64
    sum."""
    t = np.arange(0, 32 - start, 1e-4)
    tau = np.cumsum(0.25 / np.maximum(np.abs(start + t) / 2, 1) ** 2 * 1e-4)
    return float(t[np.searchsorted(tau, -np.log1p(0.5 * np.expm1(-tau[-1])))])


# From inside the inner cube outwards, from outside through it, and in uniform steps.
@pytest.mark.parametrize("start, more", [(1, {}), (-5, {}), (1, {"dt_gamma": 0.0, "step": 0.01})])
def test_depth_beyond_the_box_is_in_scene_units(rgb, endless, start, more):
    eye = {} if more else {"observer": make_observer(rgb, 0, 0, -5)}
    integrator = plugin("nerg", field=endless, aovs="depth,position,observer_depth", jitter=False, **eye, **more)
    assert rgb.load_dict(integrator).settings.dt_gamma == more.get("dt_gamma", 1 / 128)
    out = channels(rgb, integrator, camera(rgb, (0, 0, start), (0, 0, 9), fov=0.5, size=4, near_clip=1e-4))
    np.testing.assert_allclose(out["depth.T"], median(start), rtol=5e-4)
    assert start + median(start) > 2 or start < 0
    # The observer looks towards the point that the camera sees, and meets a surface in front of or behind it.
    np.testing.assert_allclose(out["position.Z"], start + median(start), rtol=5e-4)
    np.testing.assert_allclose(out["observer_depth.T"], median(-5 if eye else start), rtol=5e-4)


# ---- Deferred shading ----


@pytest.fixture(scope="module")
def deferred(tmp_path_factory):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    path = tmp_path_factory.mktemp("deferred") / "field.safetensors"
    fields.radiance(path, density_scale=1.5, deferred=True, color_space="linear")
    return path


def nerg(path, aovs="opacity", **overrides):
    how = {"step": 0.05, "stop": 0.0, "color_cutoff": 0.0, "field": stored("nerf", path)} | overrides
    return plugin("nerg", aovs=aovs, **how)


def few(mi):
    return still(camera(mi, size=5))


def test01_color_is_evaluated_on_mean_features(rgb, deferred):
    """From the composited features, which ``test_nerg_aovs`` tests, with the network of the field."""
    image = render(rgb, nerg(deferred), few(rgb))
    with_features = nerg(deferred, "opacity,features")
    both = render(rgb, with_features, few(rgb))
    assert np.allclose(image, both[..., :4], atol=1e-6)
    seen, opacity = named(rgb, both, with_features), both[..., 3].ravel()
    some = opacity > 0
    assert opacity.max() > 0.5 and some.sum() > 10
    medium = rgb.load_dict(nerg(deferred)["field"]).medium()
    sums = np.stack([seen[f"features.{k}"].ravel() for k in range(medium.feature_count)])
    means = [rgb.Float(np.ascontiguousarray((s / np.where(some, opacity, 1)).astype(np.float32))) for s in sums]
    expected = opacity * np.array(medium.field.color(means, center_rays(rgb, few(rgb)).d))
    result = image[..., :3].reshape(-1, 3).T
    assert np.allclose(result[:, some], expected[:, some], atol=2e-6) and not result[:, ~some].any()


def test02_one_color_evaluation_per_ray(rgb, deferred):
    seen = channels(rgb, nerg(deferred, "opacity,color_evals,density_evals"), few(rgb))
    assert np.array_equal(seen["color_evals.Y"], seen["opacity.Y"] > 0) and seen["density_evals.Y"].max() > 3


@pytest.mark.parametrize("quadrature", ["constant", "linear"])
def test03_cutoff_changes_colors_little(rgb, deferred, quadrature):
    with_cutoff = lambda c: render(rgb, nerg(deferred, quadrature=quadrature, color_cutoff=c, step=0.02), few(rgb))
    assert 0 < np.abs(with_cutoff(0.0) - with_cutoff(1e-2))[..., :3].max() < 0.02


def test04_wall_is_visible_through_the_field(rgb, deferred):
    """The network does not affect the wall, and is evaluated only where the field is hit."""
    wide = {**few(rgb), "fov": 60}
    place = rgb.ScalarTransform4f().translate([0, 0, 1.5]).rotate([1, 0, 0], 180).scale(9)
    light = {"type": "area", "radiance": {"type": "rgb", "value": 0.7}}
    wall = {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse"}, "emitter": light}
    alone = render(rgb, nerg(deferred), wide)
    lit = nerg(deferred, "opacity,color_evals", shading={"type": "path", "max_depth": 1})
    image, opacity = render(rgb, lit, wide, wall=wall), alone[..., 3:4]
    # No colour is evaluated on rays that meet the wall alone.
    assert np.array_equal(image[..., 4:5], opacity > 0) and opacity.min() == 0 < opacity.max()
    assert image[..., 3].min() == 1 and np.allclose(image[..., :3], alone[..., :3] + 0.7 * (1 - opacity), atol=1e-4)


def test05_frozen_rendering_with_constant_weights(rgb, deferred):
    scene = scene_with(rgb, nerg(deferred), few(rgb))
    constant = render(rgb, nerg(deferred, field=stored("nerf", deferred, constant_weights=True)), few(rgb))
    frozen = dr.freeze(lambda scene: rgb.render(scene, spp=1))
    first = picture(rgb, scene)
    for other in (frozen(scene), frozen(scene), constant):
        assert np.allclose(np.array(other), first, atol=1e-6)
