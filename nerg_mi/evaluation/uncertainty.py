"""Whether a gaze field knows where it is wrong: its spread and its support against its errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nerg_mi.probes.probes import REGION_LEVELS, get_calibrated_level, format_level, compute_region_levels

from . import metrics
from .gaze import EPS, SCORES, GazeTest

SIGNALS = {"support": True, "spread": False}
"""What tells how sure a field is, by its name in a row of `position_rows`, and whether more of it is surer."""
ERRORS = ("KLD", "excess")
"""Errors of a position: KLD (nats), and by how much it is above that of one half of the people under the other."""
RETAINED_FRACTIONS = (1.0, 0.75, 0.5, 0.25)  # Shares of the positions, the surest, whose mean error is told
# Halves of the people that are drawn, rays that each half has at a position at least, and the blind density's share of
# what one half tells of the other, so that where it never looked is not impossible.
_HALVES, _RAYS, _BLIND = 8, 32, 0.2
_GROUPS = 5  # Groups of positions from which on there is an interval


def score_positions(
    test: GazeTest,
    maps: np.ndarray,
    blind: np.ndarray,
    *,
    support: np.ndarray | None = None,
    spread: np.ndarray | None = None,
    groups: Sequence[Any] | None = None,
    seed: int = 0,
) -> list[dict[str, Any]]:
    """A row a position of ``test``: where it is (m), its ``group``, rays and people, KLD of ``maps`` and of ``blind``
    (P, D), that of the people's ``half`` and the ``excess`` over it, where they are enough, and how sure the field is:
    ``support`` (P,), rays, and ``spread`` (P,), the standard deviation over an ensemble's members, integrated over the
    sphere. ``groups``: of neighbouring positions; None: each is its own."""
    error, less = (metrics.kld(test.truth, m, eps=EPS) for m in (maps, blind))
    half = compute_split_half_errors(test, blind, seed)
    rows = []
    for i, (x, y, z) in enumerate(test.centres.tolist()):
        row = {"x": x, "y": y, "z": z, "group": str(i if groups is None else groups[i])}
        row |= {"rays": int(test.counts[i].sum()), "people": int(np.count_nonzero(test.counts[i]))}
        row |= {"KLD": float(error[i]), "blind": float(less[i])}
        if np.isfinite(half[i]):
            row |= {"half": float(half[i]), "excess": float(error[i] - half[i])}
        row |= {k: float(v[i]) for k, v in (("support", support), ("spread", spread)) if v is not None}
        rows.append(row)
    return rows


def compute_split_half_errors(test: GazeTest, blind: np.ndarray, seed: int = 0) -> np.ndarray:
    """KLD (P,) of half of the people under the other half, mixed with a fifth of ``blind`` (P, D): means over both
    directions and several draws of the halves. NaN where no draw leaves both halves 32 rays."""
    rng, found = np.random.default_rng(seed), []
    people = len(test.participants)
    for _ in range(_HALVES if people > 1 else 0):
        side = rng.permutation(people) < people // 2
        counts = [test.counts * side, test.counts * ~side]
        both = np.logical_and(*(c.sum(axis=1) >= _RAYS for c in counts))
        error = np.full(len(test.truth), np.nan)
        shares = [c[both] / c[both].sum(axis=1, keepdims=True) for c in counts]
        a, b = (np.einsum("pn,pnd->pd", share, test.participant_densities[both]) for share in shares)
        told = lambda maps, both=both: (1 - _BLIND) * maps + _BLIND * blind[both]
        error[both] = (metrics.kld(a, told(b), eps=EPS) + metrics.kld(b, told(a), eps=EPS)) / 2
        found.append(error)
    each = np.array(found).reshape(-1, len(test.truth))
    known = np.isfinite(each)
    return np.where(known.any(axis=0), np.where(known, each, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1), np.nan)


def correlate_uncertainty(rows: Sequence[Mapping[str, Any]], resamples: int = 200, seed: int = 0) -> list[dict[str, Any]]:
    """A row a signal of `SIGNALS` that ``rows`` of `position_rows` have, and error: Spearman's rank correlation of what
    makes unsure with the error, ``rho``, with ``.low`` and ``.high`` of its 95 % interval where there are five groups
    of positions, and the mean error of the surest `KEPT` of the positions. NaN where a signal is the same everywhere,
    and so says nothing."""
    out = []
    for signal, surer in SIGNALS.items():
        for error in ERRORS:
            used = [r for r in rows if signal in r and error in r]
            if not used:
                continue
            doubt = np.array([r[signal] for r in used], float) * (-1 if surer else 1)
            value = np.array([r[error] for r in used], float)
            row = {"signal": signal, "error": error, "positions": len(used), "rho": _spearman(doubt, value)}
            row |= _interval(doubt, value, [r["group"] for r in used], resamples, seed)
            out.append(row | {f"{share:.0%}": _risk(doubt, value, share) for share in RETAINED_FRACTIONS})
    return out


def measure_calibration(
    test: GazeTest,
    methods: Mapping[str, tuple[np.ndarray, np.ndarray]],
    resamples: int = 200,
    seed: int = 0,
    calibrated: Mapping[str, Mapping[str, float]] | None = None,
) -> list[dict[str, Any]]:
    """A row a method: the share of the rays of ``test`` that lie in the smallest regions which are said to hold
    `LEVELS` of the gaze, with ``.low`` and ``.high`` where there are three persons. ``methods``: densities in the
    test's directions (P, D), and at its rays (P, K). ``calibrated``: by methods that have them, what its training found
    are to be asked for (`probes.probes.calibrated_levels`), which make a row "METHOD, calibrated"."""
    rng, people = np.random.default_rng(seed), len(test.participants)
    draws = rng.multinomial(people, np.full(people, 1 / people), resamples if people >= 3 else 0)
    out = []
    for name, (maps, at) in methods.items():
        level = compute_region_levels(maps, at)
        rows: dict[str, Mapping[str, float] | None] = {name: None}
        if calibrated and name in calibrated:
            rows[f"{name}, calibrated"] = calibrated[name]
        for title, asked in rows.items():
            row: dict[str, Any] = {"method": title}
            for share in REGION_LEVELS:
                inside, key = level <= get_calibrated_level(share, asked), format_level(share)
                row[key] = float(inside.mean())
                if len(draws):
                    weights = [times[test.sample_participants] for times in draws]
                    reach = 1.96 * np.std([(inside * w).sum() / w.sum() for w in weights])
                    row[f"{key}.low"], row[f"{key}.high"] = row[key] - reach, row[key] + reach
            out.append(row)
    return out


def _spearman(a: np.ndarray, b: np.ndarray) -> float:
    from scipy.stats import rankdata

    a, b = (rankdata(v) for v in (a, b))
    if len(a) < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return float("nan")
    return float(np.corrcoef(a, b)[0, 1])


def _interval(
    doubt: np.ndarray, error: np.ndarray, groups: Sequence[str], resamples: int, seed: int
) -> dict[str, float]:
    """The ends of the interval of ``rho``: quantiles over resamples of the groups, each with all of its positions."""
    names, own = np.unique(groups, return_inverse=True)
    if len(names) < _GROUPS or not resamples:
        return {}
    rng, members = np.random.default_rng(seed), [np.flatnonzero(own == k) for k in range(len(names))]
    found = []
    for _ in range(resamples):
        drawn = np.concatenate([members[k] for k in rng.integers(0, len(names), len(names))])
        found.append(_spearman(doubt[drawn], error[drawn]))
    found = [v for v in found if np.isfinite(v)]
    if not found:
        return {}
    low, high = np.quantile(found, [0.025, 0.975])
    return {"rho.low": float(low), "rho.high": float(high)}


def _risk(doubt: np.ndarray, error: np.ndarray, share: float) -> float:
    """Mean ``error`` of the surest ``share``; those that are equally sure count alike."""
    _, place = np.unique(doubt, return_inverse=True)
    alike = (np.bincount(place, weights=error) / np.bincount(place))[place]
    surest = np.argsort(place, kind="stable")[: max(1, round(share * len(error)))]
    return float(alike[surest].mean())


# ---- Scores of several folds as one table: means, and how far folds are from each other ----
#
# An interval is that of Student's t distribution for the mean of K folds: mean ± t(0.975, K - 1) s / √K. Folds share
# people who train, so that they are not independent, and no estimate of the variance is unbiased (Y. Bengio and
# Y. Grandvalet 2004): the interval tells the spread over people and zones that were held out, and not what a new shop
# would give. Differences are taken fold by fold, where most of that spread is the same for both methods.

SPLIT_HALF = "split half"  # A reference and no method: what half of the people tell of the other half
_SCORES = (*SCORES, "integral")


def summarise_folds(folds: Sequence[Sequence[Mapping[str, Any]]], confidence: float = 0.95) -> list[dict[str, Any]]:
    """`means` of the scores and of the integral of ``folds``, which have the rows of `workflows.evaluate_gaze`, the
    field's first. The last row is the field less the last method, fold by fold."""
    found = average_folds(folds, _SCORES, confidence)
    names = [row["method"] for row in found]
    by_name = [{row["method"]: row for row in rows} for rows in folds]
    bar = next((name for name in reversed(names) if name != SPLIT_HALF), None)
    if bar is None or bar == names[0]:
        return found
    both = [(rows[names[0]], rows[bar]) for rows in by_name if names[0] in rows and bar in rows]
    less = [{k: ours[k] - other[k] for k in SCORES if k in ours and k in other} for ours, other in both]
    return [*found, _row(f"{names[0]} less {bar}", less, _SCORES, confidence)]


