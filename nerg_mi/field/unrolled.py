"""A network whose weights are constants of the kernel that evaluates it.

Dr.Jit's cooperative vectors keep a layer's sums in memory while they read its weights, which on processors takes two to
three times as long as the products themselves. With the weights written into the kernel the sums stay in registers. The
products and their order are the same, and so are the results, to the bit. The price is compilation: some seconds once
for each kernel and each set of weights.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr

_APART = 2048
"""Products from which on a network becomes a function of its own within a kernel: compilers take more than
proportionally long over long functions."""


def evaluate(layers: Sequence[Sequence[Sequence[float]]], x: list) -> list:
    """Outputs (list of Floats) at ``x`` (list of Floats) of a ReLU network of ``layers``: weights [output][input]."""
    if sum(len(layer) * len(layer[0]) for layer in layers) <= _APART:
        return _unrolled(layers, x)
    Float = type(x[0])
    UInt32 = dr.uint32_array_t(Float)
    which = UInt32(0)
    # A function that is known to be the only one is inlined.
    dr.make_opaque(which)
    nothing = lambda *x: (Float(0),) * len(layers[-1])
    return list(dr.switch(which, [lambda *x: tuple(_unrolled(layers, list(x))), nothing], *x))


def _unrolled(layers: Sequence[Sequence[Sequence[float]]], x: list) -> list:
    for i, layer in enumerate(layers):
        sums = []
        for row in layer:
            total = x[0] * row[0]
            for value, weight in zip(x[1:], row[1:]):
                total = dr.fma(value, weight, total)
            sums.append(total if i + 1 == len(layers) else dr.maximum(total, 0))
        x = sums
    return x
