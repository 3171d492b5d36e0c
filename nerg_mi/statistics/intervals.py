r"""Intervals of 95 % that take people for what was drawn at random, not rays; shares of people have their own
(`proportions`).

Each number is a ratio of sums over people, m = Σ x_p / Σ y_p: a mean where y_p is 1, or 1 for those whom it concerns.
Its standard error s is the jackknife's, which leaves out one person at a time (Tukey 1958; of clusters the most
reliable one for few, MacKinnon, Nielsen and Webb 2023); of a mean it is the usual one. The interval is m ± c s, with c
of the symmetric bootstrap-t over people (Hall 1988): people are drawn with replacement, t* = |m* - m| / s*, and c is
the 95 % quantile of t*. For few people it errs by less than the one with two tails of 2.5 % each, and a p-value comes
of the same: how often t* is at least that of the data. s* is that of the linearised residuals x_p - m* y_p (Cochran
1977, section 6.4), drawn towards that of the data, s*² <- (1 - λ) s*² + λ s² (as the constant of Tusher et al. 2001):
some draws of few people have hardly any spread, and would make it endless.

A number to which fewer than three people add anything has no interval, and no difference from it has one, but that of
the same people from 0, to which none of them adds. Where a number concerns at most half of the people, and they weigh
differently (y_p), as in the mean distance to what few look at, one or two of them may decide it: c is then at least
that of Student's t of n - 1 degrees of freedom, n = (Σ j²)² / Σ j⁴ the effective number of people (Kish 1965, section
8.2) of what each one adds to the jackknife's error, j_p.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .estimates import LEAST_PEOPLE, Differences, Estimates

RESAMPLES = 1999
"""Draws of people."""

TOWARDS = 0.01
"""λ."""

_HELD = 0.95
_BLOCK = 1 << 22

Pair = tuple[np.ndarray, np.ndarray]


def ratios(
    x: np.ndarray, y: np.ndarray, *, resamples: int = RESAMPLES, seed: int = 0, most: float = np.inf
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
    c = np.where((x != 0).sum(axis=0) >= LEAST_PEOPLE, np.maximum(_quantile(t, error), least), np.nan)
    low, high = value - c * error, value + c * error
    return Estimates(value, np.clip(low, 0.0, most), np.clip(high, 0.0, most), people)


def ratio_differences(first: Pair, second: Pair, *, resamples: int = RESAMPLES, seed: int = 0) -> Differences:
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
    enough = np.minimum(np.where(adds, adds, same), np.where(others, others, same)) >= LEAST_PEOPLE
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
    return np.where(people >= LEAST_PEOPLE, np.sqrt((parts**2).sum(axis=0)), np.nan)


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
