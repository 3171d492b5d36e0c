"""What radiance training is fitted to, against NumPy: colours and the place of absorption."""

from types import SimpleNamespace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.train.radiance_losses import color_loss, depth_loss, huber
from nerg_mi.train.radiance_sampling import Samples, Segments

RAY = np.array([0, 0, 0, 0, 1, 1, 1, 2, 2])
T = np.array([0.5, 1.0, 1.5, 2.0, 0.2, 0.4, 3.0, 1.0, 1.2])
LENGTH = np.array([0.5, 0.5, 0.5, 0.25, 0.2, 0.1, 1.0, 0.2, 0.4])
TAU = np.array([0.1, 0.7, 2.0, 3.0, 0.2, 40.0, 0.5, 0.3, 1.0])


def samples():
    segments = Segments(ns.UInt32(RAY), dr.full(ns.Bool, True, len(RAY)), 3)
    return Samples(ns.UInt32(RAY), ns.Float(T), ns.Float(LENGTH), None, segments, len(RAY))


def absorbed():
    """Weights of the samples, in float64."""
    weight = -np.expm1(-TAU)
    for r in range(3):
        of = RAY == r
        weight[of] *= np.exp(-np.concatenate([[0], np.cumsum(TAU[of])[:-1]]))
    return weight


@pytest.mark.parametrize("margin", [0.05, 0.3, 10.0])
def test_depth_loss(margin):
    truth, scale = np.array([1.45, 0.46, 0.0]), 0.2
    weight = absorbed()
    near = (T < truth[RAY] + margin) & (T + LENGTH > truth[RAY] - margin)
    # Mean distance of absorption into a step: the integral of s tau exp(-tau s) over it, by the midpoint rule.
    s = (np.arange(200_000) + 0.5) / 200_000
    mean = np.array([(s * np.exp(-tau * s)).sum() / np.exp(-tau * s).sum() for tau in TAU])
    offset = T + LENGTH * mean - truth[RAY]
    caught = np.bincount(RAY, weight * near)
    shift = np.bincount(RAY, weight * near * offset)
    want = np.where(truth > 0, 1 - caught + np.minimum(np.abs(shift) / scale, 10), 0)
    got = depth_loss(ns.Float(weight), ns.Float(TAU), samples(), ns.Float(truth), margin, scale).numpy()
    assert np.allclose(got, want, rtol=1e-5, atol=1e-6)
    assert want[2] == 0 and (want[:2] > 0.01).all()


def test_depth_loss_is_bounded_where_all_is_at_the_wrong_place():
    far = ns.Float(100.0, 100.0, 100.0)
    got = depth_loss(ns.Float(absorbed()), ns.Float(TAU), samples(), far, 1e3, 1e-3).numpy()
    assert np.allclose(got, 1 - np.bincount(RAY, absorbed()) + 10, rtol=1e-5)


@pytest.mark.parametrize("alpha", [None, [1.0, 0.25, 0.0]])
def test_color_loss(alpha):
    rng = np.random.default_rng(0)
    color, target, behind = rng.random((3, 3, 3))
    opacity, delta = np.array([0.9, 0.4, 0.0]), 0.2
    pixels = SimpleNamespace(rgb=[ns.Float(c) for c in target], alpha=None if alpha is None else ns.Float(alpha))
    got = color_loss([ns.Float(c) for c in color], ns.Float(opacity), pixels, ns.Array3f(behind), delta).numpy()
    # Of a picture with alpha the colour is that before nothing: what is transparent shows the background.
    goal = target if alpha is None else behind * (1 - np.array(alpha)) + target * np.array(alpha)
    error = np.abs(color + (1 - opacity) * behind - goal)
    want = np.where(error < delta, error**2 / 2, delta * (error - delta / 2)).mean(axis=0)
    assert np.allclose(got, want, rtol=1e-5) and (error < delta).any() and (error > delta).any()


def test_huber_is_smooth_where_its_pieces_meet():
    x = ns.Float([-0.3, -0.1001, -0.0999, 0, 0.0999, 0.1001, 0.3])
    dr.enable_grad(x)
    y = huber(x, 0.1)
    dr.backward(dr.sum(y))
    assert np.allclose(dr.grad(x).numpy(), [-0.1, -0.1, -0.0999, 0, 0.0999, 0.1, 0.1], atol=1e-6)
    assert np.allclose(y.numpy()[[0, 3, 6]], [0.1 * 0.25, 0, 0.1 * 0.25])
