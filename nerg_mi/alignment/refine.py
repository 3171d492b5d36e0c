"""The similarity that agrees best with several scores, near one that is given, and how well it is determined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from .chart import Chart
from .scores import Score

_FEW = 10


@dataclass(frozen=True, eq=False)
class Refined:
    """``matrix`` (4, 4); ``cost``: the robust mean over all scores, 0 where all is well, below 1; ``covariance`` (7, 7)
    of rotation vector, translation and logarithm of the scale about the chart's ``center``."""

    matrix: np.ndarray
    cost: float
    covariance: np.ndarray
    center: np.ndarray


def refine(
    scores: Sequence[Score], base: np.ndarray, center: np.ndarray, basis: np.ndarray, wide: float = 1.0, most: int = 60
) -> Refined:
    """Minimise the robust residuals of ``scores`` by Gauss-Newton steps in a trust region (SciPy's least_squares with a
    Cauchy loss), from the similarity ``base`` (4, 4) on.

    Each score has the same weight, however many residuals it has. ``center``, ``basis``: of the chart; ``wide``: factor
    of the scores' own scales, larger for a first, coarse fit; ``most``: evaluations.
    """
    chart = Chart(base, center, basis)
    weight = [1 / (wide * s.scale * np.sqrt(max(len(s.group), 1))) for s in scores]

    def stacked(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        parts = [s.residuals(chart, q) for s in scores]
        return (
            np.concatenate([w * r for w, (r, _) in zip(weight, parts)]),
            np.concatenate([w * by for w, (_, by) in zip(weight, parts)]),
        )

    # SciPy's loss is of each residual, of which those of a score count less the more there are of them.
    counts = np.concatenate([np.full(len(s.group), len(s.group), float) for s in scores])

    def weighed(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # log(1 + z) as a square, whose root has derivatives where z > 0: z = r^2 in units of a score's scale.
        r, by = stacked(q)
        z = r * r * counts
        factor = np.sqrt(np.where(z > 1e-12, np.log1p(z) / np.maximum(z, 1e-300), 1.0))
        slope = np.where(z > 1e-12, 1 / ((1 + z) * np.maximum(factor, 1e-150)), 1.0)
        return r * factor, by * slope[:, None]

    q = np.zeros(chart.size)
    if len(counts):
        last: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

        def at(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            key = q.tobytes()
            if key not in last:
                last.clear()
                last[key] = weighed(q)
            return last[key]

        derivatives: Any = lambda q: at(q)[1]
        q = least_squares(lambda q: at(q)[0], q, derivatives, x_scale="jac", max_nfev=most).x
    r, by = stacked(q)
    z = r * r * counts
    group = np.concatenate([s.group for s in scores])
    covariance = _sandwich(r, by, 1 / (1 + z), group)
    return Refined(
        chart.matrix(q), float(np.sum(np.log1p(z) / counts)), chart.basis @ covariance @ chart.basis.T, center
    )


def _sandwich(r: np.ndarray, by: np.ndarray, weight: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Covariance (k, k) of the parameters where residuals of a group may depend on each other: H^-1 (sum of g g') H^-1,
    g the gradient of a group (K.-Y. Liang, S. Zeger: Longitudinal data analysis using generalized linear models,
    1986)."""
    hessian = (by * weight[:, None]).T @ by
    gradient = by * (weight * r)[:, None]
    _, where = np.unique(group, return_inverse=True)
    where = where.reshape(-1)
    sums = np.stack([np.bincount(where, g) for g in gradient.T], axis=1)
    count = len(sums)
    inverse = np.linalg.pinv(hessian, hermitian=True)
    return inverse @ (sums.T @ sums) @ inverse * (count / max(count - 1, 1))


def groups_of(person: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(N,) numbers of groups that are taken for independent: people, or, of few people, ten seconds of each."""
    if len(np.unique(person)) >= _FEW:
        return person.astype(np.int64)
    blocks = np.floor((t - t.min(initial=np.inf)) / 10).astype(np.int64) if len(t) else np.zeros(0, np.int64)
    return person.astype(np.int64) * (int(blocks.max(initial=0)) + 1) + blocks
