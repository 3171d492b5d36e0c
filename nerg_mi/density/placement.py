"""Where probes stand: on a lattice, at random, where people were, or there and evenly (blue noise)."""

from __future__ import annotations

import numpy as np

from nerg_mi.errors import NergError


def place_queries(
    origin: np.ndarray, placement: str, count: int, spacing: float | None, radius: float, rng: np.random.Generator
) -> np.ndarray:
    """Centres (Q, 3) of probes of ``radius`` R among ray origins (N, 3), metres, by one of `PLACEMENTS`.

    ``data``: ``count`` distinct ray origins at random. ``grid``: a lattice of ``spacing`` (2R) over the origins' box.
    ``random``: ``count`` places uniform in that box. ``blue``: at most ``count`` ray origins, none nearer to another
    than ``spacing``; without one, than the smallest distance from R on at which they are no more. Raises `NergError`
    for another word.
    """
    if placement not in PLACEMENTS:
        raise NergError(f'placement is "{placement}"; it is one of {", ".join(PLACEMENTS)}')
    return PLACEMENTS[placement](origin, count, spacing, radius, rng)


def _origins(
    origin: np.ndarray, count: int, spacing: float | None, radius: float, rng: np.random.Generator
) -> np.ndarray:
    return origin[rng.choice(len(origin), min(count, len(origin)), replace=False)]


def _lattice(
    origin: np.ndarray, count: int, spacing: float | None, radius: float, rng: np.random.Generator
) -> np.ndarray:
    # Centred in the box, so that it does not favour one wall.
    spacing = spacing or 2.0 * radius
    axes = []
    for a, b in zip(origin.min(axis=0), origin.max(axis=0)):
        n = max(1, int(np.floor((b - a) / spacing)) + 1)
        axes.append(0.5 * (a + b) + spacing * (np.arange(n) - 0.5 * (n - 1)))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _uniform(
    origin: np.ndarray, count: int, spacing: float | None, radius: float, rng: np.random.Generator
) -> np.ndarray:
    return rng.uniform(origin.min(axis=0), origin.max(axis=0), (count, 3))


def blue_noise(
    origin: np.ndarray, count: int, spacing: float | None, radius: float, rng: np.random.Generator
) -> np.ndarray:
    """Ray origins in random order, each taken if none taken before is within ``spacing`` (Poisson discs by dart
    throwing).

    Without a ``spacing``: from ``radius`` on, ever wider until no more than ``count`` are left.
    """
    if spacing is not None:
        found = _darts(origin, spacing, rng)
        return found[rng.permutation(len(found))[:count]]
    spacing = radius
    while len(found := _darts(origin, spacing, rng)) > count:
        spacing *= max(1.02, (len(found) / count) ** 0.4)
    return found


PLACEMENTS = {"data": _origins, "grid": _lattice, "random": _uniform, "blue": blue_noise}
"""How queries are placed, by name: functions of the arguments of `place_queries` without the name."""


def _darts(origin: np.ndarray, spacing: float, rng: np.random.Generator) -> np.ndarray:
    from scipy.spatial import KDTree

    # One candidate for each cell much smaller than the discs: of millions of origins some ten thousand.
    cell = np.floor((origin - origin.min(axis=0)) / (0.25 * spacing)).astype(np.int64)
    order = rng.permutation(len(origin))
    size = cell.max(axis=0) + 1
    key = (cell[order, 0] * size[1] + cell[order, 1]) * size[2] + cell[order, 2]
    candidates = origin[order[np.sort(np.unique(key, return_index=True)[1])]]
    tree = KDTree(candidates)
    free = np.ones(len(candidates), bool)
    taken = []
    for i, place in enumerate(candidates):
        if free[i]:
            taken.append(i)
            free[tree.query_ball_point(place, spacing)] = False
    return candidates[taken]
