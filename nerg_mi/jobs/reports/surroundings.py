"""From where a report looks at its place: eyes of people, or, where nobody was recorded, places where people could
stand; and their paths."""

from __future__ import annotations

import numpy as np

from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.rays.rays import Rays
from nerg_mi.report.data import PATH_POINTS, Onlooker, spread_out
from nerg_mi.train.geometry import GazePlace

PANORAMAS = 8
"""Panoramas that the 3D scene is made of."""

# Cells along the longer side of the grid on which free places are looked for, and rays that look around each.
_CELLS, _AROUND = 14, 64
# A free place has nothing nearer than this share of the place's height at the eye's level.
_FREE = 0.1
# Nobody is followed over a longer pause, in seconds, or step, in metres.
_PAUSE, _STEP = 2.0, 2.0
# Edge of the cubes by which a path is drawn, in metres.
_STRIDE = 0.15


def panorama_eyes(standing: np.ndarray, observer: np.ndarray, count: int = PANORAMAS) -> np.ndarray:
    """Up to ``count`` eyes (K, 3): the ``observer`` (3,), and of the places where people stand (N, 3) those that are
    farthest apart."""
    others = standing[spread_out(standing, count - 1, first=observer)]
    return np.concatenate([np.asarray(observer, float)[None], others])


def free_places(
    onlooker: Onlooker, box: tuple[np.ndarray, np.ndarray], up: np.ndarray, observer: np.ndarray
) -> np.ndarray:
    """Places (N, 3) on the level of the ``observer`` (3,) within a ``box`` (lower and upper corner) where there is
    room, with surfaces in most directions: a grid of them."""
    lower, upper = (np.asarray(c, float) for c in box)
    level = int(np.argmax(np.abs(up)))
    edges = upper - lower
    step = float(np.delete(edges, level).max()) / _CELLS
    axes = [np.arange(a + step / 2, b, step) for a, b in zip(lower, upper)]
    axes[level] = np.array([np.asarray(observer, float)[level]])
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    directions = fibonacci_directions(_AROUND)
    depth, met = onlooker.meet(np.repeat(grid, _AROUND, axis=0), np.tile(directions, (len(grid), 1)))
    depth, met = depth.reshape(-1, _AROUND), met.reshape(-1, _AROUND)
    near = np.where(met, depth, np.inf).min(axis=1)
    return grid[(near > _FREE * edges[level]) & (met.mean(axis=1) > 0.5)]


def company(rays: Rays, eyes: np.ndarray, place: GazePlace, radius: float) -> tuple[int, ...]:
    """How many people have a ray from within ``radius`` metres of each of the ``eyes`` (P, 3) of the place."""
    from scipy.spatial import KDTree

    found = KDTree(place.points_from_rays(rays.origin)).query_ball_point(eyes, radius * place.align.scale)
    return tuple(len(np.unique(rays.person[rows])) for rows in found)


def paths_of(rays: Rays, place: GazePlace) -> list[np.ndarray]:
    """People's paths, (n, 3) each, in the coordinates of the place, with gaps where nobody was followed: of more than a
    page can hold evenly chosen ones."""
    parts = []
    for person in np.unique(rays.person):
        own = np.flatnonzero(rays.person == person)
        own = own[np.argsort(rays.t[own], kind="stable")]
        jump = np.diff(rays.t[own]) > _PAUSE
        jump |= np.linalg.norm(np.diff(rays.origin[own], axis=0), axis=1) > _STEP
        parts += [rows for rows in np.split(own, np.flatnonzero(jump) + 1) if len(rows) > 1]
    walked = [path for path in (_walked(rays.origin[rows]) for rows in parts) if len(path) > 1]
    total = sum(map(len, walked))
    if total > PATH_POINTS:
        # As many whole ones as fit if all are alike, and no more than fit.
        count = max(1, len(walked) * PATH_POINTS // total)
        walked = [walked[k] for k in np.linspace(0, len(walked) - 1, count).astype(int)]
        ends = np.cumsum([len(path) for path in walked])
        walked = [path for path, end in zip(walked, ends) if end <= PATH_POINTS] or [walked[0][:PATH_POINTS]]
    return [place.points_from_rays(path) for path in walked]


def _walked(points: np.ndarray) -> np.ndarray:
    """Those of ``points`` (N, 3) of a path at which it enters another cube of edge `_STRIDE`: somebody who stands is
    one point."""
    cell = np.floor(points / _STRIDE)
    return points[np.r_[True, (cell[1:] != cell[:-1]).any(axis=1)]]
