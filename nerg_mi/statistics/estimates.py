"""Estimates with intervals of 95 %: of ratios by people drawn at random, of shares of people, and their differences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

# ---- Numbers with their 95 % intervals, their differences, and which of many differences are found ----

MIN_PARTICIPANTS = 3  # fewer people than these, or than these who add anything to a number, give no interval


@dataclass(frozen=True)
class Estimates:
    """K numbers with their intervals, NaN where there are none; ``people`` (K,): whom each concerns."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    participants: np.ndarray


@dataclass(frozen=True)
class Differences:
    """K differences with their intervals, and ``p``: how probable one so large is where there is none (two-sided)."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    p: np.ndarray


def adjust_p_values(p: np.ndarray) -> np.ndarray:
    """p-values (K,) adjusted by the procedure of Benjamini and Hochberg (1995): the least false discovery rate at which
    each is rejected; NaN stays NaN and counts for nothing."""
    from scipy.stats import false_discovery_control

    out = np.array(p, float)
    is_tested = np.isfinite(out)
    out[is_tested] = false_discovery_control(out[is_tested])
    return out


# ---- Intervals ----
#
# Intervals of 95 % that take people for what was drawn at random, not rays; shares of people have their own
# (`proportions`).
#
# Each number is a ratio of sums over people, m = Σ x_p / Σ y_p: a mean where y_p is 1, or 1 for those whom it concerns.
# Its standard error s is the jackknife's, which leaves out one person at a time (Tukey 1958; of clusters the most
# reliable one for few, MacKinnon, Nielsen and Webb 2023); of a mean it is the usual one. The interval is m ± c s, with
# c of the symmetric bootstrap-t over people (Hall 1988): people are drawn with replacement, t* = |m* - m| / s*, and c
# is the 95 % quantile of t*. For few people it errs by less than the one with two tails of 2.5 % each, and a p-value
# comes of the same: how often t* is at least that of the data. s* is that of the linearised residuals x_p - m* y_p
# (Cochran 1977, section 6.4), drawn towards that of the data, s*² <- (1 - λ) s*² + λ s² (as the constant of Tusher et
# al. 2001): some draws of few people have hardly any spread, and would make it endless.
#
# A number to which fewer than three people add anything has no interval, and no difference from it has one, but that of
# the same people from 0, to which none of them adds. Where a number concerns at most half of the people, and they weigh
# differently (y_p), as in the mean distance to what few look at, one or two of them may decide it: c is then at least
# that of Student's t of n - 1 degrees of freedom, n = (Σ j²)² / Σ j⁴ the effective number of people (Kish 1965, section
# 8.2) of what each one adds to the jackknife's error, j_p.

RESAMPLES = 1999  # draws of participants
TOWARDS = 0.01  # λ
_HELD = 0.95
_BLOCK = 1 << 22
Pair = tuple[np.ndarray, np.ndarray]


def estimate_ratios(
    x: np.ndarray, y: np.ndarray, *, resamples: int = RESAMPLES, seed: int = 0, upper_limit: float = np.inf
) -> Estimates:
    """Σ x / Σ y over P people of K numbers, (P, K) each, y >= 0; ``most``: no interval goes beyond it, or below 0."""
    value, residual, people = _linear(x, y)
    apart = _left_out(x, y, value, people)
    linear, error = _spread(residual, people), _spread(apart, people)
    few = (people <= len(x) / 2) & (np.where(y > 0, y, np.inf).min(axis=0, initial=np.inf) < y.max(axis=0, initial=0))
    least = np.where(few, _student(apart), 0.0)
    more = _more(people)
    t = np.full((resamples, x.shape[1]), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        for part, w in _blocks(len(x), resamples, seed, np.zeros(len(x), int)):
            m, square = _moments(w, x, y)
            t[part] = _studentised(m - value, square * more, linear)
    c = np.where((x != 0).sum(axis=0) >= MIN_PARTICIPANTS, np.maximum(_quantile(t, error), least), np.nan)
    low, high = value - c * error, value + c * error
    return Estimates(value, np.clip(low, 0.0, upper_limit), np.clip(high, 0.0, upper_limit), people)


def estimate_ratio_differences(first: Pair, second: Pair, *, resamples: int = RESAMPLES, seed: int = 0) -> Differences:
    """Σ x / Σ y of the ``second`` less that of the ``first``, each of arrays (P, K) over the same list of P people,
    with y = 0 for those who are not of it: people who are of both are drawn together."""
    (x, y), (u, v) = first, second
    (a, ra, na), (b, rb, nb) = _linear(x, y), _linear(u, v)
    value, n = b - a, np.minimum(na, nb)
    # What leaving somebody out does to both is subtracted, so that what is alike in them cancels.
    linear, error = _spread(rb - ra, n), _spread(_left_out(u, v, b, nb) - _left_out(x, y, a, na), n)
    more_a, more_b = _more(na), _more(nb)
    strata = (y > 0).any(axis=1).astype(int) + 2 * (v > 0).any(axis=1).astype(int)
    t = np.full((resamples, x.shape[1]), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        for part, w in _blocks(len(x), resamples, seed, strata):
            ma, sa = _moments(w, x, y)
            mb, sb = _moments(w, u, v)
            # Products of the two residuals, of people who are of both.
            cross = w @ (x * u) - ma * (w @ (y * u)) - mb * (w @ (x * v)) + ma * mb * (w @ (y * v))
            cross *= 2 * np.sqrt(more_a * more_b) / ((w @ y) * (w @ v))
            t[part] = _studentised(mb - ma - value, np.maximum(more_a * sa + more_b * sb - cross, 0.0), linear)
    adds, others = (x != 0).sum(axis=0), (u != 0).sum(axis=0)
    # A number to which nobody adds is 0 of each: of people who are of both, the difference is the other number.
    same = (((x != 0) | (u != 0)) & (y > 0) & (v > 0)).sum(axis=0)
    enough = np.minimum(np.where(adds, adds, same), np.where(others, others, same)) >= MIN_PARTICIPANTS
    reach = np.where(enough, _quantile(t, error) * error, np.nan)
    low, high = value - reach, value + reach
    with np.errstate(divide="ignore", invalid="ignore"):
        far = t >= np.abs(value / error)
    p = np.where(np.isfinite(low), (far.sum(axis=0) + 1) / (np.isfinite(t).sum(axis=0) + 1), np.nan)
    # No spread in either: the same, or beyond all doubt different, which nobody can tell from so few.
    return Differences(value, low, high, np.where(error == 0, np.where(value == 0, 1.0, np.nan), p))


def _linear(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The ratios (K,), what each person adds to their linear error (P, K), and how many people they concern (K,)."""
    people, total = (y > 0).sum(axis=0), y.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.where(total > 0, x.sum(axis=0) / total, np.nan)
        return value, (x - value * y) / total * np.sqrt(_more(people)), people