def average_folds(
    folds: Sequence[Sequence[Mapping[str, Any]]], scores: Sequence[str], confidence: float = 0.95
) -> list[dict[str, Any]]:
    """A row a method, in the order of the first fold: means of ``scores`` over the ``folds`` whose rows have them, with
    ``.low`` and ``.high``, and how many ``folds`` these are. A score of one fold alone has no interval."""
    names = list(dict.fromkeys(row["method"] for rows in folds for row in rows))
    by_name = [{row["method"]: row for row in rows} for rows in folds]
    return [_row(name, [rows[name] for rows in by_name if name in rows], scores, confidence) for name in names]


def _row(name: str, rows: Sequence[Mapping[str, Any]], scores: Sequence[str], confidence: float) -> dict[str, Any]:
    from scipy.stats import t

    out: dict[str, Any] = {"method": name, "folds": len(rows)}
    for score in scores:
        values = [row[score] for row in rows if score in row and math.isfinite(row[score])]
        if not values:
            continue
        out[score] = float(np.mean(values))
        if len(values) > 1:
            reach = t.ppf(0.5 + confidence / 2, len(values) - 1) * np.std(values, ddof=1) / math.sqrt(len(values))
            out[f"{score}.low"], out[f"{score}.high"] = float(out[score] - reach), float(out[score] + reach)
    return out
