"""Directions over the sphere, many where there is much to see: a sum over them integrates narrow densities too.

Rings of cells that are about as wide as high are cut again by what a density has in their middles, so that all
directions stand for about as much of it. What a part of the sphere with an outline receives has then an error that
falls with their number alone, and not with how narrow the density is. The rings lie askew in the scene: along its axes
they would be parallel to the outlines of upright things, which would fall between the same two directions everywhere.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

CELLS = 1 << 14
"""Cells of the first cut, 1.6 degrees wide: narrower densities may be missed."""

_FINEST = 64
# Any turn that makes no axis of the scene lie along a ring.
_ASKEW = np.linalg.qr(np.array([[0.61, -0.37, 0.42], [0.29, 0.83, -0.31], [-0.53, 0.17, 0.71]]))[0]


def sphere_rule(
    density: Callable[[np.ndarray], np.ndarray], count: int, cells: int = CELLS
) -> tuple[np.ndarray, np.ndarray]:
    """About ``count`` unit directions (N, 3), some more, and the solid angle (N,) of each in steradian, 4π together.

    ``density`` of unit directions (M, 3) gives values (M,), not negative. Raises ``ValueError`` for no directions.
    """
    if count < 1 or cells < 1:
        raise ValueError(f"a rule has a direction and a cell at least, got {count} and {cells}")
    top, bottom, turn, width = _cells(cells)
    area = (top - bottom) * width
    mass = area * density(_directions(0.5 * (top + bottom), turn + 0.5 * width))
    share = mass / mass.sum() if mass.sum() > 0 else area / (4 * np.pi)
    parts = np.clip(np.ceil(np.sqrt(count * share)), 1, _FINEST).astype(np.int64)
    directions, angles = [], []
    for n in np.unique(parts):
        of = np.flatnonzero(parts == n)[:, None, None]
        at = (np.arange(n) + 0.5) / n
        z = bottom[of] + (top - bottom)[of] * at[:, None]
        phi = turn[of] + width[of] * at
        directions.append(_directions(*(np.ravel(v) for v in np.broadcast_arrays(z, phi))))
        angles.append(np.repeat(area[of.ravel()] / n**2, n * n))
    return np.concatenate(directions), np.concatenate(angles)


def _cells(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Heights of the upper and the lower edge of each cell, its first azimuth, and how many radian it spans."""
    rings = max(1, round(np.sqrt(np.pi * count / 4)))
    z = np.cos(np.pi * np.arange(rings + 1) / rings)
    around = np.maximum(1, np.rint(2 * rings * np.sin(np.pi * (np.arange(rings) + 0.5) / rings))).astype(np.int64)
    ring = np.repeat(np.arange(rings), around)
    number = np.arange(len(ring)) - np.repeat(np.cumsum(around) - around, around)
    width = 2 * np.pi / around[ring]
    return z[ring], z[ring + 1], number * width, width


def _directions(z: np.ndarray, phi: np.ndarray) -> np.ndarray:
    r = np.sqrt(np.maximum((1 - z) * (1 + z), 0))
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1) @ _ASKEW.T
