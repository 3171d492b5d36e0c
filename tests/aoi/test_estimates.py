"""Tests of `nerg_mi.aoi.estimates`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from nerg_mi.aoi.estimates import (
    adjust_p_values,
    estimate_proportion_differences,
    estimate_proportions,
    estimate_ratio_differences,
    estimate_ratios,
    mid_p_interval,
)

# ---- p-values of many hypotheses, adjusted for the false discovery rate ----


@pytest.mark.parametrize(
    "p, expected",
    [
        # 5 hypotheses: 0.001·5/1, 0.008·5/2, then 0.04·5/4 for 0.03 as well, since 0.03·5/3 is not less.
        ([0.001, np.nan, 0.04, 0.03, 0.2, 0.008], [0.005, np.nan, 0.05, 0.05, 0.2, 0.02]),
        ([0.9, 0.95], [0.95, 0.95]),
        ([np.nan, 0.3], [np.nan, 0.3]),
        ([np.nan] * 3, [np.nan] * 3),
        ([], []),
    ],
)
def test_missing_p_values_are_ignored(p, expected):
    assert np.allclose(adjust_p_values(np.array(p)), expected, rtol=1e-12, equal_nan=True)


# ---- Ratios and their differences ----

ONES = np.ones


def test_interval_approaches_students_t():
    x = np.random.default_rng(0).normal(5, 1, (60, 1))
    result = estimate_ratios(x, ONES(x.shape), resamples=4000)
    extent = stats.t.ppf(0.975, 59) * x.std(ddof=1) / np.sqrt(60)
    assert result.value == pytest.approx(x.mean()) and result.participants.tolist() == [60]
    assert result.low[0] == pytest.approx(x.mean() - extent, abs=0.15 * extent)
    assert result.high[0] == pytest.approx(x.mean() + extent, abs=0.15 * extent)


def _studentize_loop(draws, value, error):
    """Studentised deviations of draws, pairs of numerators and denominators (9,), in absolute value."""
    t = []
    for a, b in draws:
        star = a.sum() / b.sum()
        spread = ((a - star * b) ** 2).sum() * 9 / 8 / b.sum() ** 2
        t.append(abs(star - value) / np.sqrt(0.99 * spread + 0.01 * error**2))
    return t


def test_bootstrap_matches_a_loop():
    rng = np.random.default_rng(1)
    x, y = rng.gamma(1, 1, (9, 1)), rng.gamma(2, 1, (9, 1))
    result = estimate_ratios(x, y, resamples=500, seed=7)
    m = x.sum() / y.sum()
    linear = np.sqrt(((x - m * y) ** 2).sum() * 9 / 8) / y.sum()
    without = [np.delete(x, k).sum() / np.delete(y, k).sum() for k in range(9)]
    jackknife = np.sqrt(8 / 9 * sum((v - m) ** 2 for v in without))
    counts = np.random.default_rng(7).multinomial(9, np.full(9, 1 / 9), size=500)
    rows = [np.repeat(np.arange(9), draw) for draw in counts]
    c = np.quantile(_studentize_loop([(x[r, 0], y[r, 0]) for r in rows], m, linear), 0.95)
    # The upper limit's draws have log-normal noise of mean 1.
    rate = (x / y)[:, 0]
    sd = 2.2 * 9**-0.2 * min(np.sqrt(np.log(1 + (rate.std(ddof=1) / rate.mean()) ** 2)), 1)
    sd = np.ceil(sd / 0.1) * 0.1
    generator = np.random.default_rng((7, 1))
    drawn, z = generator.integers(0, 9, (500, 9)), generator.standard_normal((500, 9))
    smoothed = [(x[r, 0] * np.exp(sd * e - sd**2 / 2), y[r, 0]) for r, e in zip(drawn, z)]
    c_high = np.quantile(_studentize_loop(smoothed, m, linear), 0.95)
    assert c_high > c
    assert result.low[0] == pytest.approx(max(m - c * jackknife, 0))
    assert result.high[0] == pytest.approx(m + c_high * jackknife)


def test_participants_are_the_sampling_unit():
    # 4 participants with thousands of equal samples are as uncertain as 4 numbers.
    x = np.array([[0.1], [0.2], [0.3], [0.4]])
    result = estimate_ratios(x, ONES(x.shape))
    assert result.low[0] < 0.13 and result.high[0] > 0.37


def test_too_few_participants_have_no_interval():
    x = np.array([[0.0, 0.2, 0.3], [0.0, 0.2, 0.1], [0.0, 0.2, 0.0], [0.0, 0.2, 0.0]])
    y = np.array([[1.0, 1, 1], [1, 1, 1], [1, 1, 0], [1, 1, 0]])
    result = estimate_ratios(x, y)
    assert result.value == pytest.approx([0, 0.2, 0.2]) and result.participants.tolist() == [4, 4, 2]
    assert np.isnan(result.low).all() and np.isnan(result.high).all()
    empty = estimate_ratios(np.zeros((0, 2)), np.zeros((0, 2)))
    assert np.isnan(empty.value).all() and empty.participants.tolist() == [0, 0]
    one = estimate_ratios(ONES((1, 1)), ONES((1, 1)))
    assert one.value == 1 and np.isnan(one.low).all()


def test_paired_difference_matches_mean_of_differences():
    rng = np.random.default_rng(2)
    base = rng.normal(10, 5, (40, 1))
    after = base + rng.normal(1, 0.1, (40, 1))
    y = ONES((40, 1))
    same = estimate_ratio_differences((base, y), (after, y))
    assert same.value == pytest.approx((after - base).mean()) and same.high - same.low < 0.1 and same.p < 0.01
    # For different participants the interval is as wide as their spread.
    x = np.concatenate([base, 0 * after])
    z = np.concatenate([0 * base, after])
    offset = estimate_ratio_differences((x, np.concatenate([y, 0 * y])), (z, np.concatenate([0 * y, y])))
    welch = stats.ttest_ind(after[:, 0], base[:, 0], equal_var=False)
    assert offset.value == pytest.approx(same.value)
    assert offset.high - offset.low == pytest.approx(np.ptp(welch.confidence_interval()), rel=0.15)
    assert offset.p == pytest.approx(welch.pvalue, abs=0.08)


def test_false_positive_rate_of_ratio_differences():
    rng = np.random.default_rng(3)
    x = rng.exponential(1, (24, 600))
    first, second = np.zeros((24, 600)), np.zeros((24, 600))
    first[:12], second[12:] = 1, 1
    result = estimate_ratio_differences((x * first, first), (x * second, second), resamples=399)
    assert 0.01 < (result.p <= 0.05).mean() < 0.09
    assert 0.92 < ((result.low <= 0) & (result.high >= 0)).mean() <= 0.995
    # An interval excludes 0 when the p-value is below 0.05, up to the resolution of the p-value.
    outside = (result.low > 0) | (result.high < 0)
    assert (outside == (result.p <= 0.05))[abs(result.p - 0.05) > 0.005].all() and outside.any()


def test_coverage_for_few_participants():
    # Shares of time of eight participants, far from normal, on AOIs that half of them look at for long.
    rng = np.random.default_rng(4)
    y = rng.gamma(3, 1, (8, 1200))
    x = y * rng.beta(0.5, 2, (8, 1200))
    truth = 0.5 / 2.5
    result = estimate_ratios(x, y, resamples=399)
    assert 0.92 < ((result.low <= truth) & (truth <= result.high)).mean() < 0.99
    # Student's t of the linearised residuals has lower coverage.
    m = x.sum(axis=0) / y.sum(axis=0)
    s = np.sqrt(((x - m * y) ** 2).sum(axis=0) * 8 / 7) / y.sum(axis=0)
    assert (abs(m - truth) <= stats.t.ppf(0.975, 7) * s).mean() < 0.92


@pytest.mark.parametrize("hit_ratio", [1.0, 0.4])
def test_coverage_of_heavy_tails(hit_ratio):
    """Log-normal values of 16 participants whose logarithm has the standard deviation 1.5, of mean 1."""
    rng = np.random.default_rng(12)
    x = np.exp(rng.normal(-1.125, 1.5, (16, 1500))) * (rng.random((16, 1500)) < hit_ratio)
    result = estimate_ratios(x, ONES(x.shape), resamples=399)
    has_interval = np.isfinite(result.low)
    covered = (result.low <= hit_ratio) & (hit_ratio <= result.high)
    assert 0.91 < covered[has_interval].mean() < 0.98
    m, s = x.mean(axis=0), x.std(axis=0, ddof=1) / 4
    assert (abs(m - hit_ratio) <= stats.t.ppf(0.975, 15) * s).mean() < 0.85


def test_upper_limit_of_similar_participants_is_hardly_higher():
    x = np.random.default_rng(13).gamma(100, 0.01, (16, 300))
    result = estimate_ratios(x, ONES(x.shape), resamples=399)
    ratio = (result.high - result.value) / (result.value - result.low)
    assert 1.0 - 1e-9 < ratio.min() and ratio.mean() < 1.1


def test_partly_paired_participants():
    # Variances add for independent participants; for paired ones the variance of the differences counts.
    rng = np.random.default_rng(6)
    x, u, none, one = rng.gamma(2, 1, (9, 1)), rng.gamma(3, 1, (14, 1)), np.zeros, ONES
    first = (np.concatenate([x, none((14, 1))]), np.concatenate([one((9, 1)), none((14, 1))]))
    second = (np.concatenate([none((9, 1)), u]), np.concatenate([none((9, 1)), one((14, 1))]))
    offset = estimate_ratio_differences(first, second, resamples=4000)
    welch = stats.ttest_ind(u[:, 0], x[:, 0], equal_var=False)
    half = np.ptp(welch.confidence_interval()) / 2
    assert (offset.high - offset.low) / 2 == pytest.approx(half, rel=0.2)
    same = estimate_ratio_differences((x, one((9, 1))), (u[:9], one((9, 1))), resamples=4000)
    paired = stats.ttest_rel(u[:9, 0], x[:, 0])
    assert (same.high - same.low) / 2 == pytest.approx(np.ptp(paired.confidence_interval()) / 2, rel=0.2)
    assert same.value == pytest.approx((u[:9] - x).mean())


def test_equal_seeds_give_equal_intervals():
    x = np.random.default_rng(5).random((12, 3))
    a, b = estimate_ratios(x, ONES(x.shape), seed=4), estimate_ratios(x, ONES(x.shape), seed=4)
    assert np.array_equal(a.low, b.low) and not np.array_equal(a.low, estimate_ratios(x, ONES(x.shape), seed=5).low)


def test_two_contributors_give_no_interval():
    x = np.zeros((40, 2))
    x[:2, 0], x[:3, 1] = 1, 1
    result = estimate_ratios(x, ONES(x.shape), resamples=99)
    assert result.value == pytest.approx([0.05, 0.075]) and result.participants.tolist() == [40, 40]
    assert np.isnan(result.low[0]) and np.isnan(result.high[0]) and result.high[1] > 0.075


def test_dominated_estimates_use_students_t():
    """Time-weighted means of a few of 40 participants: most are near, and distant ones look for long."""
    rng = np.random.default_rng(8)
    visits = rng.random((40, 800)) < 0.17
    far = rng.random(visits.shape) < 0.1
    y = visits * np.where(far, 1.0, 0.3) * rng.gamma(2, 1, visits.shape)
    x = y * np.where(far, 4.0, 1.0)
    truth = (0.1 * 4 + 0.9 * 0.3) / (0.1 + 0.9 * 0.3)
    held = lambda e: ((e.low <= truth) & (truth <= e.high))[np.isfinite(e.low)].mean()
    result = estimate_ratios(x, y, resamples=199)
    # With small weights for the other participants, the estimate no longer concerns few of them.
    by_draws = estimate_ratios(x, np.where(visits, y, 1e-9), resamples=199)
    assert held(by_draws) < 0.8 and held(result) > held(by_draws) + 0.05


def test_difference_from_one_contributor_has_no_interval():
    # Ten participants against ten others. All contribute to the first estimate; 1, 2, 3, 10 and 0 to the second.
    rng = np.random.default_rng(9)
    first, second = np.repeat([[1.0], [0]], 10, axis=0), np.repeat([[0.0], [1]], 10, axis=0)
    x, u = rng.gamma(2, 1, (20, 5)) * first, rng.gamma(2, 1, (20, 5)) * second
    for k, some in enumerate((1, 2, 3, 10, 0)):
        u[10 + some :, k] = 0
    pair = lambda v, who: (v, np.repeat(who, 5, axis=1))
    for a, b in ((pair(x, first), pair(u, second)), (pair(u, second), pair(x, first))):
        result = estimate_ratio_differences(a, b, resamples=199)
        assert np.isfinite(result.value).all()
        for ends in (result.low, result.high, result.p):
            assert np.isfinite(ends).tolist() == [False, False, True, True, False]
    # The same participants, with one, two or no contributions to the second estimate, in both orders.
    before, after, expected = x[:10], np.zeros((10, 5)), ONES((10, 5))
    for some in (1, 2):
        after[:some] = 1
        assert np.isnan(estimate_ratio_differences((before, expected), (after, expected), resamples=199).low).all()
    gone = estimate_ratio_differences((before, expected), (0 * after, expected), resamples=199)
    alone = estimate_ratios(before, expected, resamples=199)
    assert gone.value == pytest.approx(-alone.value) and gone.low == pytest.approx(-2 * alone.value - gone.high)
    assert (gone.high < 0).all() and (gone.p <= 0.05).all()
    two = estimate_ratio_differences((after, expected), (0 * after, expected), resamples=199)
    assert np.isnan(two.low).all() and np.isnan(two.p).all()


def test_groups_are_resampled_separately():
    """Against a loop: each group is resampled to its own size, independent of the other one."""
    rng, few, many, resamples = np.random.default_rng(10), 4, 30, 300
    n = few + many
    first = (np.arange(n) < few).astype(float)[:, None]
    x, u = rng.gamma(2, 1, (n, 1)) * first, rng.gamma(3, 1, (n, 1)) * (1 - first)
    result = estimate_ratio_differences((x, first), (u, 1 - first), resamples=resamples, seed=3)
    sides = x[:few, 0], u[few:, 0]
    error = lambda v: v.std(ddof=1) ** 2 / len(v)
    value, whole_result = sides[1].mean() - sides[0].mean(), error(sides[0]) + error(sides[1])
    draws, t = np.random.default_rng(3), []
    counts = [draws.multinomial(len(v), np.full(len(v), 1 / len(v)), size=resamples) for v in sides]
    for one, two in zip(*counts):
        a, b = (np.repeat(v, k) for v, k in zip(sides, (one, two)))
        spread = a.var() / (few - 1) + b.var() / (many - 1)
        t.append(abs(b.mean() - a.mean() - value) / np.sqrt(0.99 * spread + 0.01 * whole_result))
    extent = np.quantile(t, 0.95) * np.sqrt(whole_result)
    assert result.value[0] == pytest.approx(value)
    assert result.low[0] == pytest.approx(value - extent) and result.high[0] == pytest.approx(value + extent)
    assert result.p[0] == pytest.approx((1 + sum(v >= value / np.sqrt(whole_result) for v in t)) / (resamples + 1))


@pytest.mark.parametrize("resamples", [9, 99, 399])
def test_p_value_is_limited_by_the_number_of_draws(resamples):
    rng = np.random.default_rng(11)
    x = rng.random((12, 5))
    result = estimate_ratio_differences(
        (x, ONES(x.shape)), (x + 100 + rng.random(x.shape), ONES(x.shape)), resamples=resamples
    )
    assert result.p == pytest.approx(1 / (resamples + 1))


def test_minimum_number_of_participants():
    x = np.array([[0.1], [0.2], [0.4]])
    assert (
        np.isfinite(estimate_ratios(x, ONES(x.shape)).low).all()
        and np.isnan(estimate_ratios(x[:2], ONES((2, 1))).low).all()
    )


def test_half_of_the_participants_count_as_few():
    """Twenty of forty, whose weights differ, have Student's t of the effective number of them; of thirty-nine they are
    more than half."""
    rng = np.random.default_rng(7)
    far = rng.random(20) < 0.1
    y = np.where(far, 1.0, 0.3) * rng.gamma(2, 1, 20)
    x = y * np.where(far, 4.0, 1.0)
    without = np.array([np.delete(x, k).sum() / np.delete(y, k).sum() for k in range(20)])
    parts = (x.sum() / y.sum() - without) * np.sqrt(19 / 20)
    people = (parts**2).sum() ** 2 / (parts**4).sum()
    minimum = stats.t.ppf(0.975, max(people - 1, 1.0)) * np.sqrt((parts**2).sum())
    extent = []
    for remaining in (20, 19):
        result = estimate_ratios(*(np.pad(v, (0, remaining))[:, None] for v in (x, y)), resamples=199)
        extent.append(result.high[0] - result.value[0])
    assert extent[0] == pytest.approx(minimum) and extent[1] < 0.9 * minimum


def test_shared_participants_are_drawn_together():
    """Against a loop: shared variation of paired participants also cancels in each draw."""
    rng, n, resamples = np.random.default_rng(12), 10, 300
    x = rng.gamma(2, 1, (n, 1))
    u = x + rng.normal(0.3, 0.1, (n, 1))
    result = estimate_ratio_differences((x, ONES(x.shape)), (u, ONES(x.shape)), resamples=resamples, seed=4)
    offset = (u - x)[:, 0]
    error, value, t = offset.std(ddof=1) / np.sqrt(n), offset.mean(), []
    for draw in np.random.default_rng(4).multinomial(n, np.full(n, 1 / n), size=resamples):
        star = np.repeat(offset, draw)
        t.append(abs(star.mean() - value) / np.sqrt(0.99 * star.var() / (n - 1) + 0.01 * error**2))
    assert result.high[0] - value == pytest.approx(np.quantile(t, 0.95) * error, rel=1e-6)


# ---- Proportions and their differences ----

P = np.linspace(0.001, 0.999, 999)


def column(k, n):
    return np.array([[1.0]] * k + [[0.0]] * (n - k)), np.ones((n, 1))


def test_mid_p_limits_match_binomial_tails():
    for k, n in ((1, 3), (3, 10), (9, 10), (17, 200), (0, 8), (8, 8)):
        (low,), (high,) = mid_p_interval(np.array([k]), np.array([n]))
        below, at = stats.binom.cdf(k - 1, n, high), stats.binom.pmf(k, n, high)
        assert high == 1 if k == n else below + at / 2 == pytest.approx(0.025, abs=1e-9)
        above, at = stats.binom.sf(k, n, low), stats.binom.pmf(k, n, low)
        assert low == 0 if k == 0 else above + at / 2 == pytest.approx(0.025, abs=1e-9)
    # 0 of 8: half of (1 - p)^8 is 0.025.
    assert mid_p_interval(np.array([0]), np.array([8]))[1] == pytest.approx(1 - 0.05 ** (1 / 8))


@pytest.mark.parametrize("n", [3, 5, 8, 16, 40])
def test_mid_p_coverage(n):
    k = np.arange(n + 1)
    low, high = mid_p_interval(k, np.full(n + 1, n))
    inside = (low[:, None] <= P) & (P <= high[:, None])
    held = (stats.binom.pmf(k[:, None], n, P) * inside).sum(axis=0)
    assert held.min() > 0.92 and held.mean() < 0.99


def test_proportions_of_a_subset():
    x = np.array([[1.0, 0, 1, 0], [1, 0, 1, 1], [0, 0, 1, 0], [0, 0, 1, 0]])
    y = np.array([[1.0, 1, 1, 0], [1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 0]])
    result = estimate_proportions(x, y)
    assert result.value.tolist() == [0.5, 0, 1, 0.5] and result.participants.tolist() == [4, 4, 4, 2]
    assert result.low[1] == 0 and result.high[2] == 1 and result.high[1] > 0.4 and result.low[2] < 0.6
    assert np.isnan([result.low[3], result.high[3]]).all()


def test_independent_proportion_differences():
    # 2 of 12 and 9 of 15: the formula of Agresti and Caffo.
    (x, y), (u, v) = column(2, 12), column(9, 15)
    none = np.zeros
    first = (np.concatenate([x, none((15, 1))]), np.concatenate([y, none((15, 1))]))
    second = (np.concatenate([none((12, 1)), u]), np.concatenate([none((12, 1)), v]))
    result = estimate_proportion_differences(first, second)
    a, b = 3 / 14, 10 / 17
    s = np.sqrt(a * (1 - a) / 14 + b * (1 - b) / 17)
    assert result.value == pytest.approx(9 / 15 - 2 / 12)
    assert result.low == pytest.approx(b - a - 1.959964 * s) and result.high == pytest.approx(b - a + 1.959964 * s)
    assert result.p == pytest.approx(2 * stats.norm.sf((b - a) / s))


def test_paired_proportion_differences():
    # Bonett and Price: of 20 participants 9 do both, 1 only the first, 6 only the second.
    x = np.array([[1.0]] * 10 + [[0.0]] * 10)
    u = np.array([[1.0]] * 9 + [[0.0]] + [[1.0]] * 6 + [[0.0]] * 4)
    ones = np.ones((20, 1))
    result = estimate_proportion_differences((x, ones), (u, ones))
    alone, also = 2 / 22, 7 / 22
    s = np.sqrt((alone + also - (also - alone) ** 2) / 22)
    assert result.low == pytest.approx(also - alone - 1.959964 * s)
    assert result.high == pytest.approx(also - alone + 1.959964 * s)
    # Positive correlation of paired participants makes the interval narrower.
    offset = estimate_proportion_differences(
        (np.concatenate([x, 0 * x]), np.concatenate([ones, 0 * ones])),
        (np.concatenate([0 * u, u]), np.concatenate([0 * ones, ones])),
    )
    assert result.high - result.low < 0.9 * (offset.high - offset.low)


def test_false_positive_rate_of_proportion_differences():
    # All outcomes of 8 against 8 with equal probability.
    k = np.arange(9)
    a, b = (v.ravel() for v in np.meshgrid(k, k, indexing="ij"))
    spread = lambda counts: (np.arange(8)[:, None] < counts).astype(float)
    actual = np.concatenate([np.ones((8, 81)), np.zeros((8, 81))])
    none = np.zeros((8, 81))
    first, second = np.concatenate([spread(a), none]), np.concatenate([none, spread(b)])
    result = estimate_proportion_differences((first, actual), (second, 1 - actual))
    assert ((result.p <= 0.05) == ((result.low > 0) | (result.high < 0))).all()
    weight = stats.binom.pmf(a[:, None], 8, P) * stats.binom.pmf(b[:, None], 8, P)
    assert 0.03 < (weight * (result.p <= 0.05)[:, None]).sum(axis=0).max() < 0.06


def test_proportions_of_few_participants():
    result = estimate_proportion_differences(column(1, 2), column(1, 2))
    assert np.isnan([result.low, result.high, result.p]).all() and result.value == 0
    empty = estimate_proportions(np.zeros((0, 2)), np.zeros((0, 2)))
    assert np.isnan(empty.value).all() and np.isnan(empty.high).all() and empty.participants.tolist() == [0, 0]


@pytest.mark.parametrize("m, n, expected", [(3, 3, True), (2, 3, False), (3, 2, False)])
def test_three_participants_are_needed_for_an_interval(m, n, expected):
    result = estimate_proportions(*column(1, m))
    assert np.isfinite(result.low).all() == np.isfinite(result.high).all() == (m == 3)
    first, second = np.r_[np.ones(m), np.zeros(n)][:, None], np.r_[np.zeros(m), np.ones(n)][:, None]
    difference = estimate_proportion_differences((first * 0, first), (second, second))
    assert [np.isfinite(v).all() for v in (difference.low, difference.high, difference.p)] == [expected] * 3
