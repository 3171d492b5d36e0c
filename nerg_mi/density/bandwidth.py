"""How wide a kernel: rules for the concentration κ of a probe's density.

``silverman``: the published code's rule (:func:`nerg_mi.maths.vmf.silverman_kappa`). ``loo``: the κ under which each
ray is best predicted by the others. Each for every probe, or one for all of them.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.maths import vmf

KAPPA_MIN = 1.0
PROBES = 256  # probes that speak for all where one κ is sought


def kappa_grid(kappa_max: float, kappa_min: float = KAPPA_MIN) -> np.ndarray:
    """Concentrations that ``loo`` chooses from: geometric, 25 % steps."""
    return np.geomspace(kappa_min, kappa_max, max(2, 1 + round(np.log(kappa_max / kappa_min) / np.log(1.25))))


def leave_one_out_scores(
    directions: np.ndarray,
    groups: np.ndarray | None,
    grid: np.ndarray,
    *,
    most: int = 256,
    rng: np.random.Generator | None = None,
) -> np.ndarray:
    """Mean log-likelihood a ray at each κ of ``grid`` (K,), natural, of 1/sr: Σ_i log mean_j f(x_i; x_j, κ) / n.

    j runs over rays of other ``groups`` (n,) where there are two or more, else over j ≠ i. Leaving out people and not
    only the ray itself matters at 50 Hz: successive rays repeat each other, and the sharpest κ would win.
    ``directions`` (n, 3) unit, at least two; of more than ``most`` a random choice is used.
    """
    rng = rng or np.random.default_rng(0)
    if len(directions) > most:
        chosen = rng.choice(len(directions), most, replace=False)
        directions, groups = directions[chosen], None if groups is None else np.asarray(groups)[chosen]
    if groups is None or len(np.unique(groups)) < 2:
        groups = np.arange(len(directions))
    others = groups[:, None] != groups[None, :]
    apart = vmf.one_minus_cosine(directions[:, None], directions[None, :])
    apart = np.where(others, apart, np.inf)
    nearest = apart.min(axis=1, keepdims=True)
    log_count = np.log(others.sum(axis=1))
    # exp(-κ (a - a_min)) with the nearest taken out: no ray ever has log 0, and single precision suffices.
    beyond = (apart - nearest).astype(np.float32)
    sums = np.array([np.exp(np.float32(-k) * beyond).sum(axis=1) for k in grid], dtype=np.float64)
    return (np.log(sums) - np.multiply.outer(grid, nearest[:, 0]) - log_count).mean(axis=1) + vmf.log_normaliser(grid)


def leave_one_out_kappa(
    directions: np.ndarray,
    groups: np.ndarray | None = None,
    *,
    kappa_max: float = 1000.0,
    most: int = 256,
    rng: np.random.Generator | None = None,
) -> float:
    """κ between 1 and ``kappa_max`` under which rays are best predicted by the others; 1 for a ray alone."""
    if len(directions) < 2:
        return KAPPA_MIN
    grid = kappa_grid(kappa_max)
    return float(grid[int(np.argmax(leave_one_out_scores(directions, groups, grid, most=most, rng=rng)))])


def loo_kappas(
    directions: np.ndarray,
    persons: np.ndarray,
    offsets: np.ndarray,
    kappa_max: float,
    shared: bool,
    rng: np.random.Generator,
) -> np.ndarray:
    """κ (P,) of probes that hold ``directions[offsets[p]:offsets[p + 1]]`` by ``loo``. ``shared``: one for all, under
    which the rays of 256 probes (at random) are best predicted together."""
    runs = [slice(a, b) for a, b in zip(offsets[:-1], offsets[1:])]
    if not shared:
        return np.array([leave_one_out_kappa(directions[r], persons[r], kappa_max=kappa_max, rng=rng) for r in runs])
    grid, total = kappa_grid(kappa_max), 0.0
    for p in rng.permutation(len(runs))[:PROBES]:
        if runs[p].stop - runs[p].start > 1:
            total = total + leave_one_out_scores(directions[runs[p]], persons[runs[p]], grid, rng=rng)
    best = grid[int(np.argmax(total))] if np.ndim(total) else KAPPA_MIN
    return np.full(len(runs), float(best))


def silverman_kappas(
    directions: np.ndarray, weights: np.ndarray | None, offsets: np.ndarray, kappa_max: float, shared: bool
) -> np.ndarray:
    """κ (P,) by the published code's rule, at most ``kappa_max``; with ``weights`` (n,) from the weighted mean
    resultant and the effective count (Σw)²/Σw². ``shared``: one for all, 1 over the mean of the squared bandwidths
    1/κ."""
    w = np.ones(len(directions)) if weights is None else weights
    total = np.add.reduceat(w, offsets[:-1])
    count = total**2 / np.add.reduceat(w**2, offsets[:-1])
    resultant = np.linalg.norm(np.add.reduceat(w[:, None] * directions, offsets[:-1]), axis=1) / total
    kappa = np.minimum(vmf.silverman_kappa(np.minimum(resultant, 1.0), np.maximum(count, 1.0)), kappa_max)
    return np.full(len(kappa), 1.0 / np.mean(1.0 / kappa)) if shared else kappa
