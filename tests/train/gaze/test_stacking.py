"""Tests of `nerg_mi.train.stacking`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from nerg_mi.train.stacking import MAX_STACKED, NO_SURFACES, SURFACES, fit_sparse_weights, fit_weights


def test_weights_maximise_the_penalised_likelihood():
    """Compared with a general optimiser; participants count alike, however many rays they have."""
    rng = np.random.default_rng(0)
    log, participant = rng.normal(size=(4, 60)), np.repeat([3, 7, 9], [5, 15, 40])
    pseudo = np.array([3.0, 1.0, 2.0, 0.5])

    def loss(logits):
        weights = np.exp(logits) / np.exp(logits).sum()
        mixed = np.log(weights @ np.exp(log))
        means = [mixed[participant == p].mean() for p in (3, 7, 9)]
        return -5 * sum(means) - pseudo @ np.log(weights)

    logits = minimize(loss, np.zeros(4), tol=1e-9).x
    weights = fit_weights(log, participant, pseudo)
    np.testing.assert_allclose(weights, np.exp(logits) / np.exp(logits).sum(), atol=1e-3)
    assert weights.sum() == pytest.approx(1)


def test_without_evidence_the_weights_are_those_of_the_pseudo_rays():
    pseudo = np.array([2.0, 1.0, 1.0])
    np.testing.assert_allclose(fit_weights(np.zeros((3, 10)), np.arange(10), pseudo), pseudo / 4)


def test_few_kernels_have_weight():
    """Field, prior and two kernels hold for a quarter of the rays of each of 50 participants."""
    kind, participant = np.tile(np.arange(4), 200), np.repeat(np.arange(50), 16)
    log = np.full((38, 800), np.log(0.01))
    for k, component in enumerate((0, 1, 9, 30)):
        log[component, kind == k] = 0
    weights = fit_sparse_weights(log, participant)
    assert np.flatnonzero(weights).tolist() == [0, 1, 9, 30] and weights.sum() == pytest.approx(1)
    np.testing.assert_allclose(weights[[9, 30]], 0.25, atol=0.06)
    # Ten kernels that are alike do not displace another.
    alike = log.copy()
    alike[9:19] = log[9]
    assert set(np.flatnonzero(fit_sparse_weights(alike, participant))) > {0, 1, 30}
    # Many equal kernels that are better than the rest, and none
    equal = np.where(np.arange(38)[:, None] < 2, -2.0, 0.0) * np.ones(800)
    assert np.count_nonzero(fit_sparse_weights(equal, participant)) == 2 + MAX_STACKED
    useless = np.where(np.arange(38)[:, None] < 2, 0.0, -9.0) * np.ones(800)
    assert np.flatnonzero(fit_sparse_weights(useless, participant)).tolist() == [0, 1]
    assert np.flatnonzero(fit_sparse_weights(log[:2], participant)).tolist() == [0, 1]


def test_without_surfaces_the_field_needs_more_evidence():
    """With less evidence than pseudo-rays, the fractions of these decide."""
    log, participant = np.zeros((2, 4)), np.zeros(4, int)
    for fractions in (SURFACES, NO_SURFACES):
        field, prior, _ = fractions
        np.testing.assert_allclose(
            fit_sparse_weights(log, participant, fractions), np.array([field, prior]) / (field + prior)
        )
    assert NO_SURFACES[0] < SURFACES[0]
