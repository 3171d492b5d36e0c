"""Viewpoints of a report and paths of its participants.

The viewpoints are recorded positions or, without rays, free positions in the scene.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.environment.sampler import GazeSampler
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.tracking.rays import Rays

from .data import MAX_PATH_POINTS, farthest_point_sampling

PANORAMAS = 8
"""Number of panoramas from which the 3D view is built."""

# Grid cells along the longer side when looking for free positions, and rays around each position.
_CELLS, _AROUND = 14, 64
# Minimum distance of a free position to surfaces, as a fraction of the scene's height.
_FREE = 0.1
# A path is interrupted by a longer pause, in seconds, or a longer step, in metres.
_PAUSE, _STEP = 2.0, 2.0
# Resolution of drawn paths in metres.
_STRIDE = 0.15


def panorama_positions(standing: np.ndarray, observer: np.ndarray, count: int = PANORAMAS) -> np.ndarray:
    """Return up to ``count`` viewpoints (K, 3): the ``observer`` (3,), and those of ``standing`` (N, 3) that are
    farthest apart."""
    farthest = standing[farthest_point_sampling(standing, count - 1, first=observer)]
    return np.concatenate([np.asarray(observer, float)[None], farthest])


def find_free_positions(
    sampler: GazeSampler, box: tuple[np.ndarray, np.ndarray], up: np.ndarray, observer: np.ndarray
) -> np.ndarray:
    """Return free positions (N, 3) on a grid at the height of the ``observer`` (3,) within a ``box``.

    A position is free if it is far enough from surfaces, and if there are surfaces in most directions.
    """
    lower, upper = (np.asarray(c, float) for c in box)
    level = int(np.argmax(np.abs(up)))
    edges = upper - lower
    step = float(np.delete(edges, level).max()) / _CELLS
    axes = [np.arange(a + step / 2, b, step) for a, b in zip(lower, upper)]
    axes[level] = np.array([np.asarray(observer, float)[level]])
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    directions = fibonacci_directions(_AROUND)
    depth, hit = sampler.trace(np.repeat(grid, _AROUND, axis=0), np.tile(directions, (len(grid), 1)))
    depth, hit = depth.reshape(-1, _AROUND), hit.reshape(-1, _AROUND)
    near = np.where(hit, depth, np.inf).min(axis=1)
    return grid[(near > _FREE * edges[level]) & (hit.mean(axis=1) > 0.5)]


def count_participants_near(
    rays: Rays, viewpoints: np.ndarray, environment: Environment, radius: float
) -> tuple[int, ...]:
    """Count the participants with a ray within ``radius`` metres of each of the ``viewpoints`` (P, 3)."""
    from scipy.spatial import KDTree

    neighbours = KDTree(environment.points_to_field(rays.origin)).query_ball_point(
        viewpoints, radius * environment.align.scale
    )
    return tuple(len(np.unique(rays.person[rows])) for rows in neighbours)


def collect_paths(rays: Rays, environment: Environment) -> list[np.ndarray]:
    """Return the paths of participants, (n, 3) each, in scene coordinates, interrupted where there are no rays.

    If there are more than a page can hold, evenly selected ones are returned.
    """
    parts = []
    for person in np.unique(rays.person):
        person_rows = np.flatnonzero(rays.person == person)
        person_rows = person_rows[np.argsort(rays.t[person_rows], kind="stable")]
        jump = np.diff(rays.t[person_rows]) > _PAUSE
        jump |= np.linalg.norm(np.diff(rays.origin[person_rows], axis=0), axis=1) > _STEP
        parts += [rows for rows in np.split(person_rows, np.flatnonzero(jump) + 1) if len(rows) > 1]
    walked = [path for path in (_simplify_path(rays.origin[rows]) for rows in parts) if len(path) > 1]
    total = sum(map(len, walked))
    if total > MAX_PATH_POINTS:
        # Evenly selected paths, and no more than fit.
        count = max(1, len(walked) * MAX_PATH_POINTS // total)
        walked = [walked[k] for k in np.linspace(0, len(walked) - 1, count).astype(int)]
        ends = np.cumsum([len(path) for path in walked])
        walked = [path for path, end in zip(walked, ends) if end <= MAX_PATH_POINTS] or [walked[0][:MAX_PATH_POINTS]]
    return [environment.points_to_field(path) for path in walked]


def _simplify_path(points: np.ndarray) -> np.ndarray:
    """Return those of ``points`` (N, 3) at which a path enters another cube of edge `_STRIDE`."""
    cell = np.floor(points / _STRIDE)
    return points[np.r_[True, (cell[1:] != cell[:-1]).any(axis=1)]]
