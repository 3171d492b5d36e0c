"""Which of very many rays are taken as a sample, without room for all of their numbers."""

from __future__ import annotations

import numpy as np


def sample_rows(count: int, n: int, seed: int = 0, runs: int | None = None) -> np.ndarray:
    """``n`` of the numbers from 0 to ``count`` - 1, sorted (n,) int64; all, where there are no more.

    Every number is as likely as any other. Without ``runs`` so is every set of ``n`` of them. With it they are so many
    runs of neighbours, wherever these begin: less has to be read for them, and they tell less, since neighbours are
    alike.
    """
    rng = np.random.default_rng(seed)
    if n >= count:
        return np.arange(count)
    if runs is not None and runs < n:
        length = n // runs
        # Cells of equal length on a circle that is turned at random.
        cells = _distinct(count // length, runs, rng)
        start = (rng.integers(count) + cells * length) % count
        return np.sort((start[:, None] + np.arange(length)).ravel() % count)
    if n > count // 2:
        keep = np.ones(count, bool)
        keep[_distinct(count, count - n, rng)] = False
        return np.flatnonzero(keep)
    return _distinct(count, n, rng)


def _distinct(count: int, n: int, rng: np.random.Generator) -> np.ndarray:
    """``n`` different numbers below ``count``, sorted: drawn until there are enough, and of too many some are left out
    at random."""
    found = np.zeros(0, np.int64)
    while len(found) < n:
        # Sorted, where numpy.unique would make a table of hashes: several times as fast.
        found = np.sort(np.concatenate([found, rng.integers(0, count, n - len(found) + 16)]))
        found = found[np.r_[True, found[1:] != found[:-1]]]
    return np.delete(found, rng.choice(len(found), len(found) - n, replace=False))
