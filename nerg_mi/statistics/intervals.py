r"""Intervals of 95 % that take people for what was drawn at random, not rays.

Each number is a ratio of sums over people, m = Σ x_p / Σ y_p: a mean where y_p is 1, or 1 for those whom it concerns.
Its error comes from the linearised residuals ψ_p = (x_p - m y_p) / ȳ (Cochran 1977, section 6.4), which also serve for
differences between two such numbers of the same or of other people. The interval is the bootstrap-t over people (Efron
and Tibshirani 1993, chapter 12): people are drawn with replacement, t* = (m* - m) / s*, and the interval is
[m - t*_0.975 s, m - t*_0.025 s]. Its s* is drawn towards s, s*² <- (1 - λ) s*² + λ s² (as the constant of Tusher et al.
2001): with few people some draws have hardly any spread, and would make it endless. Shares of people, which are 0 or 1
for each, have Wilson's score interval (1927), and their differences Newcombe's (1998, method 10).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

LEAST_PEOPLE = 3
"""Fewer people than these give no interval."""

RESAMPLES = 1999
"""Draws of people."""

TOWARDS = 0.01
"""λ."""

_LOW, _HIGH = 0.025, 0.975
_BLOCK = 1 << 22
_Z = 1.959963984540054


@dataclass(frozen=True)
class Estimates:
    """K numbers with their intervals, NaN where there are none; ``people`` (K,): whom each concerns."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    people: np.ndarray


@dataclass(frozen=True)
class Differences:
    """K differences with their intervals, and ``p``: how probable one so large is where there is none (two-sided)."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    p: np.ndarray


def ratios(
    x: np.ndarray, y: np.ndarray, *, resamples: int = RESAMPLES, seed: int = 0, most: float = np.inf
) -> Estimates:
    """Σ x / Σ y over P people of K numbers, (P, K) each, y >= 0; ``most``: no interval goes beyond it, or below 0."""
    value, error, people = _ratio(x, y)
    low, high = _studentised(value, error, people, x, y, resamples, seed)
    clip = lambda v: np.clip(v, 0.0, most)
    return Estimates(value, clip(low), clip(high), people)


def proportions(x: np.ndarray, y: np.ndarray) -> Estimates:
    """The same of ``x`` and ``y`` (P, K) that are 0 or 1: Wilson's score interval."""
    people = y.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = x.sum(axis=0) / people
    low, high = wilson(x.sum(axis=0), people)
    few = people < LEAST_PEOPLE
    low, high = np.minimum(low, value), np.maximum(high, value)
    return Estimates(value, np.where(few, np.nan, low), np.where(few, np.nan, high), people.astype(int))


