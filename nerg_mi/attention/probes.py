"""Gaze probes: what people looked at from around a position.

A probe gathers the rays whose origins lie within R of a position and turns
their directions into a density on the sphere (NeRG, Section 5.1).
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import vmf
from .kde import SphericalKde
from .rays import Rays

KAPPA_RULES = ("silverman", "loo", "fixed")
PLACEMENTS = ("data", "grid", "random")


@dataclass(frozen=True, eq=False)
class Probes:
    """P probes and the rays they hold.

    ``positions`` (P, 3) metres, where the density is said to hold; ``queries``
    (P, 3), the centres of the searched balls of ``radius`` metres; probe p holds
    the rays ``indices[offsets[p]:offsets[p + 1]]`` of the set it was made from,
    nearest first, with unit ``directions`` (n, 3) in the same order; ``kappa``
    (P,); ``weights`` (n,) or ``None`` for equal ones.
    """

    positions: np.ndarray
    queries: np.ndarray
    radius: float
    indices: np.ndarray
    offsets: np.ndarray
    directions: np.ndarray
    kappa: np.ndarray
    weights: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def counts(self) -> np.ndarray:
        """Rays in each probe, (P,)."""
        return np.diff(self.offsets)

    def kde(self, backend: object = None) -> SphericalKde:
        """The densities as a Dr.Jit object, for evaluation inside kernels."""
        return SphericalKde(self.directions, self.offsets, self.kappa, self.weights, backend)

    def density(self, directions: np.ndarray, backend: object = None) -> np.ndarray:
        """Densities (P, D) float32 in 1/sr at ``directions`` (D, 3) or (P, D, 3),
        unit. Each integrates to one over the sphere."""
        return self.kde(backend).evaluate(directions)


def place_probes(
    rays: Rays,
    radius: float = 0.25,
    *,
    placement: str = "data",
    count: int = 4096,
    queries: np.ndarray | None = None,
    spacing: float | None = None,
    cap: int = 1024,
    min_rays: int = 64,
    kappa_rule: str = "silverman",
    kappa: float = 20.0,
    kappa_max: float = 1000.0,
    centre: str = "mean",
    seed: int = 0,
) -> Probes:
    """Probes on a set of rays.

    ``radius``: R in metres (the paper: 0.1 m at 2.6 million rays; with some
    10^5 rays 0.25 m). ``placement``: ``data`` at ``count`` distinct random ray
    origins; ``grid`` on a lattice of ``spacing`` metres (default 2R) over the
    origins' box; ``random`` uniform in that box; or explicit ``queries`` (P, 3).
    A query with fewer than ``min_rays`` rays makes no probe; of more than
    ``cap`` the nearest are kept (the published code: 8 and 4,096).

    ``kappa_rule``: ``silverman`` (the published code's), ``fixed`` (``kappa``)
    or ``loo`` (likelihood of each ray under those of *other people* where there
    are any, else under the other rays). ``kappa_max`` bounds the first and last:
    a person who stares makes a spike that no few thousand directions resolve.

    ``centre``: where the density is said to hold. ``mean``, the mean of the
    rays' origins, as in the published code and by default: it is where people
    stood, also at the edge of where they walk. ``query``: the ball's centre, as
    in the paper's text. The two differ by less than R.

    Raises ``ValueError`` for unknown words, or when no query holds enough rays.
    """
    _check_one_of("placement", placement, PLACEMENTS)
    _check_one_of("kappa_rule", kappa_rule, KAPPA_RULES)
    _check_one_of("centre", centre, ("mean", "query"))
    if not radius > 0 or min_rays < 1 or cap < min_rays:
        raise ValueError(f"radius {radius}, min_rays {min_rays}, cap {cap}: need radius > 0 and 1 <= min_rays <= cap")
    rng = np.random.default_rng(seed)
    if queries is None:
        queries = _queries(rays.origin, placement, count, spacing or 2.0 * radius, rng)
    queries = np.asarray(queries, dtype=np.float64).reshape(-1, 3)

    from scipy.spatial import cKDTree

    tree = cKDTree(rays.origin)
    within = tree.query_ball_point(queries, radius, return_length=True)
    # A block of queries at a time: the neighbours of thousands are millions.
    kept, runs = np.flatnonzero(within >= min_rays), []
    most = int(min(cap, within.max(initial=1)))
    block = max(1, (1 << 20) // most)
    for start in range(0, len(kept), block):
        which = kept[start : start + block]
        # A hair more than R, so that rounding loses none of those counted; the
        # nearest so many are they.
        bound = radius * (1.0 + 1e-9)
        _, found = tree.query(queries[which], k=np.arange(1, most + 1), distance_upper_bound=bound)
        runs += [near[: min(count, most)] for near, count in zip(found, within[which])]
    if not len(kept):
        raise ValueError(
            f"none of {len(queries)} probes holds {min_rays} rays within {radius} m; enlarge the radius or lower min_rays"
        )

    queries = queries[kept]
    counts = np.array([len(r) for r in runs])
    offsets = np.concatenate([[0], np.cumsum(counts)])
    indices = np.concatenate(runs)
    directions = rays.direction[indices]
    means = np.add.reduceat(rays.origin[indices], offsets[:-1]) / counts[:, None]
    if kappa_rule == "fixed":
        kappas = np.full(len(kept), float(kappa))
    elif kappa_rule == "silverman":
        resultant = np.linalg.norm(np.add.reduceat(directions, offsets[:-1]), axis=1) / counts
        kappas = np.minimum(vmf.silverman_kappa(np.minimum(resultant, 1.0), counts), kappa_max)
    else:
        kappas = np.array([leave_one_out_kappa(rays.direction[r], rays.person[r], kappa_max=kappa_max, rng=rng) for r in runs])
    return Probes(means if centre == "mean" else queries, queries, float(radius), indices, offsets, directions, kappas)


def leave_one_out_kappa(
    directions: np.ndarray,
    groups: np.ndarray | None = None,
    *,
    kappa_min: float = 1.0,
    kappa_max: float = 1000.0,
    most: int = 256,
    rng: np.random.Generator | None = None,
) -> float:
    """κ under which rays are best predicted by the others.

    Maximises Σ_i log mean_j f(x_i; x_j, κ) over a geometric grid (25 % steps),
    j running over rays of other ``groups`` (n,) where there are two or more,
    else over j ≠ i. Leaving out people and not only the ray itself matters at
    50 Hz: successive rays repeat each other, and the sharpest κ would win.
    ``directions`` (n, 3) unit; of more than ``most`` a random choice is used.
    """
    rng = rng or np.random.default_rng(0)
    if len(directions) < 2:
        return kappa_min
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
    grid = np.geomspace(kappa_min, kappa_max, max(2, 1 + round(np.log(kappa_max / kappa_min) / np.log(1.25))))
    # exp(-κ (a - a_min)) with the nearest taken out: no ray ever has log 0.
    score = [
        np.sum(np.log(np.exp(-k * (apart - nearest)).sum(axis=1)) - k * nearest[:, 0] - log_count) + len(apart) * vmf.log_normaliser(k)
        for k in grid
    ]
    return float(grid[int(np.argmax(score))])


def _queries(origin: np.ndarray, placement: str, count: int, spacing: float, rng: np.random.Generator) -> np.ndarray:
    if placement == "data":
        return origin[rng.choice(len(origin), min(count, len(origin)), replace=False)]
    low, high = origin.min(axis=0), origin.max(axis=0)
    if placement == "random":
        return rng.uniform(low, high, (count, 3))
    # The lattice is centred in the box, so that it does not favour one wall.
    axes = []
    for a, b in zip(low, high):
        n = max(1, int(np.floor((b - a) / spacing)) + 1)
        axes.append(0.5 * (a + b) + spacing * (np.arange(n) - 0.5 * (n - 1)))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _check_one_of(name: str, value: str, words: tuple[str, ...]) -> None:
    if value not in words:
        raise ValueError(f'{name} is "{value}"; it is one of {", ".join(words)}')
