"""Evaluation of uncertainty: spread and support of a gaze field compared with its errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nerg_mi.tracking.probes import REGION_LEVELS, compute_region_levels, format_level, get_calibrated_level

from . import metrics
from .gaze import EPS, SCORES, SPLIT_HALF, GazeTest

SIGNALS = {"support": True, "spread": False}
"""Signals of certainty by their name in a row of `score_positions`, and whether higher values are more certain."""
ERRORS = ("KLD", "excess")
"""Errors at a position: KLD (nats), and its excess over the split-half KLD."""
RETAINED_FRACTIONS = (1.0, 0.75, 0.5, 0.25)  # Fractions of the most certain positions whose mean error is reported
# Random halves of the participants, minimum rays of each half at a position, and the weight of the prior in the
# prediction of one half from the other, so that unseen directions have non-zero probability.
_NUM_HALVES, _MIN_RAYS, _PRIOR_WEIGHT = 8, 32, 0.2
_MIN_GROUPS = 5  # Minimum number of position groups for a confidence interval


def score_positions(
    test: GazeTest,
    maps: np.ndarray,
    prior: np.ndarray,
    *,
    support: np.ndarray | None = None,
    spread: np.ndarray | None = None,
    groups: Sequence[Any] | None = None,
    seed: int = 0,
) -> list[dict[str, Any]]:
    """Make a row per position of ``test`` with its errors and signals of certainty.

    Parameters
    ----------
    test : GazeTest
        Test data.
    maps, prior : numpy.ndarray
        Densities (P, D) of the field and of the position-independent prior.
    support : numpy.ndarray, optional
        Number of nearby training rays (P,).
    spread : numpy.ndarray, optional
        Standard deviation over the members of an ensemble, integrated over the sphere (P,).
    groups : sequence, optional
        Group of neighbouring positions of each position. Default: each position is its own group.
    seed : int
        Seed of the random halves.

    Returns
    -------
    list of dict
        Position (m), ``group``, numbers of rays and participants (``people``), KLD of the field and of the baseline
        (``prior``), the split-half KLD (``half``) and the ``excess`` over it if there is enough data, ``support`` and
        ``spread``.
    """
    maps, prior = test.smooth(maps), test.smooth(prior)
    error, prior_error = (metrics.kld(test.truth, m, eps=EPS) for m in (maps, prior))
    half = compute_split_half_errors(test, prior, seed)
    rows = []
    for i, (x, y, z) in enumerate(test.centres.tolist()):
        row = {"x": x, "y": y, "z": z, "group": str(i if groups is None else groups[i])}
        row |= {"rays": int(test.counts[i].sum()), "people": int(np.count_nonzero(test.counts[i]))}
        row |= {"KLD": float(error[i]), "prior": float(prior_error[i])}
        if np.isfinite(half[i]):
            row |= {"half": float(half[i]), "excess": float(error[i] - half[i])}
        row |= {k: float(v[i]) for k, v in (("support", support), ("spread", spread)) if v is not None}
        rows.append(row)
    return rows


def compute_split_half_errors(test: GazeTest, prior: np.ndarray, seed: int = 0) -> np.ndarray:
    """Compute the KLD (P,) of one half of the participants under the other half, mixed with a fifth of ``prior`` (P,
    D).

    The result is the mean over both directions and several random halves; NaN if no split leaves 32 rays in both
    halves.
    """
    rng, errors = np.random.default_rng(seed), []
    num_participants = len(test.participants)
    for _ in range(_NUM_HALVES if num_participants > 1 else 0):
        side = rng.permutation(num_participants) < num_participants // 2
        counts = [test.counts * side, test.counts * ~side]
        has_both = np.logical_and(*(c.sum(axis=1) >= _MIN_RAYS for c in counts))
        error = np.full(len(test.truth), np.nan)
        shares = [c[has_both] / c[has_both].sum(axis=1, keepdims=True) for c in counts]
        a, b = (np.einsum("pn,pnd->pd", share, test.participant_densities[has_both]) for share in shares)
        mix_prior = lambda maps, both=has_both: (1 - _PRIOR_WEIGHT) * maps + _PRIOR_WEIGHT * prior[both]
        error[has_both] = (metrics.kld(a, mix_prior(b), eps=EPS) + metrics.kld(b, mix_prior(a), eps=EPS)) / 2
        errors.append(error)
    stacked = np.array(errors).reshape(-1, len(test.truth))
    is_known = np.isfinite(stacked)
    return np.where(
        is_known.any(axis=0), np.where(is_known, stacked, 0).sum(axis=0) / np.maximum(is_known.sum(axis=0), 1), np.nan
    )


def correlate_uncertainty(
    rows: Sequence[Mapping[str, Any]], resamples: int = 200, seed: int = 0
) -> list[dict[str, Any]]:
    """Correlate signals of certainty with errors.

    Returns a row per signal of `SIGNALS` and error: Spearman's rank correlation ``rho`` of the uncertainty with the
    error, the ends ``.low`` and ``.high`` of its 95 % confidence interval if there are five groups of positions, and
    the mean error of the most certain `RETAINED_FRACTIONS` of the positions. A constant signal has rho NaN.
    """
    out = []
    for signal, is_higher_better in SIGNALS.items():
        for error in ERRORS:
            used = [r for r in rows if signal in r and error in r]
            if not used:
                continue
            uncertainty = np.array([r[signal] for r in used], float) * (-1 if is_higher_better else 1)
            value = np.array([r[error] for r in used], float)
            row = {"signal": signal, "error": error, "positions": len(used), "rho": _spearman(uncertainty, value)}
            row |= _bootstrap_interval(uncertainty, value, [r["group"] for r in used], resamples, seed)
            out.append(
                row | {f"{share:.0%}": _mean_certain_error(uncertainty, value, share) for share in RETAINED_FRACTIONS}
            )
    return out


def measure_calibration(
    test: GazeTest,
    methods: Mapping[str, tuple[np.ndarray, np.ndarray]],
    resamples: int = 200,
    seed: int = 0,
    calibrated: Mapping[str, Mapping[str, float]] | None = None,
) -> list[dict[str, Any]]:
    """Measure the coverage of highest-density regions on held-out rays.

    Parameters
    ----------
    test : GazeTest
        Test data.
    methods : mapping
        Densities by method in the directions of the test (P, D), and at its rays (P, K).
    resamples, seed : int
        Bootstrap of the participants.
    calibrated : mapping, optional
        Calibrated levels of methods (`tracking.probes.calibrate_levels`). Each adds a row "METHOD, calibrated".

    Returns
    -------
    list of dict
        A row per method: the fraction of the rays in the regions of each of `REGION_LEVELS`, with ``.low`` and
        ``.high`` if there are three participants.
    """
    who, count, out = test.sample_participants, len(test.participants), []
    for name, (maps, at) in methods.items():
        levels = compute_region_levels(maps, at)
        out += measure_coverage(name, levels, who, count, resamples, seed, (calibrated or {}).get(name))
    return out


def measure_coverage(
    name: str,
    levels: np.ndarray,
    participants: np.ndarray,
    num_participants: int,
    resamples: int = 200,
    seed: int = 0,
    calibrated: Mapping[str, float] | None = None,
) -> list[dict[str, Any]]:
    """Measure the coverage of highest-density regions from the ``levels`` of rays (`compute_region_levels`) and their
    ``participants``, indices of the same shape.

    Returns a row of the method ``name`` as `measure_calibration`, and another one if it has ``calibrated`` levels.
    """
    draws = np.random.default_rng(seed).multinomial(
        num_participants, np.full(num_participants, 1 / num_participants), resamples if num_participants >= 3 else 0
    )
    out = []
    for title, level_map in ((name, None), (f"{name}, calibrated", calibrated))[: 1 if calibrated is None else 2]:
        row: dict[str, Any] = {"method": title}
        for coverage in REGION_LEVELS:
            is_inside, key = levels <= get_calibrated_level(coverage, level_map), format_level(coverage)
            row[key] = float(is_inside.mean())
            if len(draws):
                weights = [times[participants] for times in draws]
                weights = [w for w in weights if w.any()]
                half_width = 1.96 * np.std([(is_inside * w).sum() / w.sum() for w in weights])
                row[f"{key}.low"], row[f"{key}.high"] = row[key] - half_width, row[key] + half_width
        out.append(row)
    return out


def _spearman(a: np.ndarray, b: np.ndarray) -> float:
    from scipy.stats import rankdata

    a, b = (rankdata(v) for v in (a, b))
    if len(a) < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return float("nan")
    return float(np.corrcoef(a, b)[0, 1])


def _bootstrap_interval(
    uncertainty: np.ndarray, error: np.ndarray, groups: Sequence[str], resamples: int, seed: int
) -> dict[str, float]:
    """Return the 95 % confidence interval of ``rho``: quantiles over resamples of whole position groups."""
    names, group_index = np.unique(groups, return_inverse=True)
    if len(names) < _MIN_GROUPS or not resamples:
        return {}
    rng, members = np.random.default_rng(seed), [np.flatnonzero(group_index == k) for k in range(len(names))]
    correlations = []
    for _ in range(resamples):
        drawn = np.concatenate([members[k] for k in rng.integers(0, len(names), len(names))])
        correlations.append(_spearman(uncertainty[drawn], error[drawn]))
    correlations = [v for v in correlations if np.isfinite(v)]
    if not correlations:
        return {}
    low, high = np.quantile(correlations, [0.025, 0.975])
    return {"rho.low": float(low), "rho.high": float(high)}


def _mean_certain_error(uncertainty: np.ndarray, error: np.ndarray, fraction: float) -> float:
    """Return the mean ``error`` of the most certain ``fraction``; ties have equal weight."""
    _, rank = np.unique(uncertainty, return_inverse=True)
    tied_mean = (np.bincount(rank, weights=error) / np.bincount(rank))[rank]
    most_certain = np.argsort(rank, kind="stable")[: max(1, round(fraction * len(error)))]
    return float(tied_mean[most_certain].mean())


# ---- Summary of several folds: means and confidence intervals ----
#
# The confidence interval is that of Student's t distribution for the mean of K folds: mean ± t(0.975, K - 1) s / √K.
# Folds share training participants, so they are not independent, and no estimate of the variance is unbiased (Bengio
# and Grandvalet 2004): the interval measures the variation over held-out participants and zones, not that of a new
# environment. Differences are taken fold by fold, where most of the variation is common to both methods.

_SCORES = (*SCORES, "integral")


def summarise_folds(folds: Sequence[Sequence[Mapping[str, Any]]], confidence: float = 0.95) -> list[dict[str, Any]]:
    """Average the scores and the integral of ``folds``, the rows of `held_out.evaluate_gaze` with the field's first.

    The last row is the difference of the field to the last method, fold by fold.
    """
    summary = average_folds(folds, _SCORES, confidence)
    names = [row["method"] for row in summary]
    by_name = [{row["method"]: row for row in rows} for rows in folds]
    reference = next((name for name in reversed(names) if name != SPLIT_HALF), None)
    if reference is None or reference == names[0]:
        return summary
    pairs = [(rows[names[0]], rows[reference]) for rows in by_name if names[0] in rows and reference in rows]
    differences = [{k: ours[k] - other[k] for k in SCORES if k in ours and k in other} for ours, other in pairs]
    return [*summary, _make_row(f"{names[0]} less {reference}", differences, _SCORES, confidence)]


def average_folds(
    folds: Sequence[Sequence[Mapping[str, Any]]], scores: Sequence[str], confidence: float = 0.95
) -> list[dict[str, Any]]:
    """Average ``scores`` over the ``folds`` that have them.

    Returns a row per method in the order of the first fold, with ``.low`` and ``.high`` of the confidence interval, and
    the number of ``folds``. A score of a single fold has no interval.
    """
    names = list(dict.fromkeys(row["method"] for rows in folds for row in rows))
    by_name = [{row["method"]: row for row in rows} for rows in folds]
    return [_make_row(name, [rows[name] for rows in by_name if name in rows], scores, confidence) for name in names]


def _make_row(name: str, rows: Sequence[Mapping[str, Any]], scores: Sequence[str], confidence: float) -> dict[str, Any]:
    from scipy.stats import t

    out: dict[str, Any] = {"method": name, "folds": len(rows)}
    for score in scores:
        values = [row[score] for row in rows if score in row and math.isfinite(row[score])]
        if not values:
            continue
        out[score] = float(np.mean(values))
        if len(values) > 1:
            half_width = t.ppf(0.5 + confidence / 2, len(values) - 1) * np.std(values, ddof=1) / math.sqrt(len(values))
            out[f"{score}.low"], out[f"{score}.high"] = float(out[score] - half_width), float(out[score] + half_width)
    return out
