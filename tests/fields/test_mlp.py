"""Tests of `nerg_mi.fields.mlp`."""

import drjit as dr
import drjit.cuda.ad
import drjit.llvm.ad
import drjit.llvm.ad as ns
import drjit.scalar
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields import mlp
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_base import GazeEnsemble
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.fields.gaze_product import GazeConfig, ProductHead
from nerg_mi.fields.mlp import MLP, evaluate_with_constants, is_cuda, namespace, set_constant_weights
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.maths.geometry import Box
from nerg_mi.transport.jit import gc_paused
from tests.reference import fields_numpy as reference

# ---- The array types of a backend, and aligned arrays ----


def test_namespace_of_a_variant_or_an_array(rgb):
    for source in ("llvm_ad_rgb", "llvm", drjit.llvm.ad.Float, drjit.llvm.ad.Float(1), rgb.Point3f, rgb.TensorXf):
        assert namespace(source) is drjit.llvm.ad
    for source in ("cuda_ad_spectral", "cuda", drjit.cuda.ad.Float):
        assert namespace(source) is drjit.cuda.ad
    assert is_cuda(drjit.cuda.ad) and not is_cuda(drjit.llvm.ad)


@pytest.mark.parametrize("source", ["scalar_rgb", drjit.scalar.Array3f])
def test_scalar_variants_are_refused(source):
    with pytest.raises(NergError, match='"llvm_ad_rgb"'):
        namespace(source)


# ---- Networks: cooperative vectors, matrix products and NumPy agree, with their gradients ----

SIZES = [[3, 1], [8, 16, 5], [6, 16, 16, 3]]


def evaluated_backwards(net, x, mix, mode):
    """Outputs (N, outputs) at ``x`` (N, inputs), as cooperative vectors ("coop") or matrix products; the weights get
    the gradients of their sum weighted by ``mix`` (N, outputs)."""
    dr.enable_grad(list(net.named().values()))
    net.pack()
    if mode == "coop":
        out = net([ns.Float(c) for c in x.T])
        value, loss = np.array([o.numpy() for o in out]).T, sum(o * ns.Float(m) for o, m in zip(out, mix.T))
    else:
        out = net.tensor(ns.TensorXf(x))
        value, loss = out.numpy(), out * ns.TensorXf(mix)
    dr.backward(dr.sum(loss, axis=None))
    return value


def make(sizes, n=50):
    rng = np.random.default_rng(0)
    net = MLP.random(sizes, ns, rng)
    x = rng.normal(size=(n, sizes[0])).astype(np.float32)
    return net, [w.numpy() for w in net.weights], x


@pytest.mark.parametrize("sizes", SIZES)
def test01_execution_modes_agree(sizes):
    net, weights, x = make(sizes)
    expected = reference.mlp(x, weights)
    coop = np.stack([o.numpy() for o in net([ns.Float(c) for c in x.T])], -1)
    tensor = net.tensor(ns.TensorXf(x)).numpy()
    assert coop.shape == expected.shape == tensor.shape
    assert np.allclose(coop, expected, atol=1e-6) and np.allclose(tensor, expected, atol=1e-6)
    assert (net.inputs, net.outputs) == (sizes[0], sizes[-1])


def test03_pack_applies_changed_weights():
    net, weights, x = make([8, 16, 5])
    inputs = [ns.Float(c) for c in x.T]
    before = net(inputs)[0].numpy()
    net.weights[1] = net.weights[1] * 2
    net.pack()
    assert np.allclose(net(inputs)[0].numpy(), 2 * before, rtol=1e-6)


def test05_inconsistent_layers_are_refused():
    with pytest.raises(ValueError, match="inconsistent shapes"):
        MLP([dr.zeros(ns.TensorXf, (4, 3)), dr.zeros(ns.TensorXf, (2, 5))])


def test06_broadcast_inputs():
    net, weights, x = make([3, 8, 2], n=5)
    one = ns.Float(0.25)
    dr.enable_grad(one)
    out = net([one, ns.Float(x[:, 1]), ns.Float(x[:, 2])])
    x[:, 0] = 0.25
    assert np.allclose(np.stack([o.numpy() for o in out], -1), reference.mlp(x, weights), atol=1e-6)
    dr.backward(dr.sum(out[0]))
    h = np.array([1e-4, 0, 0])
    difference = (reference.mlp(x + h, weights)[:, 0] - reference.mlp(x - h, weights)[:, 0]).sum() / 2e-4
    assert np.isclose(dr.grad(one).numpy()[0], difference, rtol=1e-3)