def _left_out(x: np.ndarray, y: np.ndarray, value: np.ndarray, people: np.ndarray) -> np.ndarray:
    """What each person adds to the jackknife's error (P, K): how far the ratios fall without them."""
    with np.errstate(divide="ignore", invalid="ignore"):
        without = (x.sum(axis=0) - x) / (y.sum(axis=0) - y)
        return np.where(y > 0, (value - without) / np.sqrt(_more(people)), 0.0)


def _more(people: np.ndarray) -> np.ndarray:
    """n / (n - 1)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return people / (people - 1.0)


def _spread(parts: np.ndarray, people: np.ndarray) -> np.ndarray:
    """Standard error (K,) of the sum of independent ``parts`` (P, K), NaN for few ``people`` (K,)."""
    return np.where(people >= MIN_PARTICIPANTS, np.sqrt((parts**2).sum(axis=0)), np.nan)


def _studentised(far: np.ndarray, square: np.ndarray, linear: np.ndarray) -> np.ndarray:
    return np.abs(far) / np.sqrt((1 - TOWARDS) * square + TOWARDS * linear**2)


def _draws(rng: np.random.Generator, strata: np.ndarray, resamples: int) -> np.ndarray:
    """How often each person is drawn (B, P), as many of each of the ``strata`` (P,) as there are."""
    out = np.zeros((resamples, len(strata)))
    for k in np.unique(strata):
        who = np.flatnonzero(strata == k)
        out[:, who] = rng.multinomial(len(who), np.full(len(who), 1 / len(who)), size=resamples)
    return out


def _blocks(people: int, resamples: int, seed: int, strata: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
    rng = np.random.default_rng(seed)
    each = max(1, min(resamples, _BLOCK // max(people, 1)))
    for a in range(0, resamples, each):
        yield slice(a, min(a + each, resamples)), _draws(rng, strata, min(each, resamples - a))


def _moments(w: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ratio and sum of squared residuals over the squared sum of y, of each draw (B, K)."""
    sx, sy = w @ x, w @ y
    with np.errstate(divide="ignore", invalid="ignore"):
        m = sx / sy
        square = (w @ x**2 - 2 * m * (w @ (x * y)) + m**2 * (w @ y**2)) / sy**2
    return m, np.maximum(square, 0.0)


def _student(parts: np.ndarray) -> np.ndarray:
    """Quantile of Student's t (K,) for the effective number of people of ``parts`` (P, K) of an error."""
    from scipy.special import stdtrit

    with np.errstate(divide="ignore", invalid="ignore"):
        people = (parts**2).sum(axis=0) ** 2 / (parts**4).sum(axis=0)
    return stdtrit(np.maximum(people - 1, 1.0), (1 + _HELD) / 2)


