"""Where people were, by how long: the time of each tracked ray, and a few observers that stand for all of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.rays.rays import Rays
from nerg_mi.rays.sessions import find_sessions

GAP = 0.5
"""Seconds that a ray stands for at most: nobody knows where people were while they were not tracked."""

WEIGHTS = ("time", "person", "equal")
"""Whom rays count by: each by its time; so that all people count alike; each alike."""

_CELLS = 4096
_ROUNDS = 50


@dataclass(frozen=True, eq=False)
class Crowd:
    """Observers at ``positions`` (M, 3), places where somebody was, with ``weights`` (M,) that add up to one. ``mean``
    and ``farthest``: distance from there of where people were, the root of its mean square and 95 % of it."""

    positions: np.ndarray
    weights: np.ndarray
    mean: float = 0.0
    farthest: float = 0.0


def ray_seconds(rays: Rays, gap: float = GAP) -> np.ndarray:
    """Seconds (N,) that each ray stands for: until the next one of the same person and recording, and ``gap`` at most;
    of the last of a recording the median of the others in it."""
    sessions = find_sessions(rays)
    order = np.arange(len(rays)) if sessions.order is None else sessions.order
    out = np.zeros(len(rays))
    for a, b in zip(sessions.starts[:-1], sessions.starts[1:]):
        rows = order[a:b]
        step = np.clip(np.diff(rays.t[rows]), 0, gap)
        out[rows] = np.r_[step, np.median(step) if len(step) else 0.0]
    # One ray alone, or many at one time, tell no length.
    return out if out.sum() > 0 else np.full(len(rays), gap)


def ray_weights(rays: Rays, by: str, gap: float = GAP) -> np.ndarray:
    """Weights (N,) of ``rays`` that add up to one, by one of `WEIGHTS`."""
    seconds = np.ones(len(rays)) if by == "equal" else ray_seconds(rays, gap)
    if by == "person":
        each = np.bincount(rays.person, seconds)
        seconds = seconds / np.where(each > 0, each, 1)[rays.person]
    return seconds / seconds.sum()


def thin(positions: np.ndarray, weights: np.ndarray, count: int, seed: int = 0) -> Crowd:
    """At most ``count`` observers that stand for people who were at ``positions`` (N, 3) by ``weights`` (N,).

    Weighted k-means (S. Lloyd 1982) from starts that are drawn far apart (k-means++, D. Arthur, S. Vassilvitskii 2007),
    on cells of positions; every centre is then moved to the nearest place where somebody was, since the mean of two
    aisles lies in the shelf between them. An observer has the weight of all who are nearest to them.
    """
    from scipy.spatial import KDTree

    weights = np.asarray(weights, np.float64) / np.sum(weights)
    place, mass = _cells(positions, weights)
    if len(place) <= count:
        centers = place
    else:
        rng = np.random.default_rng(seed)
        centers = _spread(place, mass, count, rng)
        for _ in range(_ROUNDS):
            near = KDTree(centers).query(place)[1]
            total = np.bincount(near, mass, len(centers))
            sums = np.stack([np.bincount(near, mass * c, len(centers)) for c in place.T], axis=1)
            moved = np.where(total[:, None] > 0, sums / np.where(total > 0, total, 1)[:, None], centers)
            if np.allclose(moved, centers, rtol=0, atol=1e-6):
                break
            centers = moved
    # The nearest of people's positions, each once.
    standing = positions[np.unique(KDTree(positions, leafsize=16, balanced_tree=False).query(centers)[1])]
    apart, near = KDTree(standing).query(positions)
    total = np.bincount(near, weights, len(standing))
    order = np.argsort(apart, kind="stable")
    far = apart[order][np.searchsorted(np.cumsum(weights[order]), 0.95 * weights.sum()).clip(max=len(apart) - 1)]
    kept = total > 0
    return Crowd(standing[kept], total[kept] / total.sum(), float(np.sqrt((weights * apart**2).sum())), float(far))


def _cells(positions: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means and weights of positions in a grid that grows coarser until it holds some thousand of them."""
    low, size = positions.min(axis=0), float(np.ptp(positions, axis=0).max())
    step = size / 1024
    while True:
        cell = np.floor((positions - low) / step).astype(np.int64) if step > 0 else np.zeros_like(positions, np.int64)
        # Of each axis there are fewer than 2^20 cells: one number sorts faster than three.
        key = cell @ np.array([1 << 40, 1 << 20, 1])
        _, number = np.unique(key, return_inverse=True)
        mass = np.bincount(number, weights)
        if len(mass) <= _CELLS or step == 0:
            break
        step *= 1.5
    sums = np.stack([np.bincount(number, weights * c) for c in positions.T], axis=1)
    known = mass > 0
    return sums[known] / mass[known, None], mass[known]


def _spread(place: np.ndarray, mass: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    chosen = [int(rng.choice(len(place), p=mass / mass.sum()))]
    square = np.square(place - place[chosen[0]]).sum(axis=1)
    while len(chosen) < count and (mass * square).sum() > 0:
        chosen.append(int(rng.choice(len(place), p=mass * square / (mass * square).sum())))
        square = np.minimum(square, np.square(place - place[chosen[-1]]).sum(axis=1))
    return place[chosen]
