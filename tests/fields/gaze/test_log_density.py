"""The normalised gaze field: against NumPy, its table, its limits, its file."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_base import interpolate_table, make_prior_table, table_directions
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.fields.mlp import namespace
from nerg_mi.formats.fields import load_gaze, save_gaze
from nerg_mi.maths.geometry import Box
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.maths.vmf import log_normaliser

BOX = Box((-2, -2, 0), (2, 2, 3))
GRID = HashGridConfig(levels=2, log2_rows=10, base=2, finest=4)
SMALL = LogGazeConfig(grid=GRID, width=16, prior=8, heads=((-1, -1, 1.4), (1, 0.5, 1.8)), mix=0.2)


def made(config=SMALL, seed=1):
    ns, rng = namespace("llvm"), np.random.default_rng(seed)
    field = LogGazeField.random(config, BOX, ns, seed, rng.normal(size=(config.prior, 2 * config.prior)))
    field.set_parameters(
        {"grid.table": ns.Float(rng.normal(size=len(field.grid.table)).astype(np.float32)), "escaped": ns.Float(0.7)}
    )
    return field


def vectors(n=5, seed=2):
    rng = np.random.default_rng(seed)
    r = rng.normal(size=(n, 3))
    r /= np.linalg.norm(r, axis=1, keepdims=True)
    p_o = rng.uniform((-1, -1, 1.4), (1, 0.5, 1.8), (n, 3))
    return p_o, p_o + r * rng.uniform(0.1, 1.0, (n, 1)), r


def jit(v):
    return namespace("llvm").Array3f(np.ascontiguousarray(np.asarray(v).T, np.float32))


def test_density_matches_its_formula():
    """The product of the factors in NumPy, on the outputs of the encodings."""
    field = made()
    p_o, p_od, r = vectors()
    net = lambda weights, x: weights[-1] @ np.maximum(weights[1] @ np.maximum(weights[0] @ x, 0), 0)
    numpy = lambda rows: np.stack([np.broadcast_to(np.array(v, np.float64), len(r)) for v in rows])
    inputs = numpy(field.emit_inputs(jit(p_od), jit(p_o), jit(r)))
    np.testing.assert_allclose(inputs[0], 1)
    np.testing.assert_allclose(inputs[1], np.log(np.linalg.norm(p_od - p_o, axis=1)), atol=1e-5)
    u = (p_o - (-1, -1, 1.4)) / 2 * 2 - 1
    heads = numpy(field.capture_position(jit(p_o)))
    np.testing.assert_allclose(
        heads, np.concatenate([u, np.sin(u * np.pi / 2), np.cos(u * np.pi / 2)], axis=1).T, atol=1e-5
    )
    weights = lambda net: [np.array(w, np.float64) for w in net.weights]
    emit = net(weights(field.emit_net), inputs)[0]
    capture = 1 / (
        1
        + np.exp(
            -net(
                weights(field.capture_net),
                numpy(field.capture_inputs([namespace("llvm").Float(h.astype(np.float32)) for h in heads], jit(r))),
            )[0]
        )
    )
    prior = np.exp(np.array(field.log_prior(jit(r)), np.float64))
    gaze, e, c = (np.array(v) for v in field.evaluate(jit(p_od), jit(p_o), jit(r), integral=2.0))
    np.testing.assert_allclose(e, np.exp(emit) * prior / 2, rtol=1e-4)
    np.testing.assert_allclose(c, capture, rtol=1e-4)
    np.testing.assert_allclose(gaze, 0.8 * e * c + 0.2 * prior, rtol=1e-5)
    gone = field.unnormalized(jit(p_od), jit(p_o), jit(r), escaped=namespace("llvm").Bool(True))[0]
    np.testing.assert_allclose(np.array(gone), np.exp(0.7) * prior, rtol=1e-4)


def test_without_geometry_density_ignores_the_surface():
    field = made(replace(SMALL, geometry="none", reach=1.5))
    p_o, p_od, r = vectors()
    near, far = (
        np.array(field.evaluate(jit(p), jit(p_o), jit(r), integral=1.0)[0]) for p in (p_od, p_o + 3 * (p_od - p_o))
    )
    np.testing.assert_array_equal(near, far)
    assert np.ptp(near) > 0


def test_evaluation_needs_the_integral():
    p_o, p_od, r = (jit(v) for v in vectors())
    with pytest.raises(ValueError, match="integral"):
        made().evaluate(p_od, p_o, r)


def test_gradients_are_finite_at_zero_distance():
    field, p = made(), jit([[0.1, 0.2, 1.5]])
    dr.enable_grad(p)
    dr.backward(field.evaluate(p, jit([[0.1, 0.2, 1.5]]), jit([[0, 0, 1.0]]), integral=1.0)[0])
    assert np.isfinite(np.array(dr.grad(p))).all()


def test_prior_table_integrates_to_one():
    ns, kappa, mean = namespace("llvm"), 20.0, np.array([0.6, 0, 0.8])
    truth = lambda d: np.exp(log_normaliser(kappa) + kappa * (d @ mean - 1))
    fine = fibonacci_directions(20_000)
    table = make_prior_table(truth(table_directions(64)), 64, ns, fine)
    result = np.exp(np.array(interpolate_table(ns.Float(table.ravel()), 64, jit(fine)), np.float64))
    assert 4 * np.pi * result.mean() == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(result, truth(fine), atol=0.03 * truth(mean))


def test_table_is_interpolated_across_the_seam():
    """Against bilinear interpolation in NumPy with periodic columns; most azimuths near 0 and pi."""
    ns, rows, rng = namespace("llvm"), 6, np.random.default_rng(4)
    table, step = rng.normal(size=(rows, 2 * rows)), np.pi / rows
    seams = np.concatenate([c + step * np.linspace(-1.3, 1.3, 27) for c in (0, np.pi, -np.pi, 2 * np.pi)])
    phi = np.concatenate([seams, rng.uniform(-np.pi, np.pi, 300)])
    theta = np.concatenate(
        [rng.uniform(0.3, np.pi - 0.3, len(phi) - 6), [1e-3, 0.1, 0.3, np.pi - 0.3, np.pi - 0.1, np.pi - 1e-3]]
    )
    d = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    x, y = (phi / step - 0.5) % (2 * rows), np.clip(theta / step - 0.5, 0, rows - 1)
    i, j = np.floor(x).astype(int), np.minimum(np.floor(y).astype(int), rows - 2)
    at = lambda column, row: table[row, column % (2 * rows)]
    above, below = ((1 - (x - i)) * at(i, row) + (x - i) * at(i + 1, row) for row in (j, j + 1))
    result = np.array(interpolate_table(ns.Float(table.astype(np.float32).ravel()), rows, jit(d)))
    np.testing.assert_allclose(result, (1 - (y - j)) * above + (y - j) * below, atol=2e-4)


def test_table_lookups_stay_within_bounds():
    """At the poles only the outermost rows count; memory beyond them does not."""
    ns, rows = namespace("llvm"), 4
    table = np.concatenate(
        [np.full(2 * rows, 1.0), np.full(4 * rows, 7.0), np.full(2 * rows, 2.0), np.full(8 * rows, np.nan)]
    )
    result = np.array(
        interpolate_table(
            ns.Float(table.astype(np.float32)),
            rows,
            jit([[0, 0, 1.0], [0, 0, -1.0], [1e-4, 0, -1.0], [1e-4, -1e-5, 1.0]]),
        )
    )
    np.testing.assert_allclose(result, [1, 2, 2, 1])


def test_densities_are_finite_for_any_weights():
    """Weights of any size: the logit is clamped below the overflow of its exponential."""
    field = made(replace(SMALL, variant="emit"))
    p_o, p_od, r = (jit(v) for v in vectors())
    before = np.array(field.unnormalized(p_od, p_o, r)[0])
    field.set_parameters({"prior": field.prior * 0 + 1000})
    after = np.array(field.unnormalized(p_od, p_o, r)[0])
    assert np.isfinite(after).all() and (after > 1e12).all() and (before < 1e12).all()


@pytest.mark.parametrize("half", [False, True])
def test_file_round_trip(tmp_path, half):
    ns, field = namespace("llvm"), made()
    save_gaze(field, tmp_path / "gaze.safetensors", {"note": 1}, half)
    again, meta = load_gaze(tmp_path / "gaze.safetensors", ns)
    assert again.config == field.config and meta["output"] == {"activation": "log", "normalized": True}
    for name, value in field.parameters().items():
        np.testing.assert_allclose(
            again.parameters()[name].numpy(), value.numpy(), rtol=1e-3 if half else 0, atol=1e-6 if half else 0
        )


@pytest.mark.parametrize(
    "wrong",
    [
        {"mix": 1.01},
        {"variant": "both"},
        {"geometry": "flat"},
        {"escaped": "never"},
        {"prior": 1},
        {"heads": ((0, 0), (1, 1))},
    ],
)
def test_invalid_settings_are_refused(wrong):
    with pytest.raises(ValueError):
        replace(SMALL, **wrong)


def test_observers_outside_of_the_box_of_heads_are_as_at_its_nearest_point():
    """In each axis alone; the box is not a cube, whose longest edge is two units of the network's coordinates."""
    low, high = np.array([-1, -1, 1.4]), np.array([1, 0.5, 1.8])
    field = made(replace(SMALL, heads=(tuple(low), tuple(high))))
    points = np.array([[-3, 0, 1.5], [3, 0, 1.5], [0, -9, 1.5], [0, 2, 1.5], [0, 0, 0], [0, 0, 2.5], [99, 99, 99]])
    outside, inside = (
        np.array([np.array(v) for v in field.capture_position(jit(p))]) for p in (points, np.clip(points, low, high))
    )
    np.testing.assert_allclose(outside, inside, atol=1e-6)
    np.testing.assert_allclose(
        inside[:3, :4].T, [[-1, 0, -0.9], [1, 0, -0.9], [0, -1, -0.9], [0, 0.5, -0.9]], atol=1e-6
    )


def test_capture_coordinates_do_not_depend_on_the_box_size():
    result = []
    for size in (1.0, 1e-5):
        low, high = np.array([-1, -1, 1.4]) * size, np.array([1, 0.5, 1.8]) * size
        field = made(replace(SMALL, heads=(tuple(low), tuple(high))))
        result.append([np.array(v) for v in field.capture_position(jit(np.linspace(low, high, 5)))])
    assert np.ptp(result[0][0]) == pytest.approx(2, abs=1e-5)
    np.testing.assert_allclose(result[1], result[0], atol=1e-4)
