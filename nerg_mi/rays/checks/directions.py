"""The frame of the directions.

A mirrored or reversed direction shows where it disagrees with the hit point, or with where people walk: people look
ahead. A frame mirrored as a whole, positions with directions, contradicts nothing and cannot be seen without the place
itself.
"""

from __future__ import annotations

import itertools

import numpy as np

from nerg_mi.rays.rays import Rays

from .figures import MOST, Figures, to_source
from .walking import check_walking

_OFF = 5.0  # degrees between direction and hit point
_NEAR = 0.2  # metres: directions to nearer hit points say little
_FEW = 20  # hit points from which on they are asked
_STEEP = 50.0  # degrees up or down


def check_directions(rays: Rays, figures: Figures) -> list[str]:
    """The frame of the directions: by the hit points or, where these tell nothing, by steep gaze and by walking."""
    return _check_hits(rays) or [*_check_elevation(rays), *check_walking(rays, figures.order)]


def _check_hits(rays: Rays) -> list[str]:
    if rays.hit is None:
        return []
    R = to_source(rays)
    some = np.flatnonzero(np.isfinite(rays.hit).all(axis=1))
    some = some[:: max(1, len(some) // MOST)]
    to_hit = (rays.hit[some] - rays.origin[some]) @ R.T
    length = np.linalg.norm(to_hit, axis=1)
    far = length > _NEAR
    if far.sum() < _FEW:
        return []
    to_hit, d = to_hit[far] / length[far, None], rays.direction[some][far] @ R.T
    angle = lambda v: float(np.median(np.degrees(np.arccos(np.clip(np.sum(v * to_hit, axis=1), -1, 1)))))
    now = angle(d)
    if not now > _OFF:
        return []
    signs = np.array(list(itertools.product((1.0, -1.0), repeat=3)))[1:]
    tried = {" and ".join("xyz"[i] for i in np.flatnonzero(s < 0)): angle(d * s) for s in signs}
    best = min(tried, key=tried.__getitem__)
    remedy = "check that they are of one frame and one unit"
    if tried[best] < min(_OFF, 0.5 * now):
        remedy = f"with {best} of the directions negated they would, to {tried[best]:.2g}: check their frame"
    return [f"the directions miss the hit points by {now:.0f} degrees (median); {remedy}"]


def _check_elevation(rays: Rays) -> list[str]:
    elevation = np.degrees(np.arcsin(np.clip(rays.direction[:: max(1, len(rays) // MOST), 2], -1, 1)))
    median = np.median(elevation)
    if abs(median) <= _STEEP:
        return []
    return [
        f"half of the rays look more than {abs(median):.0f} degrees {'up' if median > 0 else 'down'}: "
        "check the axes of the directions, or which way is forward"
    ]
