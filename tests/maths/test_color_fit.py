"""Colours fitted from one picture to another: known corrections are found, and the scored half is never looked at."""

import numpy as np
import pytest

from nerg_mi.maths.color import fit_colors, psnr, psnr_of_fitted_half

A = np.array([[0.8, 0.05, 0.0], [0.0, 0.9, -0.04], [0.02, 0.0, 1.1]])
B = np.array([0.05, -0.02, 0.01])


def pictures(width=61):
    color = np.random.default_rng(0).uniform(0.1, 0.8, (40, width, 3))
    return color, color @ A.T + B


def test_a_known_correction_is_found():
    color, truth = pictures()
    m = fit_colors(color, truth)
    assert np.allclose(m, np.c_[A, B], atol=0.01)
    # Least squares with the prior, solved for one channel by itself.
    x = np.c_[color.reshape(-1, 3), np.ones(color[..., 0].size)]
    weight = 1e-3 * len(x)
    rows = np.r_[x, np.sqrt(weight) * np.eye(4)]
    goal = np.r_[truth[..., 1].ravel(), np.sqrt(weight) * np.eye(4)[1]]
    assert np.allclose(m[1], np.linalg.lstsq(rows, goal, rcond=None)[0])


def test_what_cannot_be_known_stays():
    color, truth = pictures()
    nothing = np.zeros(color.shape[:2], bool)
    assert np.allclose(fit_colors(color, truth, mask=nothing), np.eye(3, 4))
    assert np.allclose(fit_colors(color, color), np.eye(3, 4))


def test_the_offset_does_not_reach_what_is_not_covered():
    color, truth = pictures()
    coverage = (np.arange(61) % 2).astype(float) * np.ones((40, 1))
    before_black = truth * coverage[..., None]
    assert np.allclose(fit_colors(color * coverage[..., None], before_black, coverage), np.c_[A, B], atol=0.02)


def test_the_right_half_is_scored_after_a_fit_of_the_left():
    color, truth = pictures()
    assert psnr(color, truth) < 25 < 40 < psnr_of_fitted_half(color, truth)
    # The odd column belongs to the left half: what is wrong there is not scored, and what is wrong right of it is.
    for column, scored in ((30, False), (31, True)):
        spoilt = truth.copy()
        spoilt[:, column] = 0
        assert (psnr_of_fitted_half(truth, spoilt) < 25) == scored
    # Nothing is learnt from the half that is scored.
    changed = color.copy()
    changed[:, 31:] = truth[:, 31:]
    assert psnr_of_fitted_half(changed, truth) < 25


def test_masks_leave_out_what_they_hide():
    color, truth = pictures()
    mask = np.ones(color.shape[:2], bool)
    mask[:, ::3] = False
    spoilt = np.where(mask[..., None], truth, 0)
    assert psnr_of_fitted_half(color, spoilt, mask=mask) == pytest.approx(
        psnr_of_fitted_half(color, truth, mask=mask), abs=1e-9
    )
    assert np.isnan(psnr_of_fitted_half(color, truth, mask=mask & False))
