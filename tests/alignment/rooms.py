"""Test scene: a small asymmetric room with a block, and participants in it."""

from __future__ import annotations

import numpy as np

from nerg_mi.alignment.constraints import SceneTraces
from nerg_mi.tracking.rays import Rays

BOXES = np.array([[(0.9, 0.7, 0), (1.7, 2.9, 1.2)], [(2.6, 0, 0), (4.0, 0.8, 2.0)]])
"""Solid blocks, lower and upper corners; the room is (0, 0, 0) to `SIZE`."""
SIZE = np.array([4.0, 3.2, 2.5])


def cast(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance (N,) to the room's shell or a block, whichever is nearer: the slab method in float64."""
    with np.errstate(divide="ignore"):
        out = np.where(directions > 0, (SIZE - origins) / directions, -origins / directions).min(axis=1)
        for low, high in BOXES:
            a, b = (low - origins) / directions, (high - origins) / directions
            near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            out = np.where((near <= far) & (near > 0), np.minimum(out, near), out)
    return out


def free(points: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Return whether points (N, 3) are in the room and outside all blocks."""
    inside = ((points > margin) & (points < SIZE - margin)).all(axis=1)
    for low, high in BOXES:
        inside &= ~((points > low - margin) & (points < high + margin)).all(axis=1)
    return inside


def directions(count: int, rng: np.random.Generator) -> np.ndarray:
    d = rng.normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def traces(count: int = 40_000) -> SceneTraces:
    """Return traces of rays from free space."""
    rng = np.random.default_rng(3)
    begin = rng.uniform(0, SIZE, (2 * count, 3))
    begin = begin[free(begin)][:count]
    along = directions(len(begin), rng)
    return SceneTraces(begin, begin + along * cast(begin, along)[:, None], np.ones(len(begin), bool))


def people(count: int = 3000, noise: float = 0.01) -> Rays:
    """Return samples of heads in free space at 1.6 m, with hit points."""
    rng = np.random.default_rng(4)
    heads = rng.uniform((0, 0, 1.55), (*SIZE[:2], 1.7), (4 * count, 3))
    heads = heads[free(heads, 0.15)][:count]
    d = directions(len(heads), rng) * (1, 1, 0.5)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    hit = heads + d * cast(heads, d)[:, None] + rng.normal(0, noise, heads.shape)
    n = len(heads)
    return Rays(np.arange(n) / 10, np.arange(n) % 12, tuple("abcdefghijkl"), heads, d, np.ones(n), hit)


def similarity(rng: np.random.Generator, upright: bool = False, scale: float | None = None) -> np.ndarray:
    """Return a random similarity (4, 4)."""
    w, x, y, z = q = rng.normal(size=4) * ((1, 0, 0, 1) if upright else 1)
    n = q @ q
    rows = (
        (n - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), n - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), n - 2 * (x * x + y * y)),
    )
    turn = np.array(rows) / n
    out = np.eye(4)
    out[:3, :3] = (np.exp(rng.uniform(-1, 1)) if scale is None else scale) * turn
    out[:3, 3] = rng.normal(0, 5, 3)
    return out


def carried(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Transform points by a matrix in homogeneous coordinates."""
    return (np.c_[points, np.ones(len(points))] @ matrix.T)[:, :3]
