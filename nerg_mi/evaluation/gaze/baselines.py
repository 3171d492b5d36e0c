"""What a gaze field must beat: densities without a field.

Each baseline is a function ``(positions (P, 3), directions) -> (P, D)`` of
densities in 1/sr that integrate to one; ``directions`` is (D, 3) for all
positions or (P, D, 3). All share the kernels of :mod:`nerg_mi.probes.kde`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from nerg_mi.probes.kde import Backend, SphericalKde
from nerg_mi.probes.probes import Probes, place_probes
from nerg_mi.rays.rays import Rays

Baseline = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Densities (P, D), 1/sr, of positions (P, 3) in directions (D, 3) or (P, D, 3)."""

UNIFORM = 1.0 / (4.0 * np.pi)  # 1/sr
# Points in a leaf of a KD-tree, which decides the order of those that are equally far, and so the last bits of sums.
_LEAF = 16


class Remembered:
    """A function of positions and directions that is not asked twice for the same two arrays: its answers are kept, and
    cannot be written to. Neither may the arrays change."""

    def __init__(self, method: Baseline):
        self._method = method
        self._answers: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def __call__(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        for p, d, answer in self._answers:
            if p is positions and d is directions:
                return answer
        answer = np.asarray(self._method(positions, directions))
        answer.setflags(write=False)
        self._answers.append((positions, directions, answer))
        return answer


def uniform() -> Baseline:
    """The density that knows nothing: 1/(4π) everywhere."""

    def evaluate(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        return np.full((len(np.atleast_2d(positions)), np.shape(directions)[-2]), UNIFORM)

    return evaluate


def position_blind(rays: Rays, *, kappa: float = 50.0, backend: Backend = None) -> Baseline:
    """One density for all positions: the KDE of all training rays, with ``kappa``
    (what people look at wherever they stand)."""
    # Runs of rays are separate mixtures averaged in float64: one sum of 10^5
    # terms in float32 would lose digits, and a lane alone would take it all.
    runs = np.array_split(np.arange(len(rays)), max(1, len(rays) // 4096))
    offsets = np.concatenate([[0], np.cumsum([len(r) for r in runs])])
    kde = SphericalKde(rays.direction, offsets, kappa, backend=backend)
    share = np.diff(offsets) / len(rays)

    def evaluate(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        P = len(np.atleast_2d(positions))
        directions = np.asarray(directions)
        density = share @ kde.evaluate(directions.reshape(-1, 3)).astype(np.float64)
        return np.broadcast_to(density, (P, len(density))) if directions.ndim == 2 else density.reshape(P, -1)

    return evaluate


def nearest_probes(probes: Probes, k: int = 16, *, backend: Backend = None) -> Baseline:
    """Mean density of the ``k`` training probes nearest to a position; k = 1 is
    the nearest probe. Fewer where there are fewer probes."""
    from scipy.spatial import KDTree

    tree = KDTree(probes.positions, leafsize=_LEAF)
    k = min(k, len(probes))
    rays = [np.arange(a, b) for a, b in zip(probes.offsets[:-1], probes.offsets[1:])]

    def evaluate(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        found = _nearest(tree, np.atleast_2d(positions), k)
        # The probes used, once each when the directions are common to all.
        if np.ndim(directions) == 2:
            used, back = np.unique(found, return_inverse=True)
            density = _some(probes, rays, used, backend).evaluate(directions)
            return _mean_rows(density, back.reshape(found.shape))
        density = [
            _some(probes, rays, near, backend).evaluate(d).mean(axis=0, dtype=np.float64)
            for near, d in zip(found, directions)
        ]
        return np.stack(density)

    return evaluate


def nearest_rays(rays: Rays, k: int = 4096, *, kappa: float = 20.0, backend: Backend = None) -> Baseline:
    """KDE of the ``k`` training rays whose origins are nearest to a position: a
    probe without a radius, hard to beat where rays are many."""
    from scipy.spatial import KDTree

    tree = KDTree(rays.origin, leafsize=_LEAF)
    k = min(k, len(rays))

    def evaluate(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        positions, directions = np.atleast_2d(positions), np.asarray(directions)
        out = []
        for start in range(0, len(positions), 64):  # 64 x 4,096 rays at a time
            found = _nearest(tree, positions[start : start + 64], k)
            kde = SphericalKde(rays.direction[found.ravel()], np.arange(len(found) + 1) * k, kappa, backend=backend)
            out.append(kde.evaluate(directions if directions.ndim == 2 else directions[start : start + 64]))
        return np.concatenate(out)

    return evaluate


def standard_baselines(
    rays: Rays, radius: float, kappa: float = 20.0, blind_kappa: float = 50.0, seed: int = 0, count: int = 2048
) -> tuple[Baseline, dict[str, Baseline]]:
    """``(blind, baselines)``: the density that information is counted from, and by name all that a gaze field is shown
    beside: uniform, position-blind, nearest probes and nearest rays of the training ``rays``, with kernels of
    ``kappa``."""
    probes = place_probes(
        rays, radius, count=count, min_rays=min(64, len(rays)), kappa_rule="fixed", kappa=kappa, seed=seed
    )
    blind = position_blind(rays, kappa=blind_kappa)
    return blind, {
        "uniform": uniform(),
        "position-blind": position_blind(rays, kappa=kappa),
        f"position-blind, kappa {blind_kappa:g}": blind,
        "nearest probe": nearest_probes(probes, 1),
        "16 nearest probes": nearest_probes(probes, 16),
        "4,096 nearest rays": nearest_rays(rays, 4096, kappa=kappa),
    }


def _nearest(tree: Any, positions: np.ndarray, k: int) -> np.ndarray:
    """Indices (P, k) of the ``k`` points of a KD-tree that are nearest to each of ``positions`` (P, 3)."""
    return tree.query(positions, k=np.arange(1, k + 1))[1]


def _some(probes: Probes, rays: list[np.ndarray], which: np.ndarray, backend: Backend) -> SphericalKde:
    """The densities of the probes ``which`` of ``probes``, whose rays are at ``rays``."""
    runs = [rays[p] for p in which]
    offsets = np.concatenate([[0], np.cumsum([len(r) for r in runs])])
    flat = np.concatenate(runs)
    weights = None if probes.weights is None else probes.weights[flat]
    return SphericalKde(probes.directions[flat], offsets, probes.kappa[which], weights, backend)


def _mean_rows(density: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Mean (P, D) of the ``rows`` (P, k) of ``density`` (n, D)."""
    return np.stack([density[r].mean(axis=0, dtype=np.float64) for r in rows])
