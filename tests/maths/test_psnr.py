"""The PSNR of pictures: known errors, masks, and no error at all."""

import numpy as np
import pytest

from nerg_mi.maths.color import decibels, psnr


def test_psnr():
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-0.2, 1.2, (5, 4, 3)), rng.random((5, 4, 3))
    error = (np.clip(a, 0, 1) - b) ** 2
    assert psnr(a, b) == pytest.approx(-10 * np.log10(error.mean()))
    mask = rng.random((5, 4)) < 0.5
    assert psnr(a, b, mask) == pytest.approx(-10 * np.log10(error[mask].mean()))
    assert psnr(b, b) == pytest.approx(120) and np.isnan(psnr(a, b, mask & False))


def test_psnr_of_a_known_error():
    truth = np.full((4, 5, 3), 0.5)
    assert psnr(truth + 0.1, truth) == pytest.approx(20)
    mask = np.zeros((4, 5), bool)
    mask[0, 0] = True
    wrong = truth.copy()
    wrong[0, 0] += 0.01
    assert psnr(wrong, truth, mask) == pytest.approx(40)


def test_decibels_of_a_mean_square():
    assert decibels(0.01) == pytest.approx(20) and decibels(1.0) == 0
    assert decibels(0.0) == pytest.approx(120) and decibels(0.0, 1e-24) == pytest.approx(240)