def _quantile(t: np.ndarray, error: np.ndarray) -> np.ndarray:
    """c (K,) of the draws ``t`` (B, K); NaN where nothing varies, such as where nobody looks."""
    known = np.isfinite(t).mean(axis=0) if len(t) else np.zeros(error.shape)
    every, some = (known == 1) & (error > 0), (known >= 0.9) & (known < 1) & (error > 0)
    found = np.full(error.shape, np.nan)
    found[every] = np.quantile(t[:, every], _HELD, axis=0)
    for k in np.flatnonzero(some):
        found[k] = np.quantile(t[np.isfinite(t[:, k]), k], _HELD)
    return found


# ---- Proportions ----
#
# Intervals of shares of people, of whom each counts as 0 or 1, and of their differences, that hold for few people.
#
# The interval of x of n is the mid-p one (Lancaster 1961): all π at which neither P(X > x) + P(X = x) / 2 nor its
# counterpart below is less than 0.025, X binomial. Wilson's score interval holds the truth less than 84 % of the time
# where π is near 0 or 1 (Brown, Cai and DasGupta 2001), Clopper and Pearson's 99 % of it; this one 92 % or more,
# whatever π and n >= 3, at widths that are 2 (n = 40) to 7 % (n = 8) above Wilson's (Agresti and Gottard 2007).
#
# A difference has one success and one failure added to both shares, which makes Wald's interval hold for few people: of
# others (Agresti and Caffo 2000), and of the same ones, where the two that are added are of opposite outcomes (Bonett
# and Price 2012). Of people some of whom are of both, these two are their covariance's ends. Interval and p-value are
# of one statistic: p < 0.05 where 0 is outside.

_ALPHA = 0.05
_Z = 1.959963984540054


def estimate_proportions(x: np.ndarray, y: np.ndarray) -> Estimates:
    """Σ x / Σ y of ``x`` and ``y`` (P, K) that are 0 or 1, x <= y, with their intervals."""
    people = y.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = x.sum(axis=0) / people
    low, high = mid_p_interval(x.sum(axis=0), people)
    few = people < MIN_PARTICIPANTS
    return Estimates(value, np.where(few, np.nan, low), np.where(few, np.nan, high), people.astype(int))


def mid_p_interval(successes: np.ndarray, trials: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends (K,) of the mid-p interval of a probability, of ``successes`` (K,) of as many ``trials``."""
    x, n = np.asarray(successes, float), np.asarray(trials, float)
    return _lower(x, n), 1.0 - _lower(n - x, n)


def _lower(x: np.ndarray, n: np.ndarray) -> np.ndarray:
    from scipy.special import betainc

    def above(k: np.ndarray, p: np.ndarray) -> np.ndarray:
        """P(X >= k)."""
        inside = betainc(np.maximum(k, 1), np.maximum(n - k + 1, 1), p)
        return np.where(k <= 0, 1.0, np.where(k > n, 0.0, inside))

    low, high = np.zeros(x.shape), np.ones(x.shape)
    for _ in range(50):
        middle = (low + high) / 2
        rare = above(x, middle) + above(x + 1, middle) < _ALPHA
        low, high = np.where(rare, middle, low), np.where(rare, high, middle)
    return np.where(x > 0, low, 0.0)


def estimate_proportion_differences(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]) -> Differences:
    """The share of the ``second`` less that of the ``first``, each of arrays (P, K) over the same list of P people,
    with y = 0 for those who are not of it."""
    from scipy.special import ndtr

    (x, y), (u, v) = ([np.asarray(w, float) for w in pair] for pair in (first, second))
    m, n, both = y.sum(axis=0), v.sum(axis=0), (y * v).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = u.sum(axis=0) / n - x.sum(axis=0) / m
        a, b = (x.sum(axis=0) + 1) / (m + 2), (u.sum(axis=0) + 1) / (n + 2)
        # Products of residuals, those of the two that are added as far as people are the same.
        shared = ((x - a) * (u - b) * y * v).sum(axis=0) + both / np.maximum(m, n) * (2 * a * b - a - b)
        square = a * (1 - a) / (m + 2) + b * (1 - b) / (n + 2) - 2 * shared / ((m + 2) * (n + 2))
        error = np.sqrt(np.maximum(square, 0.0))
        p = 2 * ndtr(-np.abs(b - a) / error)
    low, high = np.maximum(b - a - _Z * error, -1.0), np.minimum(b - a + _Z * error, 1.0)
    few = (m < MIN_PARTICIPANTS) | (n < MIN_PARTICIPANTS)
    return Differences(value, *(np.where(few, np.nan, w) for w in (low, high, p)))
