"""Tests of `nerg_mi.fields.radiance`."""

from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGrid, HashGridConfig, encode_direction
from nerg_mi.fields.mlp import MLP
from nerg_mi.fields.radiance import (
    Background,
    BackgroundConfig,
    RadianceConfig,
    RadianceNetwork,
    color_network_inputs,
    decode_color,
    density_from_log,
    mean_features,
)
from nerg_mi.maths.geometry import Box
from tests.reference import fields_numpy as reference

# ---- Background ----
#
# The background behind a field: intersections with its sphere, dependence on position and direction, and matching
# sizes.

GRID = HashGridConfig(levels=2, log2_rows=8, base=4, finest=8, dimensions=2)
CONFIG = BackgroundConfig(2.5, GRID, width=16)


def jit(v):
    return ns.Array3f(np.ascontiguousarray(np.asarray(v, np.float32).T))


def test_background_intersections():
    rng = np.random.default_rng(0)
    o, d = rng.uniform(-1.4, 1.4, (300, 3)), rng.normal(size=(300, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    b = (o * d).sum(1)
    t = -b + np.sqrt(b * b - (o * o).sum(1) + 2.5**2)
    p = o + d * t[:, None]
    assert np.allclose(np.linalg.norm(p, axis=1), 2.5)
    result = np.stack([c.numpy() for c in Background.random(CONFIG, ns).coordinates(jit(o), jit(d))], axis=1)
    assert np.allclose(result[:, 0], 2 / np.pi * np.arccos(p[:, 1] / 2.5) - 1, atol=1e-5)
    assert np.allclose(result[:, 1], np.arctan2(p[:, 2], p[:, 0]) / np.pi, atol=1e-5)


def test_missing_ray_takes_the_nearest_point():
    # Past the sphere along +z, 4 to the right: nearest at (4, 0, 0), which is seen along +x.
    theta, phi = Background.random(CONFIG, ns).coordinates(jit([[4, 0, -9]]), jit([[0, 0, 1]]))
    assert abs(theta[0]) < 1e-6 and abs(phi[0]) < 1e-6


def test_background_depends_on_position_and_direction():
    back = Background.random(CONFIG, ns, 3)
    table = np.random.default_rng(1).normal(size=len(back.grid.table)).astype(np.float32)
    back.grid.table = ns.Float(table)
    o, d = np.zeros((2, 3)), np.array([[0.6, 0, 0.8], [0, 0.6, 0.8]])
    c = np.array(back(jit(o), jit(d)))
    assert c.shape == (3, 2) and (c > 0).all() and (c < 1).all() and np.abs(c[:, 0] - c[:, 1]).max() > 1e-3
    # From elsewhere towards the same point, the direction still matters.
    place = 2.5 * d[0]
    other = np.array([1.0, 0.5, 0])
    towards = (place - other) / np.linalg.norm(place - other)
    same = back.coordinates(jit([other]), jit([towards]))
    assert np.allclose([s[0] for s in same], [s.numpy()[0] for s in back.coordinates(jit(o), jit(d))], atol=1e-5)
    assert np.abs(np.array(back(jit([other]), jit([towards])))[:, 0] - c[:, 0]).max() > 1e-4


def test_background_needs_a_2d_grid():
    assert BackgroundConfig(1.0).grid.dimensions == 2
    for wrong in ({"grid": HashGridConfig(levels=2)}, {"width": 0}, {"hidden": 0}):
        with pytest.raises(ValueError, match="2 dimensions and sizes of at least 1"):
            BackgroundConfig(1.0, **wrong)
    for radius in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ValueError, match="radius"):
            BackgroundConfig(radius)
    assert BackgroundConfig.from_dict(CONFIG.to_dict()) == CONFIG


def test_inconsistent_parts_are_refused():
    rng = np.random.default_rng(0)
    grid, net = HashGrid.random(GRID, ns, rng), MLP.random(CONFIG.sizes, ns, rng)
    Background(CONFIG, grid, net)
    with pytest.raises(ValueError, match="grid"):
        Background(
            CONFIG, HashGrid.random(HashGridConfig(levels=2, log2_rows=9, base=4, finest=8, dimensions=2), ns, rng), net
        )
    with pytest.raises(ValueError, match="background_net"):
        Background(CONFIG, grid, MLP.random([CONFIG.sizes[0], 32, 3], ns, rng))


# ---- Deferred colours from features, against NumPy, and for tiny opacities ----

RNG = np.random.default_rng(0)


def floats(rows):
    return [ns.Float(np.ascontiguousarray(r, np.float32)) for r in rows]


def values(rows):
    return np.stack([r.numpy() for r in rows])


def logistic(x):
    return 0.5 + 0.5 * np.tanh(0.5 * x)


def test_diffuse_colors_composite_linearly():
    """A ray over two surfaces has the mean of their colours, which is not that of their logits."""
    g = np.array([[0.1, 0.9], [0.3, 0.3], [0.8, 0.2], [-1, 1]])
    w = np.array([0.5, 0.25])
    means = mean_features(floats((g @ w)[:, None]), ns.Float(w.sum()))
    color = decode_color(floats(np.zeros((3, 1))), color_network_inputs(means, True), True)
    assert np.allclose(values(color)[:, 0], g[:3] @ w / w.sum(), atol=1.1e-3)


@pytest.mark.parametrize("opacity", [0.0, 1e-42, 1e-38, 1e-13, 1e-12, 1e-6, 1.0])
def test_results_are_finite_for_tiny_opacity(opacity):
    """Values and derivatives, for features up to 1 composited with this opacity."""
    for g in (0.0, 0.5, 1.0):
        a, s = ns.Float(opacity), ns.Float(np.float32(g * opacity))
        dr.enable_grad(a, s)
        means = mean_features([s] * 4, a)
        color = decode_color(floats(np.full((3, 1), 0.3)), color_network_inputs(means, True), True)
        assert all(0 <= float(c[0]) <= 1 for c in color) and abs(float(means[0][0])) <= 1 + 1e-6
        dr.backward(a * (color[0] + color[1] * color[2]))
        assert np.isfinite(dr.grad(a)[0]) and np.isfinite(dr.grad(s)[0])
        if opacity >= 1e-12:
            assert abs(float(means[0][0]) - g) < 1e-5


# ---- The radiance field against its NumPy version, and its parameters ----

RADIANCE_GRID = dict(levels=4, features=2, log2_rows=12, base=4, finest=32)
RADIANCE_CONFIG = RadianceConfig(grid=HashGridConfig(**RADIANCE_GRID), width=16, geometry=7, density_scale=2.5)
BOX = Box((-1, 0, 2), (3, 2, 4))


def make(seed=0, config=RADIANCE_CONFIG, **kwargs):
    field = RadianceNetwork.random(config, BOX, ns, seed, **kwargs)
    # Features of order one; otherwise every output would be that of zero input.
    rng = np.random.default_rng(seed)
    field.set_parameters({"grid.table": ns.Float(rng.normal(size=len(field.grid.table)).astype(np.float32))})
    return field


def arrays(field):
    return {k: v.numpy() for k, v in field.parameters().items()}


def points(n=60):
    rng = np.random.default_rng(5)
    p = rng.uniform(np.array(BOX.lower) - 0.3, np.array(BOX.upper) + 0.3, (n, 3)).astype(np.float32)
    d = rng.normal(size=(n, 3))
    return p, d / np.linalg.norm(d, axis=-1, keepdims=True)


def test01_equals_numpy():
    field, (p, d) = make(), points()
    sigma, features = field.density_features(ns.Array3f(p.T))
    rgb = np.array(field.color(features, ns.Array3f(d.T))).T
    s, c = reference.radiance(p, d, arrays(field), RADIANCE_GRID, BOX.lower, BOX.upper, scale=2.5)
    outside = s == 0
    assert 5 < outside.sum() < 55
    assert np.allclose(sigma.numpy(), s, rtol=2e-5) and np.all(sigma.numpy()[outside] == 0)
    assert np.allclose(rgb[~outside], c[~outside], atol=2e-6)


def test03_mask_is_respected():
    field = make()
    p = ns.Array3f(ns.Float([1, 1]), 1, 3)
    active = ns.Bool([True, False])
    for sigma in (field.density(p, active), field.density_features(p, active)[0]):
        assert sigma.numpy()[0] > 0 and sigma.numpy()[1] == 0


def test04_density_is_clamped():
    h = np.array([0, -100, 29, 31, 1e30])
    x = ns.Float(h)
    dr.enable_grad(x)
    sigma = density_from_log(x, 2.5)
    expected = 2.5 * np.exp(np.minimum(h, 30))
    assert np.allclose(sigma.numpy(), expected, rtol=1e-5, atol=1e-30)
    dr.backward(dr.sum(sigma))
    assert np.allclose(dr.grad(x).numpy(), np.where(h < 30, expected, 0), rtol=1e-5)


def test06_set_parameters_changes_every_output():
    field, (p, d) = make(), points(20)
    x = ns.Array3f(p.T)

    def outputs():
        sigma, features = field.density_features(x)
        return field.density(x).numpy(), sigma.numpy(), np.array(field.color(features, ns.Array3f(d.T)))

    before = outputs()
    values = {k: type(v)(v) * 1.5 for k, v in field.parameters().items() if k.startswith("density_net")}
    field.set_parameters(values)
    after = outputs()
    assert all(not np.allclose(a, b) for a, b in zip(before, after))
    s, c = reference.radiance(p, d, arrays(field), RADIANCE_GRID, BOX.lower, BOX.upper, scale=2.5)
    assert np.allclose(after[0], s, rtol=2e-5) and np.allclose(after[1], s, rtol=2e-5)


@pytest.mark.parametrize(
    "name", ["grid", "density_net.2", "density_net", "density_net.x", "emit_head.0", "density_net.-1"]
)
def test07_unknown_parameters_are_named(name):
    field = make()
    with pytest.raises(ValueError, match=f'no parameter "{name}"; it has grid.table, density_net.0'):
        field.set_parameters({name: field.density_net.weights[0]})


@pytest.mark.parametrize("name", ["grid.table", "density_net.0", "density_net.1", "color_net.0", "color_net.2"])
def test08_gradients_reach_every_parameter(name):
    # Central differences in float64 NumPy
    field, (p, d) = make(), points(12)
    p = np.clip(p, np.array(BOX.lower) + 0.1, np.array(BOX.upper) - 0.1)
    w = type(field.parameters()[name])(field.parameters()[name])
    dr.enable_grad(w)
    field.set_parameters({name: w})
    sigma, features = field.density_features(ns.Array3f(p.T))
    rgb = field.color(features, ns.Array3f(d.T))
    dr.backward(dr.sum(sigma + field.density(ns.Array3f(p.T)) + rgb.x + 2 * rgb.y + 3 * rgb.z))
    gradient = dr.grad(w).numpy().ravel()
    values = {k: v.astype(np.float64) for k, v in arrays(field).items()}

    def loss(i, h):
        moved = dict(values)
        moved[name] = values[name].copy()
        moved[name].flat[i] += h
        s, c = reference.radiance(p, d, moved, RADIANCE_GRID, BOX.lower, BOX.upper, scale=2.5)
        return (2 * s + c @ [1, 2, 3]).sum()

    for i in np.argsort(-np.abs(gradient))[[0, 3, 20]]:
        difference = (loss(i, 1e-5) - loss(i, -1e-5)) / 2e-5
        assert np.isclose(gradient[i], difference, rtol=2e-3, atol=1e-4)


def test10_defaults_match_the_paper():
    config = RadianceConfig()
    assert config.density_sizes == [32, 64, 16] and config.color_sizes == [31, 64, 64, 3]
    assert sum(a * b for s in (config.density_sizes, config.color_sizes) for a, b in zip(s, s[1:])) == 3072 + 6272
    assert RadianceConfig.from_dict(RADIANCE_CONFIG.to_dict()) == RADIANCE_CONFIG


@pytest.mark.parametrize(
    "wrong, words",
    [
        (dict(width=0), "at least 1"),
        (dict(density_hidden=0), "at least 1"),
        (dict(density_scale=0), "density_scale"),
        (dict(density_scale=float("nan")), "density_scale"),
        (dict(density_scale=float("inf")), "density_scale"),
    ],
)
def test11_wrong_sizes(wrong, words):
    with pytest.raises(ValueError, match=words):
        RadianceConfig(**wrong)


def test12_wrong_color_space():
    with pytest.raises(ValueError, match='"srgb".*"linear".*"aces"'):
        make(color_space="aces")


def test14_matrix_of_other_shape_is_refused():
    field = make()
    with pytest.raises(ValueError, match="density_net.0"):
        field.set_parameters({"density_net.0": dr.zeros(ns.TensorXf, (3, 3))})


def test17_deferred_field():
    """Its features and colours are those of the module's functions; files of other fields do not mention it."""
    config = replace(RADIANCE_CONFIG, deferred=True)
    field, plain, (p, d) = make(config=config), make(), points()
    sigma, features = field.density_features(ns.Array3f(p.T))
    same, raw = plain.density_features(ns.Array3f(p.T))
    assert np.array_equal(sigma.numpy(), same.numpy())
    g = np.stack([f.numpy() for f in raw])
    expected = np.concatenate([reference.sigmoid(g[:3]), g[3:]])
    assert np.allclose(np.stack([f.numpy() for f in features]), expected, atol=1e-6)
    inside = 1e-3 + (1 - 2e-3) * expected[:3]
    arguments = np.concatenate([np.log(inside / (1 - inside)), expected[3:]])
    outputs = np.array(
        plain.color_net([*encode_direction(ns.Array3f(d.T), config.sh_degree), *map(ns.Float, arguments)])
    )
    result = np.array(field.color(features, ns.Array3f(d.T)))
    assert np.allclose(result, reference.sigmoid(outputs + arguments[:3]), atol=1e-5)
    assert RadianceConfig.from_dict(config.to_dict()) == config and "deferred" not in RADIANCE_CONFIG.to_dict()


@pytest.mark.parametrize("change, words", [({"deferred": 1}, "true or false"), ({"geometry": 2}, "at least 3")])
def test18_invalid_deferred_fields_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        RadianceConfig(**{"deferred": True, **change})
