"""Estimates with 95 % confidence intervals over participants: ratios, proportions, and their differences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

# ---- Estimates and differences ----

MIN_FOR_INTERVAL = 3
"""Minimum number of participants, and of those with non-zero values, for a confidence interval."""


@dataclass(frozen=True)
class Estimates:
    """K estimates with the limits of their confidence intervals, NaN if there is none, and the number of
    participants of each."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    participants: np.ndarray


@dataclass(frozen=True)
class Differences:
    """K differences with the limits of their confidence intervals and two-sided p-values."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    p: np.ndarray


def adjust_p_values(p: np.ndarray) -> np.ndarray:
    """Adjust p-values (K,) for the false discovery rate by the procedure of Benjamini and Hochberg (1995); NaN
    values are ignored and stay NaN."""
    from scipy.stats import false_discovery_control

    out = np.array(p, float)
    is_tested = np.isfinite(out)
    out[is_tested] = false_discovery_control(out[is_tested])
    return out


# ---- Ratios ----
#
# 95 % confidence intervals that treat participants, not gaze samples, as the sampling unit. Proportions of participants
# have their own intervals (`estimate_proportions`).
#
# Each estimate is a ratio of sums over participants, m = Σ x_p / Σ y_p. With y_p = 1 it is a mean; with y_p in {0, 1}
# it is a mean over a subset. Its standard error s is the jackknife's, which leaves out one participant at a time (Tukey
# 1958; the most reliable one for few clusters according to MacKinnon, Nielsen and Webb 2023); for a mean it equals the
# usual standard error. The interval is m ± c s, with c from the symmetric bootstrap-t over participants (Hall 1988):
# participants are drawn with replacement, t* = |m* - m| / s*, and c is the 95 % quantile of t*. For few participants it
# is more accurate than an interval with two tails of 2.5 % each. The p-value uses the same draws: it is the fraction of
# t* that are at least the t of the data. s* is the standard error of the linearised residuals x_p - m* y_p (Cochran
# 1977, section 6.4), shrunk towards that of the data, s*² <- (1 - λ) s*² + λ s², similar to the constant of Tusher et
# al. (2001). Without shrinkage, draws with hardly any spread would make the interval arbitrarily wide for few
# participants.
#
# Shares of attention are skewed: a sample without any of the few participants who look for long has a low estimate and
# a low standard error, and its draws cannot contain them. The upper limit is therefore m + c' s, where c' >= c is the
# quantile for draws of a smoothed bootstrap (Silverman and Young 1987; Polansky and Schucany 1997): each drawn x_p is
# multiplied by log-normal noise of mean 1, which extends the tail in proportion to the values. The standard deviation
# of the noise's logarithm is 2.2 n^(-1/5) times the smaller of 1 and that of a log-normal distribution with the
# coefficient of variation that x_p / y_p has over the n participants with x_p > 0. If participants vary little, c' is
# close to c.
#
# An estimate with fewer than three non-zero contributions has no interval. A difference from such an estimate has none
# either, except that a difference from zero over the same participants is allowed if none of them contributes to one of
# the estimates. If an estimate concerns at most half of the participants with unequal weights y_p, such as the mean
# distance to a rarely visited AOI, one or two participants may dominate it. In this case c is at least the quantile of
# Student's t with n - 1 degrees of freedom, where n = (Σ j²)² / Σ j⁴ is the effective number of participants (Kish
# 1965, section 8.2) for their jackknife contributions j_p.

RESAMPLES = 1999  # draws of participants
SHRINKAGE = 0.01  # shrinkage λ of the bootstrap's standard error
BANDWIDTH = 2.2  # bandwidth of the smoothed draws, relative to n**-0.2 times the spread of n contributors
_MAX_SPREAD = 1.0  # limit of that spread: a sample that shows its tail has a large standard error already
_NOISE_STEP = 0.1  # the standard deviation of the noise is rounded up to a multiple, so that areas share draws
_CONFIDENCE = 0.95
_MAX_DRAWS = 1 << 22
Pair = tuple[np.ndarray, np.ndarray]


def estimate_ratios(
    x: np.ndarray, y: np.ndarray, *, resamples: int = RESAMPLES, seed: int = 0, upper_limit: float = np.inf
) -> Estimates:
    """Estimate Σ x / Σ y over P participants for K quantities.

    Parameters
    ----------
    x, y
        Numerators and denominators, (P, K) each, x >= 0 and y >= 0.
    resamples
        Number of bootstrap draws.
    seed
        Seed of the draws.
    upper_limit
        Intervals are clipped to the range from 0 to this value.
    """
    value, residual, num_participants = _linearize(x, y)
    jackknife = _jackknife(x, y, value, num_participants)
    linear_error, error = _standard_error(residual, num_participants), _standard_error(jackknife, num_participants)
    needs_student = (num_participants <= len(x) / 2) & (
        np.where(y > 0, y, np.inf).min(axis=0, initial=np.inf) < y.max(axis=0, initial=0)
    )
    min_quantile = np.where(needs_student, _student_quantile(jackknife), 0.0)
    factor = _bessel_factor(num_participants)
    t = np.full((resamples, x.shape[1]), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        for part, w in _iter_draws(len(x), resamples, seed, np.zeros(len(x), int)):
            m, variance = _weighted_moments(w, x, y)
            t[part] = _studentize(m - value, variance * factor, linear_error)
    c = np.where(
        (x != 0).sum(axis=0) >= MIN_FOR_INTERVAL, np.maximum(_bootstrap_quantile(t, error), min_quantile), np.nan
    )
    c_high = np.fmax(c, _smoothed_quantile(x, y, value, (linear_error, error), resamples, seed))
    low, high = value - c * error, value + c_high * error
    return Estimates(value, np.clip(low, 0.0, upper_limit), np.clip(high, 0.0, upper_limit), num_participants)


def estimate_ratio_differences(first: Pair, second: Pair, *, resamples: int = RESAMPLES, seed: int = 0) -> Differences:
    """Estimate differences of ratios, Σ x / Σ y of ``second`` minus that of ``first``.

    Both are pairs of arrays (P, K) over the same P participants, with y = 0 for participants without data. Participants
    with data in both are drawn together.
    """
    (x, y), (u, v) = first, second
    (a, ra, na), (b, rb, nb) = _linearize(x, y), _linearize(u, v)
    value, n = b - a, np.minimum(na, nb)
    # Differences of the contributions: shared variation of participants in both cancels.
    linear_error, error = (
        _standard_error(rb - ra, n),
        _standard_error(_jackknife(u, v, b, nb) - _jackknife(x, y, a, na), n),
    )
    factor_a, factor_b = _bessel_factor(na), _bessel_factor(nb)
    strata = (y > 0).any(axis=1).astype(int) + 2 * (v > 0).any(axis=1).astype(int)
    t = np.full((resamples, x.shape[1]), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        for part, w in _iter_draws(len(x), resamples, seed, strata):
            ma, sa = _weighted_moments(w, x, y)
            mb, sb = _weighted_moments(w, u, v)
            # Covariance of the residuals, from participants in both.
            cross = w @ (x * u) - ma * (w @ (y * u)) - mb * (w @ (x * v)) + ma * mb * (w @ (y * v))
            cross *= 2 * np.sqrt(factor_a * factor_b) / ((w @ y) * (w @ v))
            t[part] = _studentize(mb - ma - value, np.maximum(factor_a * sa + factor_b * sb - cross, 0.0), linear_error)
    contributors_first, contributors_second = (x != 0).sum(axis=0), (u != 0).sum(axis=0)
    # If an estimate has no contributions, it is 0 for every participant; the difference then needs participants in
    # both.
    contributors_both = (((x != 0) | (u != 0)) & (y > 0) & (v > 0)).sum(axis=0)
    is_sufficient = (
        np.minimum(
            np.where(contributors_first, contributors_first, contributors_both),
            np.where(contributors_second, contributors_second, contributors_both),
        )
        >= MIN_FOR_INTERVAL
    )
    half_width = np.where(is_sufficient, _bootstrap_quantile(t, error) * error, np.nan)
    low, high = value - half_width, value + half_width
    with np.errstate(divide="ignore", invalid="ignore"):
        is_as_extreme = t >= np.abs(value / error)
    p = np.where(np.isfinite(low), (is_as_extreme.sum(axis=0) + 1) / (np.isfinite(t).sum(axis=0) + 1), np.nan)
    # Without spread in either estimate, equal values have p = 1; the p-value of different values is undefined.
    return Differences(value, low, high, np.where(error == 0, np.where(value == 0, 1.0, np.nan), p))


def _linearize(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the ratios (K,), each participant's contribution to their linearised error (P, K), and the number of
    participants with y > 0 (K,)."""
    num_participants, total = (y > 0).sum(axis=0), y.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.where(total > 0, x.sum(axis=0) / total, np.nan)
        return value, (x - value * y) / total * np.sqrt(_bessel_factor(num_participants)), num_participants


