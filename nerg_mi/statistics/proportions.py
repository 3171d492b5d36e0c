r"""Intervals of shares of people, of whom each counts as 0 or 1, and of their differences, that hold for few people.

The interval of x of n is the mid-p one (Lancaster 1961): all π at which neither P(X > x) + P(X = x) / 2 nor its
counterpart below is less than 0.025, X binomial. Wilson's score interval holds the truth less than 84 % of the time
where π is near 0 or 1 (Brown, Cai and DasGupta 2001), Clopper and Pearson's 99 % of it; this one 92 % or more, whatever
π and n >= 3, at widths that are 2 (n = 40) to 7 % (n = 8) above Wilson's (Agresti and Gottard 2007).

A difference has one success and one failure added to both shares, which makes Wald's interval hold for few people: of
others (Agresti and Caffo 2000), and of the same ones, where the two that are added are of opposite outcomes (Bonett and
Price 2012). Of people some of whom are of both, these two are their covariance's ends. Interval and p-value are of one
statistic: p < 0.05 where 0 is outside.
"""

from __future__ import annotations

import numpy as np

from .estimates import LEAST_PEOPLE, Differences, Estimates

_ALPHA = 0.05
_Z = 1.959963984540054


def proportions(x: np.ndarray, y: np.ndarray) -> Estimates:
    """Σ x / Σ y of ``x`` and ``y`` (P, K) that are 0 or 1, x <= y, with their intervals."""
    people = y.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = x.sum(axis=0) / people
    low, high = mid_p(x.sum(axis=0), people)
    few = people < LEAST_PEOPLE
    return Estimates(value, np.where(few, np.nan, low), np.where(few, np.nan, high), people.astype(int))


def mid_p(successes: np.ndarray, trials: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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


def proportion_differences(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]) -> Differences:
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
    few = (m < LEAST_PEOPLE) | (n < LEAST_PEOPLE)
    return Differences(value, *(np.where(few, np.nan, w) for w in (low, high, p)))
