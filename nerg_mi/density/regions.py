"""The smallest regions that hold a share of a density, and what share is to be asked for so that they hold it.

A density of people who were seen is wider or narrower than that of others: the region that it says holds 80 % of the
gaze holds more or less of theirs. Looks that were held out tell by how much: the share that has to be asked for is the
quantile of the shares in which they lie (split conformal prediction, Vovk et al. 2005, with highest-density regions,
Izbicki et al. 2022).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

LEVELS = (0.5, 0.8, 0.95)
"""Shares of the gaze whose smallest regions are looked at."""


def level_name(level: float) -> str:
    """What a share of the gaze is called in tables and files."""
    return f"{level:.0%}"


def region_levels(maps: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Share of the gaze (P, K) in the smallest region that a ray lies in, of densities ``maps`` (P, D) in directions of
    equal area that are ``at`` (P, K) at the rays: what is denser, and half of what is equal (Hyndman 1996)."""
    out = []
    for row, values in zip(np.maximum(maps, 0).astype(np.float64), at):
        ordered = np.sort(row)
        mass = np.concatenate([[0.0], np.cumsum(ordered)])
        lower, upper = (mass[np.searchsorted(ordered, values, side)] for side in ("left", "right"))
        out.append(1 - 0.5 * (lower + upper) / mass[-1] if mass[-1] > 0 else np.full(len(values), 0.5))
    return np.array(out)


def calibrated_levels(levels: np.ndarray, weights: np.ndarray) -> dict[str, float]:
    """By `level_name`, the share to ask for so that the region holds each of `LEVELS` of the looks that were held out:
    weighted quantiles of the shares ``levels`` (n,) of `region_levels` in which they lie, ``weights`` (n,)."""
    order = np.argsort(levels)
    held = np.cumsum(weights[order]) / weights.sum()
    at = lambda level: order[min(np.searchsorted(held, level), len(order) - 1)]
    return {level_name(level): float(levels[at(level)]) for level in LEVELS}


def asked_level(level: float, calibrated: Mapping[str, float] | None) -> float:
    """The share to ask for so that a region holds ``level``, one of `LEVELS`: itself where nothing was calibrated."""
    return level if calibrated is None else calibrated[level_name(level)]
