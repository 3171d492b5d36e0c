"""Pictures of the integrator against closed forms, and of grids that are skipped through."""

import math

import numpy as np
import pytest

from nerg_mi.transport.quadrature import RULES

from .scenes import camera, channels, constant, render, straight


@pytest.mark.parametrize("kind", ["orthographic", "perspective"])
@pytest.mark.parametrize("depth", ["expected", "median"])
def test01_unit_cube(rgb_and_mono, kind, depth):
    mi = rgb_and_mono
    out = channels(mi, constant(3.0, depth=depth), straight(mi, kind))
    assert np.isclose(out["opacity.Y"].item(), 1 - math.exp(-3), rtol=1e-5)
    inside = {"expected": 1 / 3 - 1 / math.expm1(3), "median": -math.log((1 + math.exp(-3)) / 2) / 3}[depth]
    # Distance from the ray's own origin, which lies on the near plane.
    assert abs(out["depth.T"].item() - (2 - 0.01 + inside)) < 1e-4


@pytest.mark.parametrize("sigma", [1e-6, 1e-3, 1, 1e3, 1e6, 1e9])
def test02_any_density(rgb, sigma):
    out = channels(rgb, constant(sigma), straight(rgb, "perspective"))
    assert np.isclose(out["opacity.Y"].item(), -math.expm1(-sigma), rtol=1e-5)
    inside = 0.5 if sigma < 1e-2 else 1 / sigma - (1 / math.expm1(sigma) if sigma < 700 else 0)
    assert np.isclose(out["depth.T"].item(), 1.99 + inside, rtol=1e-4)


@pytest.mark.parametrize("sigma", [0.05, 3.0])
def test03_colour_of_a_homogeneous_volume(rgb_and_mono, sigma):
    # α C + (1 - α) L_behind, also where every single step weighs less than color_cutoff.
    mi = rgb_and_mono
    color = {"type": "constvolume", "value": {"type": "rgb", "value": [0.9, 0.5, 0.2]}}
    background = {"type": "rgb", "value": [0.1, 0.2, 0.4]}
    image = render(
        mi, constant(sigma, color=color, background=background, aovs=""), straight(mi, "perspective")
    ).ravel()
    α = -math.expm1(-sigma)
    expected = α * np.array([0.9, 0.5, 0.2]) + (1 - α) * np.array([0.1, 0.2, 0.4])
    if "mono" in mi.variant():
        expected = expected @ [0.212671, 0.715160, 0.072169]
    assert np.allclose(image, expected, rtol=2e-3)


def test04_environment_takes_the_place_of_the_background(rgb):
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.4, 0.8]}}
    image = render(rgb, constant(3.0, background=9.0, aovs=""), straight(rgb, "perspective"), sky=sky).ravel()
    assert np.allclose(image, math.exp(-3) * np.array([0.2, 0.4, 0.8]), rtol=1e-4)
    hidden = render(rgb, constant(3.0, hide_emitters=True, aovs=""), straight(rgb, "perspective"), sky=sky).ravel()
    assert not hidden.any()


def test05_an_envmap_is_seen_where_it_belongs(rgb):
    data = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    sky = {"type": "envmap", "bitmap": rgb.Bitmap(data)}
    scene = {"type": "scene", "sensor": camera(rgb), "sky": sky}
    path = np.array(rgb.render(rgb.load_dict({**scene, "integrator": {"type": "path"}}), spp=1, seed=1))
    nerg = np.array(rgb.render(rgb.load_dict({**scene, "integrator": constant(0.0, aovs="")}), spp=1, seed=1))
    assert np.allclose(path, nerg, atol=1e-5) and path.std() > 0.01


@pytest.mark.parametrize("angle", [45, 90, 180])
def test06_a_turned_grid_is_not_skipped_by_its_own_voxels(rgb, angle):
    # A small dense block of a large empty grid, turned: its place is elsewhere than its indices say.
    data = np.zeros((32, 32, 32), np.float32)
    data[14:18, 2:6, 2:6] = 50
    turn = rgb.ScalarTransform4f().rotate([0, 0, 1], angle).translate([-0.5, -0.5, -0.5])
    density = {"type": "gridvolume", "grid": rgb.VolumeGrid(data), "to_world": turn}
    x, y = (np.array(turn.matrix) @ [4 / 32, 4 / 32, 0.5, 1])[:2].tolist()
    sensor = camera(rgb, (x, y, -2), (x, y, 0), fov=1e-3, size=1)
    out = channels(rgb, {"type": "nerg", "density": density, "aovs": "opacity"}, sensor)
    assert out["opacity.Y"].item() > 0.9


def test07_a_grid_that_repeats_is_bounded_as_it_repeats(rgb):
    # The last half voxel interpolates with the first voxel of the next repetition.
    data = np.zeros((8, 8, 8), np.float32)
    data[0] = 40
    opacity = {}
    for wrap in ("clamp", "repeat"):
        density = {"type": "gridvolume", "grid": rgb.VolumeGrid(data), "wrap_mode": wrap}
        sensor = camera(rgb, (-2, 0.5, 0.99), (0, 0.5, 0.99), fov=1e-3, size=1)
        opacity[wrap] = channels(rgb, {"type": "nerg", "density": density, "aovs": "opacity"}, sensor)[
            "opacity.Y"
        ].item()
    assert opacity["clamp"] == 0
    assert np.isclose(opacity["repeat"], 1 - math.exp(-40 * (0.5 - 0.01 * 8)), rtol=1e-4)


@pytest.mark.parametrize("quadrature", RULES.names())
def test08_quadratures_converge_to_one_picture(rgb, quadrature):
    data = np.random.default_rng(0).exponential(2, (4, 5, 6)).astype(np.float32)
    density = {
        "type": "gridvolume",
        "grid": rgb.VolumeGrid(data),
        "to_world": rgb.ScalarTransform4f().translate([-1, -1, -1]).scale(2),
    }
    still = {**camera(rgb, size=6), "sampler": {"type": "stratified", "jitter": False, "sample_count": 1}}
    base = {"type": "nerg", "density": density, "stop": 1e-9}
    fine = channels(rgb, {**base, "step": 1e-3}, still)
    got = channels(rgb, {**base, "step": 2e-3 if quadrature == "constant" else 0.02, "quadrature": quadrature}, still)
    for c in fine:
        assert np.allclose(got[c], fine[c], rtol=1e-3, atol=1e-4), c
