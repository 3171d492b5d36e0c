"""Scores of several folds as one table: means, and how far folds are from each other.

An interval is that of Student's t distribution for the mean of K folds: mean ± t(0.975, K - 1) s / √K. Folds share
people who train, so that they are not independent, and no estimate of the variance is unbiased (Y. Bengio and
Y. Grandvalet 2004): the interval tells the spread over people and zones that were held out, and not what a new shop
would give. Differences are taken fold by fold, where most of that spread is the same for both methods.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .gaze import SCORES

SPLIT_HALF = "split half"
"""A reference and no method: what half of the people tell of the other half."""
_SCORES = (*SCORES, "integral")


def mean_rows(folds: Sequence[Sequence[Mapping[str, Any]]], confidence: float = 0.95) -> list[dict[str, Any]]:
    """`means` of the scores and of the integral of ``folds``, which have the rows of `workflows.evaluate_gaze`, the
    field's first. The last row is the field less the last method, fold by fold."""
    found = means(folds, _SCORES, confidence)
    names = [row["method"] for row in found]
    by_name = [{row["method"]: row for row in rows} for rows in folds]
    bar = next((name for name in reversed(names) if name != SPLIT_HALF), None)
    if bar is None or bar == names[0]:
        return found
    both = [(rows[names[0]], rows[bar]) for rows in by_name if names[0] in rows and bar in rows]
    less = [{k: ours[k] - other[k] for k in SCORES if k in ours and k in other} for ours, other in both]
    return [*found, _row(f"{names[0]} less {bar}", less, _SCORES, confidence)]


def means(
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
