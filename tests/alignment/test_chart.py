import numpy as np
import pytest
from scipy.linalg import expm

from nerg_mi.alignment.similarity import ALL, Chart, right_jacobian, scale_of, upright_basis

from .rooms import carried, similarity


def hat(w):
    return np.cross(np.eye(3), np.asarray(w)).T * -1


@pytest.mark.parametrize("size", [1e-7, 0.3, 2.5])
def test_right_jacobian_is_that_of_the_matrix_exponential(size):
    w = size * np.array([0.6, -0.64, 0.48])
    step = 1e-6
    for k, e in enumerate(np.eye(3)):
        turned = (expm(hat(w + step * e)) - expm(hat(w - step * e))) / (2 * step)
        np.testing.assert_allclose(expm(hat(w)).T @ turned, hat(right_jacobian(w)[:, k]), atol=1e-8)


@pytest.mark.parametrize("basis", [ALL, ALL[:, :-1], upright_basis(False), upright_basis(True)])
def test_derivatives_are_those_of_central_differences(basis):
    rng = np.random.default_rng(0)
    chart = Chart(similarity(rng), rng.normal(size=3), basis)
    x, q, slope = rng.normal(size=(20, 3)), rng.normal(0, 0.4, basis.shape[1]), rng.normal(size=(20, 3))
    moved = chart.moved(q, x)
    np.testing.assert_allclose(moved, carried(chart.matrix(q), x), atol=1e-12)
    by = chart.pulled(q, moved, slope)
    for k, e in enumerate(1e-6 * np.eye(len(q))):
        numeric = np.sum(slope * (chart.moved(q + e, x) - chart.moved(q - e, x)), axis=1) / 2e-6
        np.testing.assert_allclose(by[:, k], numeric, atol=1e-7)
    assert chart.scale(q) == pytest.approx(scale_of(chart.matrix(q)))


def test_upright_charts_keep_up_and_the_floor():
    rng = np.random.default_rng(1)
    base = similarity(rng, upright=True)
    floor = base[2, 3]
    chart = Chart(base, np.array([1.0, 2.0, floor]), upright_basis(True))
    m = chart.matrix(rng.normal(size=4))
    np.testing.assert_allclose(m[:3, 2] / scale_of(m), [0, 0, 1], atol=1e-12)
    assert m[2, 3] == pytest.approx(floor)
