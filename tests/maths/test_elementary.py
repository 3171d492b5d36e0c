"""1 - exp(-x) and log(1 + x) against the C library's expm1 and log1p in double precision."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np

from nerg_mi.maths.arrays import log1p, one_minus_exp, quotient, sigmoid

EPS = np.finfo(np.float32).eps


def test01_one_minus_exp():
    x = np.concatenate([[0], np.logspace(-30, 8, 2000), [88, 89, 103, 104, np.inf]]).astype(np.float32)
    got, expected = one_minus_exp(ns.Float(x)).numpy().astype(float), -np.expm1(-x.astype(float))
    assert got[0] == 0 and got[-1] == 1
    assert np.all(np.abs(got - expected) <= 4 * EPS * expected)


def test02_its_gradient():
    x = np.concatenate([[0], np.logspace(-20, 8, 300)]).astype(np.float32)
    v = ns.Float(x)
    dr.enable_grad(v)
    dr.backward(dr.sum(one_minus_exp(v)))
    # To full relative precision, also where nothing is left of it.
    assert np.allclose(dr.grad(v).numpy(), np.exp(-x.astype(float)), rtol=1e-5, atol=1e-37)


def test03_log1p():
    x = np.concatenate([[0], np.logspace(-30, 1, 1000), -np.logspace(-30, np.log10(0.9), 1000), [-0.5]]).astype(
        np.float32
    )
    got, expected = log1p(ns.Float(x)).numpy().astype(float), np.log1p(x.astype(float))
    assert np.all(np.abs(got - expected) <= 2e-6 * np.abs(expected))


def test04_quotient():
    a, b = np.float32([3e-30, 0, 2, -1e20]), np.float32([1e-30, 1e-25, 4, 1e15])
    x, y = ns.Float(a), ns.Float(b)
    dr.enable_grad(x, y)
    q = quotient(x, y)
    assert np.allclose(q.numpy(), a.astype(float) / b, rtol=1e-6)
    dr.backward(dr.sum(q))
    assert np.allclose(dr.grad(x).numpy(), 1 / b.astype(float), rtol=1e-6)
    assert np.allclose(dr.grad(y).numpy(), -a.astype(float) / b.astype(float) ** 2, rtol=1e-6)


def test05_sigmoid_at_its_ends():
    x = np.array([-1e30, -100, -1, 0, 1, 100, 1e30], np.float32)
    v = ns.Float(x)
    dr.enable_grad(v)
    y = sigmoid(v)
    dr.backward(dr.sum(y))
    e = 0.5 + 0.5 * np.tanh(0.5 * x.astype(float))
    assert np.allclose(y.numpy(), e, atol=1e-7) and np.allclose(dr.grad(v).numpy(), e * (1 - e), atol=1e-6)
