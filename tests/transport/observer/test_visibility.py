"""The shadow factor: its sign, its ramp, and fall-off zero."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.transport.observer import visibility


def seen(d_expected, d_met, falloff, tolerance=0.0):
    return visibility(ns.Float(d_expected), ns.Float(d_met), ns.Float(falloff), ns.Float(tolerance)).numpy().tolist()


def test01_the_sign_is_corrected():
    # The observer meets something at 2: a point at 5 is hidden, one at 2 or before is seen.
    assert seen([5, 2, 1], 2, 1) == [0, 1, 1]


def test02_the_ramp():
    d = np.linspace(1.5, 3.5, 21)
    expected = 1 - np.clip((d - 2 - 0.25) / 0.5, 0, 1)
    assert np.allclose(seen(d, 2, 0.5, 0.25), expected, atol=1e-6)


def test03_falloff_zero_is_a_step():
    assert seen([2, 2.25, 2.2500005, 9], 2, 0, 0.25) == [1, 1, 0, 0]


@pytest.mark.parametrize("falloff", [1e-38, 1e-6, 1e6, 3e38])
def test04_extreme_falloffs(falloff):
    values = seen([0, 1, 2, 1e6], 1, falloff)
    assert np.all(np.isfinite(values)) and values[:2] == [1, 1] and min(values) >= 0
    assert values[2] == (0 if falloff <= 1e-6 else pytest.approx(1 - 1 / falloff))


def test05_nothing_met_is_visible():
    assert seen([1, 1e30], np.inf, 0) == [1, 1] and seen([1, 1e30], np.inf, 0.5) == [1, 1]


@pytest.mark.parametrize("falloff", [0.0, 0.5])
def test06_gradients(falloff):
    f = ns.Float(falloff)
    d = ns.Float([1, 2, 2.25, 5])
    dr.enable_grad(f, d)
    y = visibility(d, ns.Float(2), f, ns.Float(0.1))
    dr.backward(dr.sum(y), dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    # d/dd_f of 1 - 0.15 / d_f = 0.15 / d_f²; only the point on the ramp counts
    assert np.allclose(dr.grad(f).numpy(), 0 if falloff == 0 else 0.15 / 0.25, rtol=1e-5)
    assert np.allclose(dr.grad(d).numpy(), [0, 0, 0 if falloff == 0 else -2, 0], rtol=1e-5)


def test07_gradients_are_finite_on_the_very_edge():
    d = ns.Float([2.25, 2.0, 3.0])
    dr.enable_grad(d)
    y = visibility(d, ns.Float(2), ns.Float(0), ns.Float(0.25))
    assert y.numpy().tolist() == [1, 1, 0]
    dr.backward(dr.sum(y), dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    assert not dr.grad(d).numpy().any()
