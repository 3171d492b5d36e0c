"""The frame of the directions, by walking: people look ahead."""

from __future__ import annotations

import numpy as np

from nerg_mi.rays.filters import time_order
from nerg_mi.rays.rays import Rays

from .figures import to_source

_AHEAD = 0.2  # correlation of gaze and walking along an axis
_WALKED = 1 << 19, 1 << 11  # rays looked at in runs of so many, where it matters which comes after which


def check_walking(rays: Rays, order: np.ndarray | None) -> list[str]:
    agree = walking_agreement(rays, order)
    if agree is None:
        return []
    against = [i for i in range(3) if agree[i] < -_AHEAD]
    along = [i for i in range(3) if agree[i] > _AHEAD]
    if against and not along:
        return [
            "people look back to where they came from: are the directions reversed? "
            "(--forward, or the sign of the direction)"
        ]
    if against:
        return [
            f"along {' and '.join('xyz'[i] for i in against)} of the file people look away from where they walk: "
            "are positions and directions mirrored against each other? (--hand)"
        ]
    return []


def walking_agreement(rays: Rays, order: np.ndarray | None = None) -> np.ndarray | None:
    """Correlation of gaze with walking along each axis of the file, (3,), 0 along the up axis; ``None`` where nobody
    walks.

    Steps of half a second, at 0.3 to 3 m/s. People look ahead: far above zero along each axis on which they walk.
    ``order``: `filters.time_order` of the rays, if it is known. Of millions of rays, runs of some thousands are looked
    at.
    """
    order = time_order(rays) if order is None else order
    n, (most, run) = len(rays), _WALKED
    if n <= most:
        rows = np.arange(n)
    else:
        first = np.linspace(0, n - run, most // run).astype(np.int64)
        rows = (first[:, None] + np.arange(run)).ravel()
    order = rows if order is None else order[rows]
    t, person = rays.t[order], rays.person[order]
    starts = np.r_[np.flatnonzero(np.r_[True, np.diff(person) != 0]), len(t)]
    later = np.minimum(np.arange(len(t)) + _lag(t, starts), len(t) - 1)
    dt = t[later] - t
    same = (person[later] == person) & (dt > 0) & (dt < 2.0)
    moved = (rays.origin[order[later]] - rays.origin[order])[same]
    moved[:, 2] = 0
    speed = np.linalg.norm(moved, axis=1) / dt[same]
    walks = (speed > 0.3) & (speed < 3.0)
    if walks.sum() < 200:
        return None
    R = to_source(rays)
    d = rays.direction[order[same]][walks] * (1, 1, 0)
    v, d = moved[walks] / np.linalg.norm(moved[walks], axis=1, keepdims=True) @ R.T, d @ R.T
    norm = np.sqrt((v**2).mean(axis=0) * (d**2).mean(axis=0))
    # An axis on which hardly anybody walks says nothing.
    share = (v**2).mean(axis=0)
    return np.where(share > 0.05, (v * d).mean(axis=0) / np.maximum(norm, 1e-12), 0.0)


def _lag(t: np.ndarray, starts: np.ndarray) -> int:
    """Rays in half a second."""
    step = np.diff(t)
    step[starts[1:-1] - 1] = np.inf
    step = step[(step > 0) & (step <= 1.0)]
    return max(1, round(0.5 / np.median(step))) if step.size else 1
