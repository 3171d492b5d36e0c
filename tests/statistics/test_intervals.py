"""Intervals over people, their differences, and the discovery rate."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from nerg_mi.statistics.intervals import (
    adjusted,
    discoveries,
    proportion_differences,
    proportions,
    ratio_differences,
    ratios,
    wilson,
)

ONES = np.ones


def test01_of_many_normal_people_it_is_that_of_student():
    x = np.random.default_rng(0).normal(5, 1, (60, 1))
    found = ratios(x, ONES(x.shape), resamples=4000)
    reach = stats.t.ppf(0.975, 59) * x.std(ddof=1) / np.sqrt(60)
    assert found.value == pytest.approx(x.mean()) and found.people.tolist() == [60]
    assert found.low[0] == pytest.approx(x.mean() - reach, abs=0.15 * reach)
    assert found.high[0] == pytest.approx(x.mean() + reach, abs=0.15 * reach)


def test02_a_loop_over_draws_gives_the_same():
    rng = np.random.default_rng(1)
    x, y = rng.gamma(1, 1, (9, 1)), rng.gamma(2, 1, (9, 1))
    found = ratios(x, y, resamples=500, seed=7)
    m = x.sum() / y.sum()
    s = np.sqrt(((x - m * y) ** 2).sum() * 9 / 8) / y.sum()
    draws = np.random.default_rng(7).multinomial(9, np.full(9, 1 / 9), size=500)
    t = []
    for draw in draws:
        rows = np.repeat(np.arange(9), draw)
        a, b = x[rows, 0], y[rows, 0]
        star = a.sum() / b.sum()
        spread = ((a - star * b) ** 2).sum() * 9 / 8 / b.sum() ** 2
        t.append((star - m) / np.sqrt(0.99 * spread + 0.01 * s**2))
    low, high = np.quantile(t, (0.025, 0.975))
    assert found.low[0] == pytest.approx(max(m - high * s, 0)) and found.high[0] == pytest.approx(m - low * s)


def test03_people_hold_together():
    # 4 people whose thousands of rays agree: as uncertain as 4 numbers.
    x = np.array([[0.1], [0.2], [0.3], [0.4]])
    found = ratios(x, ONES(x.shape))
    assert found.low[0] < 0.13 and found.high[0] > 0.37


def test04_nobody_few_and_nothing():
    x = np.array([[0.0, 0.2, 0.3], [0.0, 0.2, 0.1], [0.0, 0.2, 0.0], [0.0, 0.2, 0.0]])
    y = np.array([[1.0, 1, 1], [1, 1, 1], [1, 1, 0], [1, 1, 0]])
    found = ratios(x, y)
    assert found.value == pytest.approx([0, 0.2, 0.2]) and found.people.tolist() == [4, 4, 2]
    assert np.isnan(found.low).all() and np.isnan(found.high).all()
    nobody = ratios(np.zeros((0, 2)), np.zeros((0, 2)))
    assert np.isnan(nobody.value).all() and nobody.people.tolist() == [0, 0]
    one = ratios(ONES((1, 1)), ONES((1, 1)))
    assert one.value == 1 and np.isnan(one.low).all()


def test05_wilson():
    # scipy's own.
    for k, n in ((0, 10), (3, 10), (10, 10), (1, 200)):
        expected = stats.binomtest(k, n).proportion_ci(method="wilson")
        assert np.allclose(wilson(np.array([k]), np.array([n])), [[expected.low], [expected.high]])
    x = np.array([[1.0, 0, 1], [1, 0, 1], [0, 0, 1], [0, 0, 1]])
    found = proportions(x, ONES(x.shape))
    assert found.value.tolist() == [0.5, 0, 1] and found.high[1] > 0.4 and found.low[2] < 0.6
    assert np.isnan(proportions(x[:2], ONES((2, 3))).low).all()
    assert found.low[1] == 0 and found.high[2] == 1


def test06_a_difference_of_the_same_people_is_of_their_differences():
    rng = np.random.default_rng(2)
    base = rng.normal(10, 5, (40, 1))
    after = base + rng.normal(1, 0.1, (40, 1))
    y = ONES((40, 1))
    same = ratio_differences((base, y), (after, y))
    assert same.value == pytest.approx((after - base).mean()) and same.high - same.low < 0.1 and same.p < 0.01
    # Of others it is as wide as their spread.
    x = np.concatenate([base, 0 * after])
    z = np.concatenate([0 * base, after])
    apart = ratio_differences((x, np.concatenate([y, 0 * y])), (z, np.concatenate([0 * y, y])))
    welch = stats.ttest_ind(after[:, 0], base[:, 0], equal_var=False)
    assert apart.value == pytest.approx(same.value)
    assert apart.high - apart.low == pytest.approx(np.ptp(welch.confidence_interval()), rel=0.15)
    assert apart.p == pytest.approx(welch.pvalue, abs=0.08)


def test07_equal_groups_are_found_different_as_often_as_said():
    rng = np.random.default_rng(3)
    x = rng.exponential(1, (24, 600))
    first, second = np.zeros((24, 600)), np.zeros((24, 600))
    first[:12], second[12:] = 1, 1
    found = ratio_differences((x * first, first), (x * second, second), resamples=399)
    assert 0.01 < (found.p <= 0.05).mean() < 0.09
    assert 0.92 < ((found.low <= 0) & (found.high >= 0)).mean() <= 0.995


def test08_shares_of_people():
    # Newcombe 1998, table II: 56/70 against 48/80 is 0.2, method 10 gives 0.0524 to 0.3339.
    def column(k, n):
        return np.array([[1.0]] * k + [[0.0]] * (n - k)), np.ones((n, 1))

    (x, y), (u, v) = column(48, 80), column(56, 70)
    found = proportion_differences((x, y), (u, v))
    assert found.value == pytest.approx(0.2) and found.low == pytest.approx(0.0524, abs=1e-4)
    assert found.high == pytest.approx(0.3339, abs=1e-4) and 0.001 < found.p[0] < 0.02
    alike = proportion_differences((x, y), (x, y))
    assert alike.p == pytest.approx(1) and alike.low < 0 < alike.high


def test09_discoveries():
    p = np.array([0.001, np.nan, 0.04, 0.03, 0.2, 0.008])
    assert np.allclose(adjusted(p)[[0, 2, 3, 4, 5]], stats.false_discovery_control(p[[0, 2, 3, 4, 5]]))
    assert np.isnan(adjusted(p)[1]) and not discoveries(p)[1]
    assert discoveries(p).tolist() == (adjusted(p) <= 0.05).tolist()
    assert adjusted(np.full(3, np.nan)).shape == (3,) and len(adjusted(np.zeros(0))) == 0


def test10_equal_seeds_give_equal_intervals():
    x = np.random.default_rng(5).random((12, 3))
    a, b = ratios(x, ONES(x.shape), seed=4), ratios(x, ONES(x.shape), seed=4)
    assert np.array_equal(a.low, b.low) and not np.array_equal(a.low, ratios(x, ONES(x.shape), seed=5).low)