def _jackknife(x: np.ndarray, y: np.ndarray, value: np.ndarray, num_participants: np.ndarray) -> np.ndarray:
    """Return each participant's contribution to the jackknife's error (P, K): the decrease of the ratio without the
    participant."""
    with np.errstate(divide="ignore", invalid="ignore"):
        without = (x.sum(axis=0) - x) / (y.sum(axis=0) - y)
        return np.where(y > 0, (value - without) / np.sqrt(_bessel_factor(num_participants)), 0.0)


def _bessel_factor(num_participants: np.ndarray) -> np.ndarray:
    """n / (n - 1)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return num_participants / (num_participants - 1.0)


def _standard_error(parts: np.ndarray, num_participants: np.ndarray) -> np.ndarray:
    """Return the standard error (K,) of a sum of independent ``parts`` (P, K), NaN for too few participants."""
    return np.where(num_participants >= MIN_FOR_INTERVAL, np.sqrt((parts**2).sum(axis=0)), np.nan)


def _studentize(deviation: np.ndarray, variance: np.ndarray, standard_error: np.ndarray) -> np.ndarray:
    return np.abs(deviation) / np.sqrt((1 - SHRINKAGE) * variance + SHRINKAGE * standard_error**2)


def _draw_counts(rng: np.random.Generator, strata: np.ndarray, resamples: int) -> np.ndarray:
    """Return how often each participant is drawn (B, P); the size of each stratum in ``strata`` (P,) is preserved."""
    out = np.zeros((resamples, len(strata)))
    for k in np.unique(strata):
        members = np.flatnonzero(strata == k)
        out[:, members] = rng.multinomial(len(members), np.full(len(members), 1 / len(members)), size=resamples)
    return out


def _iter_draws(
    num_participants: int, resamples: int, seed: int, strata: np.ndarray
) -> Iterator[tuple[slice, np.ndarray]]:
    rng = np.random.default_rng(seed)
    block_size = max(1, min(resamples, _MAX_DRAWS // max(num_participants, 1)))
    for a in range(0, resamples, block_size):
        yield slice(a, min(a + block_size, resamples)), _draw_counts(rng, strata, min(block_size, resamples - a))


def _weighted_moments(
    w: np.ndarray, x: np.ndarray, y: np.ndarray, wx: np.ndarray | None = None, wxx: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ratios of the draws, and the sums of squared residuals over the squared sum of y, (B, K) each. ``wx``
    and ``wxx`` are the weights (B, P) of x and of its square; None: ``w``."""
    wx, wxx = w if wx is None else wx, w if wxx is None else wxx
    sx, sy = wx @ x, w @ y
    with np.errstate(divide="ignore", invalid="ignore"):
        m = sx / sy
        variance = (wxx @ x**2 - 2 * m * (wx @ (x * y)) + m**2 * (w @ y**2)) / sy**2
    return m, np.maximum(variance, 0.0)


