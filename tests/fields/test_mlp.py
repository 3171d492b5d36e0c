"""Tests of `nerg_mi.fields.mlp`."""

import drjit as dr
import drjit.cuda.ad
import drjit.llvm.ad
import drjit.llvm.ad as ns
import drjit.scalar
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import MLP, aligned, evaluate, is_cuda, namespace
from tests.reference import fields_numpy as reference

# ---- The array types of a backend, and arrays at addresses that Dr.Jit reads fast ----


def test_types_of_a_variant_or_an_array(rgb):
    for source in ("llvm_ad_rgb", "llvm", drjit.llvm.ad.Float, drjit.llvm.ad.Float(1), rgb.Point3f, rgb.TensorXf):
        assert namespace(source) is drjit.llvm.ad
    for source in ("cuda_ad_spectral", "cuda", drjit.cuda.ad.Float):
        assert namespace(source) is drjit.cuda.ad
    assert is_cuda(drjit.cuda.ad) and not is_cuda(drjit.llvm.ad)


@pytest.mark.parametrize("source", ["scalar_rgb", drjit.scalar.Array3f])
def test_scalar_variants_have_none(source):
    with pytest.raises(NergError, match='"llvm_ad_rgb"'):
        namespace(source)


@pytest.mark.parametrize("dtype", [np.float32, np.uint32])
def test_arrays_are_aligned_copies(dtype):
    source = np.arange(24).reshape(2, 3, 4)[:, ::2]
    for _ in range(8):
        copy = aligned(source, dtype)
        assert copy.ctypes.data % 64 == 0 and copy.dtype == dtype and np.array_equal(copy, source)
        assert not np.shares_memory(copy, source)
    assert aligned(np.zeros((0, 3))).shape == (0, 3)


# ---- Networks: cooperative vectors, tensor products and NumPy agree, with their gradients ----


SIZES = [[3, 1], [8, 16, 5], [6, 16, 16, 3]]


def evaluated_backwards(net, x, mix, mode):
    """Outputs (N, outputs) at ``x`` (N, inputs), as cooperative vectors ("coop") or tensor products; the weights get
    the derivatives of their sum weighted by ``mix`` (N, outputs)."""
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
def test01_three_ways_agree(sizes):
    net, weights, x = make(sizes)
    expected = reference.mlp(x, weights)
    coop = np.stack([o.numpy() for o in net([ns.Float(c) for c in x.T])], -1)
    tensor = net.tensor(ns.TensorXf(x)).numpy()
    assert coop.shape == expected.shape == tensor.shape
    assert np.allclose(coop, expected, atol=1e-6) and np.allclose(tensor, expected, atol=1e-6)
    assert (net.inputs, net.outputs) == (sizes[0], sizes[-1])


@pytest.mark.parametrize("mode", ["coop", "tensor"])
def test02_gradients_equal_central_differences(mode):
    net, weights, x = make([4, 16, 16, 2], n=20)
    mix = np.random.default_rng(1).normal(size=(20, 2))
    for w in net.weights:
        dr.enable_grad(w)
    net.pack()
    if mode == "coop":
        out = net([ns.Float(c) for c in x.T])
        loss = dr.sum(sum(o * ns.Float(m) for o, m in zip(out, mix.T)))
    else:
        out = net.tensor(ns.TensorXf(x))
        loss = dr.sum(out * ns.TensorXf(mix.astype(np.float32)), axis=None)
    dr.backward(loss)
    for layer, w in enumerate(weights):
        gradient = dr.grad(net.weights[layer]).numpy()
        for i, j in [(0, 0), (w.shape[0] - 1, w.shape[1] // 2)]:
            values = []
            for h in (1e-5, -1e-5):
                moved = [v.astype(np.float64) for v in weights]
                moved[layer][i, j] += h
                values.append((reference.mlp(x, moved) * mix).sum())
            assert np.isclose(gradient[i, j], (values[0] - values[1]) / 2e-5, rtol=1e-3, atol=1e-4)


def test03_pack_takes_up_changed_weights():
    net, weights, x = make([8, 16, 5])
    inputs = [ns.Float(c) for c in x.T]
    before = net(inputs)[0].numpy()
    net.weights[1] = net.weights[1] * 2
    net.pack()
    assert np.allclose(net(inputs)[0].numpy(), 2 * before, rtol=1e-6)


def test04_random_weights_are_bounded_and_seeded():
    a, b = (MLP.random([9, 4, 2], ns, np.random.default_rng(3)) for _ in range(2))
    assert all(np.array_equal(u.numpy(), v.numpy()) for u, v in zip(a.weights, b.weights))
    assert np.abs(a.weights[0].numpy()).max() <= 1 / 3 and a.weights[0].shape == (4, 9)


def test05_layers_that_do_not_fit():
    with pytest.raises(ValueError, match="do not fit together"):
        MLP([dr.zeros(ns.TensorXf, (4, 3)), dr.zeros(ns.TensorXf, (2, 5))])


def test06_inputs_of_one_and_of_many_lanes():
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
    # Values and the gradients of every array against a restatement and its central differences.
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


# ---- A network whose weights are constants gives what its cooperative vectors give, to the bit ----


@pytest.mark.parametrize("sizes", [[1, 1], [3, 1], [8, 16, 5], [6, 16, 16, 3], [24, 64, 64, 2]])
def test01_to_the_bit_small_and_large(sizes):
    rng = np.random.default_rng(3)
    net = MLP.random(sizes, ns, rng)
    x = rng.normal(size=(50, sizes[0])).astype(np.float32)
    columns = [ns.Float(c) for c in x.T]
    weights = [w.numpy() for w in net.weights]
    found = np.array(evaluate([w.tolist() for w in weights], columns)).T
    assert np.array_equal(found, np.array(net(columns)).T)
    assert np.allclose(found, reference.mlp(x, weights), atol=1e-5)


@pytest.mark.parametrize("sizes", [[3, 4, 1], [24, 64, 64, 1]])
def test02_in_loops_and_branches(sizes):
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

    found = summed(lambda x: evaluate(layers, x))
    assert np.ptp(found) > 0 and np.array_equal(found, summed(net))
