"""A network whose weights are constants gives what its cooperative vectors give, to the bit."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.mlp import MLP, evaluate
from tests.reference import fields_numpy as reference


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
