"""Shares of people: intervals and differences that hold for few."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from nerg_mi.statistics.estimates import mid_p, proportion_differences, proportions

P = np.linspace(0.001, 0.999, 999)


def column(k, n):
    return np.array([[1.0]] * k + [[0.0]] * (n - k)), np.ones((n, 1))


def test01_tails_of_the_binomial_distribution_at_the_ends():
    for k, n in ((1, 3), (3, 10), (9, 10), (17, 200), (0, 8), (8, 8)):
        (low,), (high,) = mid_p(np.array([k]), np.array([n]))
        below, at = stats.binom.cdf(k - 1, n, high), stats.binom.pmf(k, n, high)
        assert high == 1 if k == n else below + at / 2 == pytest.approx(0.025, abs=1e-9)
        above, at = stats.binom.sf(k, n, low), stats.binom.pmf(k, n, low)
        assert low == 0 if k == 0 else above + at / 2 == pytest.approx(0.025, abs=1e-9)
    # Nobody of 8: half of (1 - p)^8 is 0.025.
    assert mid_p(np.array([0]), np.array([8]))[1] == pytest.approx(1 - 0.05 ** (1 / 8))


@pytest.mark.parametrize("n", [3, 5, 8, 16, 40])
def test02_it_holds_whatever_the_truth(n):
    k = np.arange(n + 1)
    low, high = mid_p(k, np.full(n + 1, n))
    inside = (low[:, None] <= P) & (P <= high[:, None])
    held = (stats.binom.pmf(k[:, None], n, P) * inside).sum(axis=0)
    assert held.min() > 0.92 and held.mean() < 0.99


def test03_whom_it_concerns():
    x = np.array([[1.0, 0, 1, 0], [1, 0, 1, 1], [0, 0, 1, 0], [0, 0, 1, 0]])
    y = np.array([[1.0, 1, 1, 0], [1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 0]])
    found = proportions(x, y)
    assert found.value.tolist() == [0.5, 0, 1, 0.5] and found.people.tolist() == [4, 4, 4, 2]
    assert found.low[1] == 0 and found.high[2] == 1 and found.high[1] > 0.4 and found.low[2] < 0.6
    assert np.isnan([found.low[3], found.high[3]]).all()


def test04_differences_of_other_people():
    # 2 of 12 and 9 of 15: Agresti and Caffo's, from their formula.
    (x, y), (u, v) = column(2, 12), column(9, 15)
    none = np.zeros
    first = (np.concatenate([x, none((15, 1))]), np.concatenate([y, none((15, 1))]))
    second = (np.concatenate([none((12, 1)), u]), np.concatenate([none((12, 1)), v]))
    found = proportion_differences(first, second)
    a, b = 3 / 14, 10 / 17
    s = np.sqrt(a * (1 - a) / 14 + b * (1 - b) / 17)
    assert found.value == pytest.approx(9 / 15 - 2 / 12)
    assert found.low == pytest.approx(b - a - 1.959964 * s) and found.high == pytest.approx(b - a + 1.959964 * s)
    assert found.p == pytest.approx(2 * stats.norm.sf((b - a) / s))


def test05_differences_of_the_same_people():
    # Bonett and Price: of 20 people 9 do both, 1 the first alone, 6 the second alone.
    x = np.array([[1.0]] * 10 + [[0.0]] * 10)
    u = np.array([[1.0]] * 9 + [[0.0]] + [[1.0]] * 6 + [[0.0]] * 4)
    ones = np.ones((20, 1))
    found = proportion_differences((x, ones), (u, ones))
    alone, also = 2 / 22, 7 / 22
    s = np.sqrt((alone + also - (also - alone) ** 2) / 22)
    assert found.low == pytest.approx(also - alone - 1.959964 * s)
    assert found.high == pytest.approx(also - alone + 1.959964 * s)
    # That the same people are alike makes it narrower than of others.
    apart = proportion_differences(
        (np.concatenate([x, 0 * x]), np.concatenate([ones, 0 * ones])),
        (np.concatenate([0 * u, u]), np.concatenate([0 * ones, ones])),
    )
    assert found.high - found.low < 0.9 * (apart.high - apart.low)


def test06_equal_groups_are_seldom_found_different():
    # All outcomes of 8 against 8, of the same probability.
    k = np.arange(9)
    a, b = (v.ravel() for v in np.meshgrid(k, k, indexing="ij"))
    spread = lambda counts: (np.arange(8)[:, None] < counts).astype(float)
    here = np.concatenate([np.ones((8, 81)), np.zeros((8, 81))])
    none = np.zeros((8, 81))
    first, second = np.concatenate([spread(a), none]), np.concatenate([none, spread(b)])
    found = proportion_differences((first, here), (second, 1 - here))
    assert ((found.p <= 0.05) == ((found.low > 0) | (found.high < 0))).all()
    weight = stats.binom.pmf(a[:, None], 8, P) * stats.binom.pmf(b[:, None], 8, P)
    assert 0.03 < (weight * (found.p <= 0.05)[:, None]).sum(axis=0).max() < 0.06


def test07_few_and_nobody():
    found = proportion_differences(column(1, 2), column(1, 2))
    assert np.isnan([found.low, found.high, found.p]).all() and found.value == 0
    nobody = proportions(np.zeros((0, 2)), np.zeros((0, 2)))
    assert np.isnan(nobody.value).all() and np.isnan(nobody.high).all() and nobody.people.tolist() == [0, 0]


@pytest.mark.parametrize("m, n, known", [(3, 3, True), (2, 3, False), (3, 2, False)])
def test08_three_people_have_an_interval_and_two_have_none(m, n, known):
    found = proportions(*column(1, m))
    assert np.isfinite(found.low).all() == np.isfinite(found.high).all() == (m == 3)
    first, second = np.r_[np.ones(m), np.zeros(n)][:, None], np.r_[np.zeros(m), np.ones(n)][:, None]
    difference = proportion_differences((first * 0, first), (second, second))
    assert [np.isfinite(v).all() for v in (difference.low, difference.high, difference.p)] == [known] * 3