@pytest.mark.parametrize("mode", ["coop", "tensor"])
def test07_layer_normalisation(mode):
    # Values and gradients of all arrays against a reference and its central differences.
    rng = np.random.default_rng(2)
    net = MLP.random([5, 16, 3], ns, rng, normalized=True)
    for name, value in net.named().items():
        net.replace(name, ns.TensorXf((value.numpy() + rng.normal(0, 0.3, value.shape)).astype(np.float32)))
    arrays = {k: v.numpy().astype(np.float64) for k, v in net.named().items()}
    x, mix = rng.normal(size=(30, 5)).astype(np.float32), rng.normal(size=(30, 3)).astype(np.float32)

    def restated(a):
        h = x.astype(np.float64)
        for i in ("0", "1"):
            h = (h - h.mean(1, keepdims=True)) / np.sqrt(h.var(1, keepdims=True) + 1e-5)
            h = (h * a[f"{i}.gain"] + a[f"{i}.shift"]) @ a[i].T + a[f"{i}.bias"]
            h = np.maximum(h, 0) if i == "0" else h
        return h

    assert np.allclose(evaluated_backwards(net, x, mix, mode), restated(arrays), atol=1e-5)
    for name, array in net.named().items():
        direction, ends = rng.normal(size=array.shape), []
        for h in (1e-6, -1e-6):
            ends.append((restated({**arrays, name: arrays[name] + h * direction}) * mix).sum())
        assert np.isclose(
            (dr.grad(array).numpy() * direction).sum(), (ends[0] - ends[1]) / 2e-6, rtol=1e-3, atol=1e-4
        ), name


# ---- A network with constant weights equals its cooperative vectors, bit by bit ----


@pytest.mark.parametrize("sizes", [[1, 1], [3, 1], [8, 16, 5], [6, 16, 16, 3], [24, 64, 64, 2]])
def test01_constant_weights_are_bit_identical(sizes):
    rng = np.random.default_rng(3)
    net = MLP.random(sizes, ns, rng)
    x = rng.normal(size=(50, sizes[0])).astype(np.float32)
    columns = [ns.Float(c) for c in x.T]
    weights = [w.numpy() for w in net.weights]
    result = np.array(evaluate_with_constants([w.tolist() for w in weights], columns)).T
    assert np.array_equal(result, np.array(net(columns)).T)
    assert np.allclose(result, reference.mlp(x, weights), atol=1e-5)


@pytest.mark.parametrize("sizes", [[3, 4, 1], [24, 64, 64, 1]])
def test02_constant_weights_in_loops_and_branches(sizes):
    net = MLP.random(sizes, ns, np.random.default_rng(4))
    layers = [w.numpy().tolist() for w in net.weights]

    def summed(network):
        def body(i, total):
            x = [ns.Float(i) * 0.1 + k for k in range(sizes[0])]
            some = (i & 1) == 0
            value = dr.if_stmt((some,), some, lambda some: network(x)[0], lambda some: ns.Float(0))
            return i + 1, total + value

        start = (dr.arange(ns.UInt32, 20), dr.zeros(ns.Float, 20))
        return dr.while_loop(start, lambda i, total: i < 25, body)[1].numpy()

    result = summed(lambda x: evaluate_with_constants(layers, x))
    assert np.ptp(result) > 0 and np.array_equal(result, summed(net))


# ---- Fields with constant weights, and when these do not apply ----

GRID = HashGridConfig(levels=2, log2_rows=8, base=2, finest=8)
BOX = Box((0, 0, 0), (1, 1, 1))


def points(n=64):
    return ns.Array3f(np.random.default_rng(1).uniform(0, 1, (3, n)).astype(np.float32))


def directions(n=64):
    return dr.normalize(ns.Array3f(np.random.default_rng(2).normal(size=(3, n)).astype(np.float32)))


def gaze_log(seed=0):
    return LogGazeField.random(LogGazeConfig(grid=GRID), BOX, ns, seed)


def radiance():
    return RadianceNetwork.random(RadianceConfig(grid=GRID, width=16), BOX, ns)


def said_by(field):
    """All results of evaluations (rows of numbers)."""
    p, d = points(), directions()
    if isinstance(field, RadianceNetwork):
        sigma, features = field.density_features(p)
        return np.array([sigma, field.density(p), *features, *field.color(features, d)])
    return np.array(field.unnormalized(p, p * 0.5, d) if field.config.normalized else field.evaluate(p, p * 0.5, d))