def _student_quantile(parts: np.ndarray) -> np.ndarray:
    """Return the quantile of Student's t (K,) for the effective number of participants in ``parts`` (P, K)."""
    from scipy.special import stdtrit

    with np.errstate(divide="ignore", invalid="ignore"):
        effective_size = (parts**2).sum(axis=0) ** 2 / (parts**4).sum(axis=0)
    return stdtrit(np.maximum(effective_size - 1, 1.0), (1 + _CONFIDENCE) / 2)


def _bootstrap_quantile(t: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return the factor c (K,) from the draws ``t`` (B, K); NaN without variation, for example without any visit."""
    finite_fraction = np.isfinite(t).mean(axis=0) if len(t) else np.zeros(error.shape)
    all_finite, mostly_finite = (
        (finite_fraction == 1) & (error > 0),
        (finite_fraction >= 0.9) & (finite_fraction < 1) & (error > 0),
    )
    quantile = np.full(error.shape, np.nan)
    quantile[all_finite] = np.quantile(t[:, all_finite], _CONFIDENCE, axis=0)
    for k in np.flatnonzero(mostly_finite):
        quantile[k] = np.quantile(t[np.isfinite(t[:, k]), k], _CONFIDENCE)
    return quantile


def _smoothed_quantile(
    x: np.ndarray, y: np.ndarray, value: np.ndarray, errors: tuple[np.ndarray, np.ndarray], resamples: int, seed: int
) -> np.ndarray:
    """Return the factor c (K,) from draws whose numerators are multiplied by log-normal noise; NaN without noise.

    ``errors`` are the linearised and the jackknife's standard error (K,).
    """
    num, factor, rng = len(x), _bessel_factor((y > 0).sum(axis=0)), np.random.default_rng((seed, 1))
    t, noise_sd = np.full((resamples, x.shape[1]), np.nan), np.ceil(_noise_sd(x, y) / _NOISE_STEP) * _NOISE_STEP
    block_size = max(1, min(resamples, _MAX_DRAWS // max(num, 1)))
    for a in range(0, resamples, block_size):
        shape = (min(block_size, resamples - a), num)
        bins, noise = rng.integers(0, num, shape) + num * np.arange(shape[0])[:, None], rng.standard_normal(shape)
        w = _sum_bins(bins, np.ones(shape))
        for sd in np.unique(noise_sd[noise_sd > 0]):
            k, scale = noise_sd == sd, np.exp(sd * noise - sd**2 / 2)  # of mean 1
            with np.errstate(divide="ignore", invalid="ignore"):
                m, variance = _weighted_moments(w, x[:, k], y[:, k], _sum_bins(bins, scale), _sum_bins(bins, scale**2))
                t[a : a + block_size, k] = _studentize(m - value[k], variance * factor[k], errors[0][k])
    return _bootstrap_quantile(t, errors[1])


def _sum_bins(bins: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the sum of the weights in each bin; bins, weights and sums have the same shape."""
    return np.bincount(bins.ravel(), weights.ravel(), weights.size).reshape(weights.shape)


def _noise_sd(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the standard deviation (K,) of the logarithm of the noise; 0 for fewer than three contributors."""
    rate, is_contributor = np.divide(x, y, out=np.zeros(x.shape), where=y > 0), x > 0
    n = is_contributor.sum(axis=0).astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = rate.sum(axis=0) / n
        variance = (np.where(is_contributor, rate - mean, 0.0) ** 2).sum(axis=0) / (n - 1)
        # A log-normal distribution has this standard deviation of the logarithm for the coefficient of variation.
        spread = np.minimum(np.sqrt(np.log1p(variance / mean**2)), _MAX_SPREAD)
        return np.where(n >= MIN_FOR_INTERVAL, BANDWIDTH * n**-0.2 * spread, 0.0)


# ---- Proportions ----
#
# Intervals of proportions of participants, and of their differences, that are accurate for few participants.
#
# The interval for x of n is the mid-p interval (Lancaster 1961): all π for which neither P(X > x) + P(X = x) / 2 nor
# its lower counterpart is below 0.025, with X binomial. Near π = 0 or 1, the coverage of Wilson's score interval drops
# below 84 % (Brown, Cai and DasGupta 2001), and that of the Clopper-Pearson interval is about 99 %. The mid-p interval
# covers at least 92 % for every π and n >= 3, and is 2 (n = 40) to 7 % (n = 8) wider than Wilson's (Agresti and Gottard
# 2007).
#
# Differences add one success and one failure to both samples, which makes Wald's interval accurate for few
# participants: for independent samples (Agresti and Caffo 2000), and for paired samples if the two additions have
# opposite outcomes (Bonett and Price 2012). If only some participants are in both samples, the covariance of the
# additions is interpolated between these two cases. Interval and p-value use the same statistic: p < 0.05 if and only
# if the interval excludes 0.

_ALPHA = 0.05
_Z = 1.959963984540054


def estimate_proportions(x: np.ndarray, y: np.ndarray) -> Estimates:
    """Estimate Σ x / Σ y with confidence intervals for binary ``x`` and ``y`` (P, K), x <= y."""
    num_participants = y.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = x.sum(axis=0) / num_participants
    low, high = mid_p_interval(x.sum(axis=0), num_participants)
    is_too_few = num_participants < MIN_FOR_INTERVAL
    return Estimates(
        value, np.where(is_too_few, np.nan, low), np.where(is_too_few, np.nan, high), num_participants.astype(int)
    )


def mid_p_interval(successes: np.ndarray, trials: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the limits (K,) of the mid-p interval of a probability, for ``successes`` (K,) out of ``trials`` (K,)."""
    x, n = np.asarray(successes, float), np.asarray(trials, float)
    return _lower_limit(x, n), 1.0 - _lower_limit(n - x, n)


def _lower_limit(x: np.ndarray, n: np.ndarray) -> np.ndarray:
    from scipy.special import betainc

    def tail_probability(k: np.ndarray, p: np.ndarray) -> np.ndarray:
        """P(X >= k)."""
        tail = betainc(np.maximum(k, 1), np.maximum(n - k + 1, 1), p)
        return np.where(k <= 0, 1.0, np.where(k > n, 0.0, tail))

    low, high = np.zeros(x.shape), np.ones(x.shape)
    for _ in range(50):
        middle = (low + high) / 2
        is_below = tail_probability(x, middle) + tail_probability(x + 1, middle) < _ALPHA
        low, high = np.where(is_below, middle, low), np.where(is_below, high, middle)
    return np.where(x > 0, low, 0.0)


def estimate_proportion_differences(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]
) -> Differences:
    """Estimate differences of proportions, that of ``second`` minus that of ``first``.

    Both are pairs of binary arrays (P, K) over the same P participants, with y = 0 for participants without data.
    """
    from scipy.special import ndtr

    (x, y), (u, v) = ([np.asarray(w, float) for w in pair] for pair in (first, second))
    m, n, num_both = y.sum(axis=0), v.sum(axis=0), (y * v).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = u.sum(axis=0) / n - x.sum(axis=0) / m
        a, b = (x.sum(axis=0) + 1) / (m + 2), (u.sum(axis=0) + 1) / (n + 2)
        # Covariance of the residuals; that of the added observations is weighted by the fraction of shared
        # participants.
        covariance_sum = ((x - a) * (u - b) * y * v).sum(axis=0) + num_both / np.maximum(m, n) * (2 * a * b - a - b)
        variance = a * (1 - a) / (m + 2) + b * (1 - b) / (n + 2) - 2 * covariance_sum / ((m + 2) * (n + 2))
        error = np.sqrt(np.maximum(variance, 0.0))
        p = 2 * ndtr(-np.abs(b - a) / error)
    low, high = np.maximum(b - a - _Z * error, -1.0), np.minimum(b - a + _Z * error, 1.0)
    is_too_few = (m < MIN_FOR_INTERVAL) | (n < MIN_FOR_INTERVAL)
    return Differences(value, *(np.where(is_too_few, np.nan, w) for w in (low, high, p)))
