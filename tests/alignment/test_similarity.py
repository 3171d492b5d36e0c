"""Tests of `nerg_mi.alignment.similarity`."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from nerg_mi.alignment.similarity import (
    FULL_BASIS,
    MIRROR,
    LocalSimilarity,
    check_points,
    fit_similarity,
    is_planar,
    leave_one_out_distances,
    residual_distances,
    right_jacobian,
    turn_between,
    vertical_rotation,
)
from nerg_mi.errors import NergError
from nerg_mi.maths.transforms import similarity_scale

from .rooms import carried, similarity

# ---- Chart ----


def hat(w):
    return np.cross(np.eye(3), np.asarray(w)).T * -1


@pytest.mark.parametrize("size", [1e-7, 0.3, 2.5])
def test_right_jacobian_matches_the_matrix_exponential(size):
    w = size * np.array([0.6, -0.64, 0.48])
    step = 1e-6
    for k, e in enumerate(np.eye(3)):
        turned = (expm(hat(w + step * e)) - expm(hat(w - step * e))) / (2 * step)
        np.testing.assert_allclose(expm(hat(w)).T @ turned, hat(right_jacobian(w)[:, k]), atol=1e-8)


@pytest.mark.parametrize("basis", [FULL_BASIS, FULL_BASIS[:, :-1], FULL_BASIS[:, [2, 3, 4, 6]], FULL_BASIS[:, [2, 6]]])
def test_derivatives_match_central_differences(basis):
    rng = np.random.default_rng(0)
    chart = LocalSimilarity(similarity(rng), rng.normal(size=3), basis)
    x, q, slope = rng.normal(size=(20, 3)), rng.normal(0, 0.4, basis.shape[1]), rng.normal(size=(20, 3))
    moved = chart.transform(q, x)
    np.testing.assert_allclose(moved, carried(chart.matrix(q), x), atol=1e-12)
    by = chart.gradient(q, moved, slope)
    for k, e in enumerate(1e-6 * np.eye(len(q))):
        numeric = np.sum(slope * (chart.transform(q + e, x) - chart.transform(q - e, x)), axis=1) / 2e-6
        np.testing.assert_allclose(by[:, k], numeric, atol=1e-7)
    assert chart.scale(q) == pytest.approx(similarity_scale(chart.matrix(q)))


# ---- Umeyama ----


@pytest.mark.parametrize("upright", [False, True])
def test_exact_points_give_the_similarity(upright):
    for seed in range(10):
        rng = np.random.default_rng(seed)
        truth, x = similarity(rng, upright), rng.normal(size=(4, 3))
        np.testing.assert_allclose(fit_similarity(x, carried(truth, x), upright=upright), truth, atol=1e-9)


def test_noisy_points_match_a_minimiser():
    rng = np.random.default_rng(1)
    truth, x, w = similarity(rng), rng.normal(size=(7, 3)), rng.uniform(0.5, 2, 7)
    y = carried(truth, x) + rng.normal(0, 0.1, x.shape)

    def cost(p):
        moved = np.exp(p[6]) * Rotation.from_rotvec(p[:3]).apply(x) + p[3:6]
        return w @ np.sum((moved - y) ** 2, axis=1)

    result = fit_similarity(x, y, w)
    start = [*Rotation.from_matrix(result[:3, :3] / similarity_scale(result)).as_rotvec() + 0.1, *result[:3, 3], 0]
    best = minimize(cost, start, method="BFGS", options={"gtol": 1e-10})
    assert w @ np.sum((carried(result, x) - y) ** 2, axis=1) == pytest.approx(best.fun, rel=1e-6)


def test_known_scale_and_flat_points():
    rng = np.random.default_rng(2)
    truth, x = similarity(rng, scale=2.0), rng.normal(size=(5, 3)) * (1, 1, 0)
    assert is_planar(x) and not is_planar(rng.normal(size=(9, 3)))
    np.testing.assert_allclose(fit_similarity(x, carried(truth, x), scale=2.0), truth, atol=1e-9)
    upright = similarity(rng, upright=True)
    y = carried(upright, x) + rng.normal(0, 0.1, x.shape)
    fixed = {"turn": 0.3, "shift": np.array([1.0, 2, 3])}
    fit = fit_similarity(x, y, upright=True, **fixed)
    np.testing.assert_allclose(fit[:3, :3], similarity_scale(fit) * vertical_rotation(0.3), atol=1e-12)
    assert turn_between(upright, fit) == pytest.approx(turn_between(upright, np.eye(4)) + turn_between(np.eye(4), fit))
    squares = lambda s: np.sum((s * x @ vertical_rotation(0.3).T + fixed["shift"] - y) ** 2)
    scale = similarity_scale(fit)
    assert squares(scale) <= min(squares(0.99 * scale), squares(1.01 * scale))
    assert np.linalg.det(fit_similarity(x, carried(truth @ MIRROR, x))[:3, :3]) > 0


def test_two_points_suffice_with_known_up():
    rng = np.random.default_rng(3)
    truth, x = similarity(rng, True), rng.normal(size=(2, 3))
    check_points(x, x, "the pairs", upright=True)
    np.testing.assert_allclose(fit_similarity(x, carried(truth, x), upright=True), truth, atol=1e-9)


def test_leave_one_out_distances():
    rng = np.random.default_rng(4)
    truth, x = similarity(rng), rng.normal(size=(5, 3))
    y = carried(truth, x)
    y[2] += similarity_scale(truth) * np.array([0.5, 0, 0])
    left = leave_one_out_distances(x, y)
    assert left[2] == pytest.approx(0.5, rel=1e-6) and residual_distances(fit_similarity(x, y), x, y).max() < 0.5
    assert np.isnan(leave_one_out_distances(x[:3], y[:3])).all()


@pytest.mark.parametrize(
    "points, why",
    [
        (np.zeros((2, 3)), "2 pairs of points, but 3"),
        (np.zeros((4, 3)), "at one position"),
        (np.outer(np.arange(5.0), [1, 2, 3]), "on a line"),
        (np.full((4, 3), np.nan), "points in the frame"),
    ],
)
def test_degenerate_points_are_refused(points, why):
    with pytest.raises(NergError, match=why):
        check_points(points, points, "the pairs")
    with pytest.raises(NergError, match="above one another"):
        check_points(*[np.outer(np.arange(4.0), [0, 0, 1])] * 2, "the pairs", upright=True)
