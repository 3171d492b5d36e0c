"""How a deferred field makes colours of features, against NumPy, and where rays meet next to nothing."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.radiance import mean_features, network_color, network_inputs, point_features

RNG = np.random.default_rng(0)


def floats(rows):
    return [ns.Float(np.ascontiguousarray(r, np.float32)) for r in rows]


def values(rows):
    return np.stack([r.numpy() for r in rows])


def logistic(x):
    return 0.5 + 0.5 * np.tanh(0.5 * x)


def test_a_network_at_every_sample_is_asked_with_the_features_as_they_are():
    outputs = floats(RNG.normal(size=(5, 8)))
    assert point_features(outputs, False) is outputs and network_inputs(outputs, False) is outputs
    assert np.allclose(values(network_color(outputs[:3], outputs, False)), logistic(values(outputs[:3])), atol=1e-6)


def test_what_the_network_leaves_alone_is_the_diffuse_colour():
    outputs = 2 * RNG.normal(size=(5, 40))
    features = point_features(floats(outputs), True)
    assert np.allclose(values(features), [*logistic(outputs[:3]), *outputs[3:]], atol=1e-6)
    inputs = network_inputs(features, True)
    assert np.allclose(values(inputs[3:]), outputs[3:], atol=1e-6)
    nothing, more = (network_color(floats(np.full((3, 40), v)), inputs, True) for v in (0, 0.7))
    # Its logit is taken a thousandth inside of 0..1.
    assert np.abs(values(nothing) - values(features[:3])).max() < 1.1e-3
    inside = 1e-3 + (1 - 2e-3) * logistic(outputs[:3])
    assert np.allclose(values(more), logistic(np.log(inside / (1 - inside)) + 0.7), atol=1e-5)


def test_diffuse_colours_composite_as_colours_do():
    """A ray over two surfaces has the mean of their colours, which the mean of their logits is not."""
    g = np.array([[0.1, 0.9], [0.3, 0.3], [0.8, 0.2], [-1, 1]])
    w = np.array([0.5, 0.25])
    means = mean_features(floats((g @ w)[:, None]), ns.Float(w.sum()))
    color = network_color(floats(np.zeros((3, 1))), network_inputs(means, True), True)
    assert np.allclose(values(color)[:, 0], g[:3] @ w / w.sum(), atol=1.1e-3)


@pytest.mark.parametrize("opacity", [0.0, 1e-42, 1e-38, 1e-13, 1e-12, 1e-6, 1.0])
def test_nothing_is_infinite_however_little_a_ray_meets(opacity):
    """Values and derivatives, of features up to 1 that this opacity composites."""
    for g in (0.0, 0.5, 1.0):
        a, s = ns.Float(opacity), ns.Float(np.float32(g * opacity))
        dr.enable_grad(a, s)
        means = mean_features([s] * 4, a)
        color = network_color(floats(np.full((3, 1), 0.3)), network_inputs(means, True), True)
        assert all(0 <= float(c[0]) <= 1 for c in color) and abs(float(means[0][0])) <= 1 + 1e-6
        dr.backward(a * (color[0] + color[1] * color[2]))
        assert np.isfinite(dr.grad(a)[0]) and np.isfinite(dr.grad(s)[0])
        if opacity >= 1e-12:
            assert abs(float(means[0][0]) - g) < 1e-5
