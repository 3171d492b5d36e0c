"""Samples: each row as likely as any other, without room for all."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.rays.dataset import sample_rows


@pytest.mark.parametrize("n, runs", [(7, None), (20, None), (33, None), (8, 4), (20, 3)])
def test_every_row_is_as_likely(n, runs):
    counts, each = np.zeros(40), None
    for seed in range(3000):
        rows = sample_rows(40, n, seed, runs)
        assert (np.diff(rows) > 0).all() and rows[0] >= 0 and rows[-1] < 40
        assert each in (None, len(rows))
        each = len(rows)
        counts[rows] += 1
    assert each == (n if runs is None else n // runs * runs)
    # Chi-square of 39 degrees of freedom: 72.1 at one in a thousand; samples without repeats spread less.
    expected = 3000 * each / 40
    assert ((counts - expected) ** 2 / expected).sum() < 72.1


def test_pairs_are_as_likely_too():
    together = np.zeros((6, 6))
    for seed in range(4000):
        rows = sample_rows(6, 2, seed)
        together[rows[0], rows[1]] += 1
    found = together[np.triu_indices(6, 1)]
    assert found.sum() == 4000 and ((found - 4000 / 15) ** 2 / (4000 / 15)).sum() < 36.1


def test_runs_are_of_neighbours():
    rows = sample_rows(10_000, 600, 1, runs=6)
    jumps = np.count_nonzero(np.diff(rows) > 1)
    assert len(rows) == 600 and jumps <= 6


def test_all_and_equal_seeds():
    assert sample_rows(5, 5).tolist() == sample_rows(5, 9, 3, runs=2).tolist() == [0, 1, 2, 3, 4]
    assert np.array_equal(sample_rows(10**12, 50, 4), sample_rows(10**12, 50, 4))
    assert not np.array_equal(sample_rows(10**12, 50, 4), sample_rows(10**12, 50, 5))
