"""Tests of `nerg_mi.maths.arrays`."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.maths.arrays import ALIGNMENT, copy_aligned, log1p, one_minus_exp, quotient, sigmoid, to_vector

# ---- Arrays for Dr.Jit: equal values, and kernels that do not depend on their number ----


@pytest.mark.parametrize("count", [0, 1, 15, 16, 1003])
def test01_copies_are_equal_and_aligned(rgb, count):
    rows = np.random.default_rng(count).normal(size=(count, 3))
    assert np.array_equal(np.array(to_vector(rgb.Point3f, rows)), rows.astype(np.float32).T)
    assert np.array_equal(np.array(to_vector(rgb.Vector3f, rows[:, ::-1])), rows[:, ::-1].astype(np.float32).T)
    for dtype in (np.float32, np.uint32, np.float64):
        values = copy_aligned(np.arange(count), dtype)
        # An empty array has no address.
        assert values.dtype == dtype and (count == 0 or values.ctypes.data % ALIGNMENT == 0)
        assert np.array_equal(values, np.arange(count))
    assert np.array_equal(copy_aligned(rows[:, ::-1]), rows[:, ::-1].astype(np.float32))


def test02_copies_are_independent(rgb):
    rows = np.ones((20, 3), np.float32)
    made, column = to_vector(rgb.Point3f, rows), rgb.Float(copy_aligned(rows[:, 0]))
    rows[:] = 7
    assert np.all(np.array(made) == 1) and np.all(np.array(column) == 1)


def test03_kernels_do_not_depend_on_the_length(rgb):
    kernels = set()
    for count in (1000, 1003, 1999, 2048):
        # For any alignment of the memory.
        spare = [np.empty(k) for k in range(1, 9)]
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            v, w = to_vector(rgb.Point3f, np.ones((count, 3))), rgb.UInt32(copy_aligned(np.ones(count), np.uint32))
            dr.eval(dr.norm(v) + rgb.Float(w) * rgb.Float(copy_aligned(np.ones(count))))
            kernels |= {kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])}
        del spare
    assert len(kernels) == 1


# ---- 1 - exp(-x) and log(1 + x) against the C library's expm1 and log1p in double precision ----

EPS = np.finfo(np.float32).eps


def test01_one_minus_exp():
    x = np.concatenate([[0], np.logspace(-30, 8, 2000), [88, 89, 103, 104, np.inf]]).astype(np.float32)
    got, expected = one_minus_exp(ns.Float(x)).numpy().astype(float), -np.expm1(-x.astype(float))
    assert got[0] == 0 and got[-1] == 1
    assert np.all(np.abs(got - expected) <= 4 * EPS * expected)


def test02_gradient_of_one_minus_exp():
    x = np.concatenate([[0], np.logspace(-20, 8, 300)]).astype(np.float32)
    v = ns.Float(x)
    dr.enable_grad(v)
    dr.backward(dr.sum(one_minus_exp(v)))
    # To full relative precision, also for tiny results.
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


def test05_sigmoid_at_extremes():
    x = np.array([-1e30, -100, -1, 0, 1, 100, 1e30], np.float32)
    v = ns.Float(x)
    dr.enable_grad(v)
    y = sigmoid(v)
    dr.backward(dr.sum(y))
    e = 0.5 + 0.5 * np.tanh(0.5 * x.astype(float))
    assert np.allclose(y.numpy(), e, atol=1e-7) and np.allclose(dr.grad(v).numpy(), e * (1 - e), atol=1e-6)
