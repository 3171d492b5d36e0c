"""Numbers with their 95 % intervals, their differences, and which of many differences are found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LEAST_PEOPLE = 3
"""Fewer people than these, or than these who add anything to a number, give no interval."""


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