def wilson(successes: np.ndarray, trials: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wilson's score interval of a probability."""
    n = np.asarray(trials, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        p = successes / n
        middle = (p + _Z**2 / (2 * n)) / (1 + _Z**2 / n)
        half = _Z / (1 + _Z**2 / n) * np.sqrt(p * (1 - p) / n + _Z**2 / (4 * n * n))
    return np.maximum(middle - half, 0.0), np.minimum(middle + half, 1.0)


def ratio_differences(
    first: tuple[np.ndarray, np.ndarray],
    second: tuple[np.ndarray, np.ndarray],
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Differences:
    """Σ x / Σ y of the ``second`` less that of the ``first``, each of arrays (P, K) over the same list of P people,
    with y = 0 for those who are not of it: people who are of both are drawn together."""
    (a, _, na), (b, _, nb) = _ratio(*first), _ratio(*second)
    value = b - a
    # Residuals of the same person are subtracted, so that what is alike in both cancels.
    n = np.minimum(na, nb)
    strata = (first[1] > 0).any(axis=1).astype(int) + 2 * (second[1] > 0).any(axis=1).astype(int)
    error = _difference_error(first, second, a, b, n)
    low, high, p = _studentised_difference(value, error, n, first, second, strata, resamples, seed)
    return Differences(value, low, high, p)


def proportion_differences(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]) -> Differences:
    """The same of shares of people: Newcombe's interval, which takes the two for different people and is too wide
    where they are the same; p by the score test with one more success and failure each (Agresti and Caffo 2000)."""
    from scipy.special import ndtr

    (x, y), (u, v) = ((np.asarray(s[0]).sum(axis=0), np.asarray(s[1]).sum(axis=0)) for s in (first, second))
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = x / y, u / v
        (la, ha), (lb, hb) = wilson(x, y), wilson(u, v)
        low = b - a - np.sqrt((b - lb) ** 2 + (ha - a) ** 2)
        high = b - a + np.sqrt((hb - b) ** 2 + (a - la) ** 2)
        pa, pb = (x + 1) / (y + 2), (u + 1) / (v + 2)
        z = (pb - pa) / np.sqrt(pa * (1 - pa) / (y + 2) + pb * (1 - pb) / (v + 2))
    few = (y < LEAST_PEOPLE) | (v < LEAST_PEOPLE)
    blank = lambda w: np.where(few, np.nan, w)
    return Differences(b - a, blank(low), blank(high), blank(2 * ndtr(-np.abs(z))))


def discoveries(p: np.ndarray, rate: float = 0.05) -> np.ndarray:
    """Which of the hypotheses with these p-values (NaN: none) are rejected so that at most a share ``rate`` of the
    rejections is expected to be wrong (Benjamini and Hochberg 1995)."""
    return adjusted(p) <= rate


def adjusted(p: np.ndarray) -> np.ndarray:
    """p-values adjusted by Benjamini and Hochberg's procedure: the least false discovery rate at which each is
    rejected; NaN stays NaN and counts for nothing."""
    p = np.asarray(p, float)
    out = np.full(p.shape, np.nan)
    known = np.flatnonzero(np.isfinite(p))
    if len(known):
        order = known[np.argsort(p[known], kind="stable")]
        scaled = p[order] * len(order) / np.arange(1, len(order) + 1)
        out[order] = np.minimum(np.minimum.accumulate(scaled[::-1])[::-1], 1.0)
    return out


def _ratio(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The ratio, its standard error, and how many people it concerns, (K,) each."""
    people = (y > 0).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        total = y.sum(axis=0)
        value = np.where(total > 0, x.sum(axis=0) / total, np.nan)
        residual = x - value * y
        error = np.sqrt((residual**2).sum(axis=0) * people / (people - 1)) / total
    return value, np.where(people >= LEAST_PEOPLE, error, np.nan), people


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


def _studentised(
    value: np.ndarray, error: np.ndarray, people: np.ndarray, x: np.ndarray, y: np.ndarray, resamples: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    P, K = x.shape
    t = np.full((resamples, K), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        wider = people / (people - 1)
        for part, w in _blocks(P, resamples, seed, np.zeros(P, int)):
            m, square = _moments(w, x, y)
            t[part] = (m - value) / np.sqrt((1 - TOWARDS) * square * wider + TOWARDS * error**2)
    return _ends(value, error, t)


def _ends(value: np.ndarray, error: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    # Where nothing varies, such as where nobody looks, draws tell nothing.
    usable = np.isfinite(t).sum(axis=0) >= 0.9 * len(t)
    low, high = np.full(value.shape, np.nan), np.full(value.shape, np.nan)
    for k in np.flatnonzero(usable & (error > 0)):
        some = t[np.isfinite(t[:, k]), k]
        lower, upper = np.quantile(some, (_LOW, _HIGH))
        low[k], high[k] = value[k] - upper * error[k], value[k] - lower * error[k]
    return low, high


Pair = tuple[np.ndarray, np.ndarray]


def _difference_error(first: Pair, second: Pair, a: np.ndarray, b: np.ndarray, n: np.ndarray) -> np.ndarray:
    (x, y), (u, v) = first, second
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = (u - b * v) / v.sum(axis=0) - (x - a * y) / y.sum(axis=0)
        error = np.sqrt((residual**2).sum(axis=0) * n / (n - 1))
    return np.where(n >= LEAST_PEOPLE, error, np.nan)


def _studentised_difference(
    value: np.ndarray,
    error: np.ndarray,
    n: np.ndarray,
    first: Pair,
    second: Pair,
    strata: np.ndarray,
    resamples: int,
    seed: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    (x, y), (u, v) = first, second
    P, K = x.shape
    t = np.full((resamples, K), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        wider = n / (n - 1)
        for part, w in _blocks(P, resamples, seed, strata):
            a, sa = _moments(w, x, y)
            b, sb = _moments(w, u, v)
            sy, sv = w @ y, w @ v
            # Twice the sum of products of the two residuals, of people who are of both.
            cross = w @ (x * u) - a * (w @ (y * u)) - b * (w @ (x * v)) + a * b * (w @ (y * v))
            square = np.maximum(sa + sb - 2 * cross / (sy * sv), 0.0)
            t[part] = (b - a - value) / np.sqrt((1 - TOWARDS) * square * wider + TOWARDS * error**2)
    low, high = _ends(value, error, t)
    with np.errstate(divide="ignore", invalid="ignore"):
        far = np.abs(t) >= np.abs(value / error)
    count = np.isfinite(t).sum(axis=0)
    p = np.where(np.isfinite(low), ((far & np.isfinite(t)).sum(axis=0) + 1) / (count + 1), np.nan)
    # No spread in either: the same, or beyond all doubt different, which nobody can tell from so few.
    return low, high, np.where(error == 0, np.where(value == 0, 1.0, np.nan), p)
