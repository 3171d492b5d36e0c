"""1 - exp(-x), log(1 + x), quotients of tiny numbers and the logistic function, without cancellation or overflow."""

from __future__ import annotations

import drjit as dr


def one_minus_exp(x):
    """1 - exp(-x) for x >= 0, to full relative precision also for tiny x; 1 at infinity."""
    # tanh is accurate near 0 and saturates at 1: 1 - exp(-x) = 2 th / (1 + th), th = tanh(x / 2).
    th = dr.tanh(0.5 * x)
    # The derivative is written out: that of tanh, 1 - th², cancels as x grows.
    return dr.replace_grad(2 * th / (1 + th), -dr.exp(-x))


def log1p(x):
    """log(1 + x) for -1 < x <= 1, to full relative precision also for tiny x."""
    return 2 * dr.atanh(x / (2 + x))


def quotient(a, b):
    """a / b for b != 0. Its first derivatives do not square b, which would overflow below 1e-19."""
    value = dr.detach(a) / dr.detach(b)
    return dr.replace_grad(value, (a - value * b) * (1 / dr.detach(b)))


def sigmoid(x):
    """1 / (1 + exp(-x)), finite with its gradient for every finite x."""
    return dr.fma(0.5, dr.tanh(0.5 * x), 0.5)
