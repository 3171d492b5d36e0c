"""Profiles of the objective over turn, scale and shift: intervals of what samples without hit points do not determine.

Derivatives at the optimum do not show that a distant turn fits as well, nor that heads can move in free space at no
cost. So the objective is minimised with the turn, or the scale, held at values from a grid (a profile likelihood, with
the robust objective in place of the likelihood), and heads are shifted in eight directions. A placement is retained if
its objective is within a margin of the smallest one in enough of the resamples of participants. The resamples represent
the error of few participants; the margin represents the errors of the model, such as gaze through a window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nerg_mi.formats.alignments import Interval
from nerg_mi.maths.transforms import similarity_scale, transform_points

from .constraints import AlignmentTarget
from .icp import Score, refine
from .similarity import FULL_BASIS, LOG_SCALE, TURN, LocalSimilarity, turn_between

LEVEL = 0.95
"""Level of the intervals: a placement is retained unless its objective exceeds the margin in this fraction of the
resamples."""

MARGIN = 0.002
"""Margin of the objective, the sum over the scores of the mean of log(1 + (residual / scale)^2).

It is the smallest of a few values with which 17 intervals contain the true turn, in the environments of
``benchmarks/generated_places.py``, the demo store and the VR supermarket, with eight participants each.
"""

_TURNS = np.radians([0.5, 1, 2, 3, 5, 7, *range(10, 30, 5), *range(30, 181, 10)])
_LOG_SCALES = np.log([1.01, 1.02, 1.05, 1.1, 1.2, 1.35, 1.6, 2, 2.5, 3.2, 4, 5, 6.5, 8, 10])
_SHIFTS = 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2  # metres
_NUM_RESAMPLES, _NUM_STARTS, _MAX_EVALUATIONS = 400, 2, 10


@dataclass(frozen=True, eq=False)
class Profile:
    """Placements (P, 4, 4), the result first, with the objective of each group (P, G), which sums to the objective.

    ``axis`` (P,): `TURN` or `LOG_SCALE` for a minimum at a fixed turn or scale, other non-negative numbers for steps in
    one direction, -1 for other placements. ``step`` (P,): number of the step on the axis, counted from the result.
    ``is_local``: whether only placements that are connected to the result are plausible, as for an initial alignment.
    """

    matrices: np.ndarray
    costs: np.ndarray
    axis: np.ndarray
    step: np.ndarray
    is_local: bool = False

    def with_result(self, matrix: np.ndarray, cost: np.ndarray) -> Profile:
        """Return the profile with another result ``matrix`` (4, 4), whose objective by group is ``cost`` (G,)."""
        matrices, costs = np.concatenate([matrix[None], self.matrices]), np.concatenate([cost[None], self.costs])
        return replace(self, matrices=matrices, costs=costs, axis=np.r_[-1, self.axis], step=np.r_[0, self.step])

    def find_plausible(self, margin: float = MARGIN, seed: int = 0) -> np.ndarray:
        """Return whether each placement is plausible (P,): within ``margin`` of the best in enough resamples."""
        count = self.costs.shape[1]
        weights = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), _NUM_RESAMPLES)
        costs = self.costs @ weights.T
        mask = (costs <= costs.min(axis=0) + margin).mean(axis=1) >= 1 - LEVEL
        mask[0] = True
        if self.is_local:
            for axis, sign in {(a, np.sign(s)) for a, s in zip(self.axis, self.step) if s}:
                rows = np.flatnonzero((self.axis == axis) & (np.sign(self.step) == sign))
                rows = rows[np.argsort(np.abs(self.step[rows]))]
                mask[rows] = np.logical_and.accumulate(mask[rows])
        return mask

    def find_interval(self, heads: np.ndarray, margin: float = MARGIN, seed: int = 0) -> Interval:
        """Return the interval of the plausible placements; ``heads`` (N, 3) are head positions of the tracking."""
        mask, best = self.find_plausible(margin, seed), self.matrices[0]
        rows = np.r_[0, np.flatnonzero(self.axis == TURN)]
        turns = np.degrees(find_arc(np.array([turn_between(best, m) for m in self.matrices[rows]]), mask[rows]))
        rows = np.r_[0, np.flatnonzero(self.axis == LOG_SCALE)]
        scales = np.array([similarity_scale(m) for m in self.matrices[rows]])
        order = np.argsort(scales)
        plausible = np.flatnonzero(mask[rows][order])
        # The grid is no finer than its steps, so that the range extends to the first implausible ones.
        ends = scales[order][[max(plausible[0] - 1, 0), min(plausible[-1] + 1, len(rows) - 1)]]
        moved = transform_points(best, heads)
        distances = [np.median(np.linalg.norm(transform_points(m, heads) - moved, axis=1)) for m in self.matrices[mask]]
        shift = float(max(distances)) / similarity_scale(best)
        return Interval((float(turns[0]), float(turns[1])), (float(ends[0]), float(ends[1])), shift)


def find_arc(turns: np.ndarray, mask: np.ndarray) -> tuple[float, float]:
    """Return the smallest arc that contains the plausible ones (``mask``) of ``turns`` (N,), in radians, and extends to
    the next implausible ones. The first turn is 0 and plausible."""
    if mask.all():
        return (0.0, 0.0) if len(turns) == 1 else (-np.pi, np.pi)
    plausible = np.sort(turns[mask])
    k = int(np.argmax(np.diff(np.r_[plausible, plausible[0] + 2 * np.pi])))
    # The arc begins after the largest gap and contains 0.
    low, high = plausible[(k + 1) % len(plausible)], plausible[k]
    low, high = (low - 2 * np.pi if low > 0 else low), (high + 2 * np.pi if high < 0 else high)
    others = np.concatenate([turns[~mask] + cycle for cycle in (-2 * np.pi, 0, 2 * np.pi)])
    return float(others[others < low].max()), float(others[others > high].min())


def make_profile(
    scores: Sequence[Score],
    best: np.ndarray,
    starts: Sequence[np.ndarray],
    target: AlignmentTarget,
    center: np.ndarray,
    fix_floor: bool,
) -> Profile:
    """Profile the objective about the placement ``best``.

    Parameters
    ----------
    scores
        Scores, whose sum is the objective.
    best, starts
        The result (4, 4), and other placements from which minima are searched. Without any, each minimum is searched
        from its neighbour on the grid only, and the profile is local.
    target
        Scene and constraints: what is given is not varied.
    center
        Point (3,) of the tracking about which placements are turned and scaled.
    fix_floor
        Whether ``center`` is on the floor, which stays in place.
    """
    matrices, axes, steps = [best, *starts], [-1] * (1 + len(starts)), [0] * (1 + len(starts))
    for axis, grid in ((TURN, _TURNS), (LOG_SCALE, _LOG_SCALES)):
        if (target.turn if axis == TURN else target.scale) is not None:
            continue
        for sign in (1, -1):
            last = best
            for step, offset in enumerate(sign * grid, 1):
                missing = [_missing_offset(axis, best, m, offset) for m in starts]
                nearest = [starts[k] for k in np.argsort(np.abs(missing))[:_NUM_STARTS]]
                fits = []
                for m in (last, *nearest):
                    chart = target.parametrize(m, transform_points(m, center), fix_floor)
                    change = FULL_BASIS[axis] * _missing_offset(axis, best, m, offset)
                    base = LocalSimilarity(m, chart.center).matrix(change)
                    fixed = LocalSimilarity(base, chart.center, chart.basis[:, chart.basis[axis] == 0])
                    fits.append(refine(scores, fixed, 1.0, _MAX_EVALUATIONS))
                last = min(fits, key=lambda f: f.cost).matrix
                matrices.append(last)
                axes.append(axis)
                steps.append(sign * step)
    if target.shift is None:
        for k, angle in enumerate(np.pi / 4 * np.arange(8)):
            for step, length in enumerate(_SHIFTS, 1):
                moved = best.copy()
                moved[:2, 3] += similarity_scale(best) * length * np.array([np.cos(angle), np.sin(angle)])
                matrices.append(moved)
                axes.append(FULL_BASIS.shape[0] + k)
                steps.append(step)
    costs = np.stack([evaluate_by_group(scores, m) for m in matrices])
    return Profile(np.stack(matrices), costs, np.array(axes), np.array(steps), not len(starts))


def _missing_offset(axis: int, best: np.ndarray, matrix: np.ndarray, offset: float) -> float:
    """Return by how much ``matrix`` must be turned (radians, at most half a circle) or scaled (logarithm) to differ
    from ``best`` by ``offset``."""
    if axis == LOG_SCALE:
        return offset - float(np.log(similarity_scale(matrix) / similarity_scale(best)))
    return float(np.remainder(offset - turn_between(best, matrix) + np.pi, 2 * np.pi) - np.pi)


def evaluate_by_group(scores: Sequence[Score], matrix: np.ndarray) -> np.ndarray:
    """Return the part (G,) of each group of residuals in the robust objective of ``matrix`` that `refine` minimises."""
    chart = LocalSimilarity(matrix, np.zeros(3), FULL_BASIS[:, :0])
    groups, where = np.unique(np.concatenate([s.group for s in scores]), return_inverse=True)
    parts = []
    for score in scores:
        r = score.residuals(chart, np.zeros(0))[0]
        parts.append(np.log1p((r / score.scale) ** 2) / max(len(r), 1))
    return np.bincount(where.reshape(-1), np.concatenate(parts), len(groups))
