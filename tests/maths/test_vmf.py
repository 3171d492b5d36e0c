from decimal import Decimal, localcontext

import numpy as np
import pytest

from nerg_mi.maths import vmf


@pytest.mark.parametrize("kappa", [1e-8, 1e-3, 1.0, 50.0, 1e4, 1e8])
def test_normaliser_over_sixteen_orders(kappa):
    got = float(vmf.log_normaliser(kappa))
    # SciPy's form, log of κ/(4π sinh κ) e^κ, in its stable regimes.
    want = (
        -np.log(4 * np.pi) + kappa
        if kappa < 1e-6
        else np.log(kappa) - np.log(2 * np.pi) - np.log1p(-np.exp(-2 * kappa))
    )
    assert np.isclose(got, want, rtol=1e-12)


def test_normaliser_at_zero_is_uniform():
    assert np.isclose(vmf.log_normaliser(0.0), -np.log(4 * np.pi), rtol=1e-15)
    assert np.isclose(vmf.log_normaliser(1e4), 7.372463305566, rtol=1e-12)
    with pytest.raises(ValueError, match="negative or NaN"):
        vmf.log_normaliser(-1.0)


def test_density_is_accurate_near_the_mean():
    mu = np.array([0.0, 0.0, 1.0])
    angle = 1e-5
    x = np.array([np.sin(angle), 0.0, np.cos(angle)])
    assert np.isclose(
        vmf.log_density(x, mu, 1e8) - vmf.log_normaliser(1e8), -1e8 * 2 * np.sin(angle / 2) ** 2, rtol=1e-9
    )


def test_kappa_inverts_the_resultant_length():
    kappa = np.geomspace(1e-6, 1e7, 200)
    back = vmf.kappa_from_mean_resultant_length(vmf.mean_resultant_length(kappa))
    assert np.allclose(back, kappa, rtol=1e-7)
    assert vmf.kappa_from_mean_resultant_length(0.0) == vmf.KAPPA_MIN
    assert vmf.kappa_from_mean_resultant_length(1.0) == vmf.KAPPA_MAX
    with pytest.raises(ValueError, match="average unit vectors"):
        vmf.kappa_from_mean_resultant_length(1.5)


def test_bandwidth_rule_of_the_published_code():
    # Values of nerg-neural-gaze at 1,024 rays.
    R = [0.1, 0.3, 0.5, 0.8, 0.9, 0.95]
    assert np.allclose(vmf.silverman_kappa(R, 1024), [4.3, 13.6, 25.6, 71, 142, 285], rtol=5e-3)
    assert np.isclose(vmf.silverman_kappa(1.0, 1), 1 / 1.06**2)
    assert np.isfinite(vmf.silverman_kappa(1.0, 50))


@pytest.mark.parametrize("kappa", [1e-8, 2.0, 50.0, 1e6])
def test_samples_have_the_moments(kappa):
    rng = np.random.default_rng(3)
    mu = np.tile([0.48, -0.6, -0.64], (50_000, 1))
    x = vmf.sample(mu, kappa, rng)
    assert np.allclose(np.linalg.norm(x, axis=1), 1, atol=1e-12)
    assert np.allclose(x.mean(axis=0), vmf.mean_resultant_length(kappa) * mu[0], atol=0.012)
    if kappa > 1:
        assert np.isclose(vmf.one_minus_cosine(x, mu).mean(), 1 - vmf.mean_resultant_length(kappa), rtol=0.02)


def test_convolution_multiplies_resultant_lengths():
    a, b = np.array([1e-3, 0.5, 5.0, 37.0, 300.0, 1e5]), np.array([2.0, 40.0, 1e3, 50.0, 1e6, 1e5])
    A = vmf.mean_resultant_length
    assert np.allclose(A(vmf.convolve_kappa(a, b)), A(a) * A(b), rtol=1e-6)
    assert np.allclose(vmf.convolve_kappa(a, b), vmf.convolve_kappa(b, a))
    assert np.allclose(vmf.convolve_kappa(37.0, vmf.KAPPA_MAX), 37.0, rtol=1e-4)
    assert np.isclose(vmf.convolve_kappa(1e5, 1e5), 5e4, rtol=1e-4)


@pytest.mark.parametrize("kappa", [1e-8, 1e-3, 5e-3, 9.99e-3, 1.01e-2, 0.3, 4.0, 30.0])
def test_resultant_length_is_accurate(kappa):
    with localcontext() as context:
        context.prec = 60
        k = Decimal(kappa)
        grown, shrunk = k.exp(), (-k).exp()
        exact = float((grown + shrunk) / (grown - shrunk) - 1 / k)
    # The direct formula coth κ - 1/κ loses κ² of its digits; at 1e-2 the series takes over.
    assert np.isclose(vmf.mean_resultant_length(kappa), exact, rtol=1e-14 if kappa < 1e-2 else 1e-11, atol=0)


def test_kappa_solves_the_resultant_length_equation():
    # Up to the switch to the other form the root is found by Newton's method, to full precision.
    kappa = np.linspace(0.5, 25, 500)
    assert np.allclose(vmf.kappa_from_mean_resultant_length(1 / np.tanh(kappa) - 1 / kappa), kappa, rtol=1e-10, atol=0)


def test_samples_with_zero_kappa_are_uniform():
    x = vmf.sample(np.tile([0.48, -0.6, -0.64], (20_000, 1)), 0.0, np.random.default_rng(5))
    assert np.allclose(x.mean(axis=0), 0, atol=0.02) and np.allclose(x.T @ x / len(x), np.eye(3) / 3, atol=0.02)
    with pytest.raises(ValueError, match="negative or NaN"):
        vmf.sample(np.array([[0.0, 0.0, 1.0]]), -1.0, np.random.default_rng(5))
