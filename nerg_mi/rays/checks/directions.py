"""The frame of the directions.

A mirrored or reversed direction shows where it disagrees with the hit point, or with where people walk: people look
ahead. A frame mirrored as a whole, positions with directions, contradicts nothing and cannot be seen without the place
itself.
"""

from __future__ import annotations

import itertools

import numpy as np

from nerg_mi.rays.rays import Rays

from .figures import ENOUGH, MOST, Figures, name_some, to_source
from .protocol import check
from .walking import find_against_walking

_OFF = 5.0, 10.0  # degrees between direction and hit point: of half of the rays, and of some
_SOME = 0.05  # share of the rays that are some
_NEAR = 0.2  # metres: directions to nearer hit points say little
_FEW = 20  # hit points from which on they are asked
_STEEP = 50.0  # degrees up or down


@check(
    "directions that miss the hit points, with the signs that would mend them; where there are none, directions away "
    "from where people walk, and steep gaze (`--hand`, `--forward`)"
)
def check_directions(figures: Figures) -> list[str]:
    """The frame of the directions: by the hit points or, where these tell nothing, by steep gaze and by walking."""
    return _check_hits(figures.rays) or [*_check_elevation(figures.rays), *find_against_walking(figures)]


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
    to_hit, d, person = to_hit[far] / length[far, None], rays.direction[some][far] @ R.T, rays.person[some][far]
    angles = lambda v: np.degrees(np.arccos(np.clip(np.sum(v * to_hit, axis=1), -1, 1)))
    found = angles(d)
    off, whose = np.ones(len(d), bool), "the directions miss"
    if not np.median(found) > _OFF[0]:
        off = found > _OFF[1]
        if not off.mean() > _SOME:
            return []
        wrong = np.bincount(person, weights=off) > 0.5 * np.maximum(np.bincount(person), 1)
        of = f" of {name_some([rays.persons[p] for p in np.flatnonzero(wrong)])}" if wrong.any() else ""
        whose = (
            f"{100 * off.mean():.0f} % of the directions, those{of}, miss"
            if of
            else (f"{100 * off.mean():.0f} % of the directions miss")
        )
    now = float(np.median(found[off]))
    signs = np.array(list(itertools.product((1.0, -1.0), repeat=3)))[1:]
    tried = {" and ".join("xyz"[i] for i in np.flatnonzero(s < 0)): float(np.median(angles(d * s)[off])) for s in signs}
    best = min(tried, key=tried.__getitem__)
    remedy = "check that they are of one frame and one unit"
    if tried[best] < min(_OFF[0], 0.5 * now):
        remedy = f"with {best} of the directions negated they would, to {tried[best]:.2g}: check their frame"
    return [f"{whose} the hit points by {now:.0f} degrees (median); {remedy}"]


def _check_elevation(rays: Rays) -> list[str]:
    elevation = np.degrees(np.arcsin(np.clip(rays.direction[:: max(1, len(rays) // MOST), 2], -1, 1)))
    median = np.median(elevation)
    if abs(median) <= _STEEP or len(rays) < ENOUGH:
        return []
    return [
        f"half of the rays look more than {abs(median):.0f} degrees {'up' if median > 0 else 'down'}: "
        "check the axes of the directions, or which way is forward"
    ]