@pytest.fixture
def unrolled(monkeypatch):
    """Networks that were evaluated with constant weights, one entry each."""
    result = []
    monkeypatch.setattr(
        mlp,
        "evaluate_with_constants",
        lambda layers, x: result.append(len(layers)) or evaluate_with_constants(layers, x),
    )
    return result


@pytest.mark.parametrize("make", [radiance, gaze_log, lambda: ProductHead.random(GazeConfig(grid=GRID), BOX, ns)])
def test01_fields_are_bit_identical(make, unrolled):
    field = make()
    before = said_by(field)
    set_constant_weights(field)
    assert not unrolled
    assert np.ptp(before, axis=1).max() > 0 and np.array_equal(said_by(field), before)
    assert len(unrolled) >= len(field.mlps)


def test02_constant_weights_apply_to_all_members():
    ensemble = GazeEnsemble([gaze_log(0), gaze_log(1)])
    for constant in (True, False):
        set_constant_weights(ensemble, constant)
        assert [net.has_constant_weights for m in ensemble.members for net in (m.emit_net, m.capture_net)] == [
            constant
        ] * 4


def test03_replaced_weights_take_effect():
    field = radiance()
    set_constant_weights(field)
    before = said_by(field)
    field.set_parameters({k: v * 2 for k, v in field.parameters().items() if "net" in k})
    assert field.density_net.has_constant_weights and field.color_net.has_constant_weights
    other = radiance()
    other.set_parameters({k: v * 2 for k, v in other.parameters().items() if "net" in k})
    after = said_by(field)
    assert not np.array_equal(after, before) and np.array_equal(after, said_by(other))


def slope_of_weights(field):
    weights = field.parameters()["density_net.0"]
    dr.enable_grad(weights)
    field.set_parameters({"density_net.0": weights})
    dr.backward(dr.sum(field.density(points())))
    return weights.grad.numpy()


def slope_of_points(field):
    p = points()
    dr.enable_grad(p)
    dr.backward(dr.sum(field.density(p)))
    return np.array(p.grad)


@pytest.mark.parametrize("slope", [slope_of_weights, slope_of_points])
def test04_derivatives_are_unchanged(slope, unrolled):
    plain, field = radiance(), radiance()
    set_constant_weights(field)
    expected = slope(plain)
    assert np.abs(expected).max() > 0 and np.allclose(slope(field), expected, rtol=1e-5, atol=1e-9)
    assert not unrolled


def test05_frozen_function_uses_changed_weights(unrolled):
    field = radiance()
    set_constant_weights(field)

    @dr.freeze
    def recorded(field, p):
        with gc_paused():
            return field.density(p)

    p = points()
    first = recorded(field, p).numpy()
    field.set_parameters({"density_net.1": field.parameters()["density_net.1"] * 2})
    second = recorded(field, p).numpy()
    assert not unrolled
    assert np.allclose(first, radiance().density(p).numpy(), rtol=1e-6)
    assert np.allclose(second, field.density(p).numpy(), rtol=1e-6) and not np.allclose(first, second)


def test07_normalised_layers_are_unchanged():
    net = MLP.random([8, 16, 3], ns, np.random.default_rng(5), normalized=True)
    x = [ns.Float(c) for c in np.random.default_rng(6).normal(size=(8, 20)).astype(np.float32)]
    before = np.array(net(x))
    net.has_constant_weights = True
    assert np.ptp(before) > 0 and np.array_equal(np.array(net(x)), before)


# ---- Networks, their gradients and one gaze field against torch ----

RNG = np.random.default_rng(0)


def forward(torch, weights, x):
    for i, w in enumerate(weights):
        x = torch.nn.functional.linear(x, w)
        x = torch.relu(x) if i + 1 < len(weights) else x
    return x


def test01_values_and_weight_gradients_of_both_modes(torch):
    net = MLP.random([5, 16, 8, 3], ns, RNG)
    x = RNG.normal(size=(40, 5)).astype(np.float32)
    mix = RNG.normal(size=(40, 3)).astype(np.float32)
    theirs = [torch.tensor(w.numpy(), requires_grad=True) for w in net.weights]
    out = forward(torch, theirs, torch.tensor(x))
    (out * torch.tensor(mix)).sum().backward()

    for mode in ("coop", "tensor"):
        value = evaluated_backwards(net, x, mix, mode)
        assert np.allclose(value, out.detach().numpy(), rtol=1e-5, atol=1e-6), mode
        for a, b in zip(net.weights, theirs):
            assert np.allclose(dr.grad(a).numpy(), b.grad.numpy(), rtol=1e-4, atol=1e-5), mode
        dr.clear_grad(net.weights)
