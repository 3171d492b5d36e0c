"""Fixations: when gaze rests. I-VT and I-DT of Salvucci and Goldberg (2000), on directions in the world.

Angles are in degrees, times in seconds. A pause of a person longer than ``gap`` ends a fixation. Both return for each
ray the number of its fixation, or -1; numbers run person after person in time.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths import vmf

from .filters import person_order
from .rays import Rays

_GAP = 0.1


def ivt(rays: Rays, velocity: float = 100.0, least: float = 0.06, gap: float = _GAP) -> np.ndarray:
    """By velocity (I-VT): runs of rays that turn no faster than ``velocity`` degrees a second, of ``least`` seconds or
    more.

    The velocity of a ray is that from the one before it (of the first of a run, to the one after). 100 degrees a second
    is for gaze in the world of people who walk and turn, 30 is usual where the head rests. Returns (N,) int64.
    """
    _positive(velocity=velocity, least=least, gap=gap)
    order, starts = person_order(rays)
    t, d = rays.t[order], rays.direction[order]
    step = np.diff(t)
    joined = (step > 0) & (step <= gap)
    joined[starts[1:-1] - 1] = False
    with np.errstate(divide="ignore", invalid="ignore"):
        slow = joined & (_angles(d[1:], d[:-1]) <= velocity * step)
    # Rays joined by slow steps are one run; a ray after a fast step begins one.
    run = np.cumsum(np.r_[True, ~slow]) - 1
    return _numbered(run, t, order, least)


def idt(rays: Rays, dispersion: float = 3.0, least: float = 0.1, gap: float = _GAP) -> np.ndarray:
    """By dispersion (I-DT): a window of ``least`` seconds whose directions lie within ``dispersion`` degrees grows as
    long as they do; otherwise it starts one ray later.

    Dispersion is the spread of the angle sideways plus the spread upwards, max - min each, in the plane that touches
    the sphere at the window's first direction (azimuthal equidistant, its axes level and upright). Returns (N,) int64.
    """
    _positive(dispersion=dispersion, least=least, gap=gap)
    order, starts = person_order(rays)
    t, d = rays.t[order], rays.direction[order]
    bounds = np.flatnonzero(np.r_[True, np.diff(t) > gap])
    bounds = np.union1d(bounds, starts)
    label = np.full(len(t), -1, np.int64)
    number = 0
    for a, b in zip(bounds[:-1], bounds[1:]):
        # The last ray of the shortest window that starts at each; b where the time does not suffice.
        full = np.searchsorted(t[a:b], t[a:b] + least - 1e-9) + a
        start, possible = a, _may_start(d[a:b], full - a, b - a, dispersion)
        for s in np.flatnonzero(possible) + a:
            if s < start:
                continue
            start = _grow(d, s, full[s - a] + 1, b, dispersion)
            label[s:start] = number
            number += 1
    out = np.empty_like(label)
    out[order] = label
    return out


def fixation_rays(rays: Rays, label: np.ndarray) -> tuple[Rays, np.ndarray]:
    """One ray a fixation, and how long each lasted (F,), seconds.

    Time of the middle, mean origin, mean direction, mean confidence, mean hit point and mean head (of those known) of
    the rays with the same number in ``label`` (N,), -1 left out. Raises `NergError` when there is no fixation.
    """
    kept = np.flatnonzero(label >= 0)
    if not kept.size:
        raise NergError(
            "there is no fixation among these rays; raise the velocity or the dispersion, or lower the duration"
        )
    _, index, number = np.unique(label[kept], return_index=True, return_inverse=True)
    n = np.bincount(number).astype(np.float64)
    mean = lambda v: np.stack([np.bincount(number, weights=c) for c in v[kept].T], axis=1) / n[:, None]
    direction = mean(rays.direction)
    first, last = np.full(len(n), np.inf), np.full(len(n), -np.inf)
    np.minimum.at(first, number, rays.t[kept])
    np.maximum.at(last, number, rays.t[kept])
    hit = None if rays.hit is None else _mean_of_known(rays.hit[kept], number)
    head = None if rays.head is None else _mean_of_known(rays.head[kept], number)
    if head is not None:
        head /= np.linalg.norm(head, axis=1, keepdims=True)
    one = replace(
        rays.select(kept[index]),
        t=0.5 * (first + last),
        origin=mean(rays.origin),
        hit=hit,
        head=head,
        direction=direction / np.linalg.norm(direction, axis=1, keepdims=True),
        confidence=np.clip(np.bincount(number, weights=rays.confidence[kept]) / n, 0.0, 1.0),
    )
    return one, last - first


def _mean_of_known(values: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Means (F, C) of the rows of ``values`` (N, C) with the same ``number`` (N,); NaN where all hold a NaN."""
    known = np.isfinite(values).all(axis=1)
    weight = np.bincount(number, weights=known.astype(float))
    sums = np.stack([np.bincount(number, weights=np.where(known, c, 0.0)) for c in values.T], axis=1)
    with np.errstate(invalid="ignore"):
        return sums / weight[:, None]


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees between unit vectors."""
    return np.degrees(2.0 * np.arcsin(np.minimum(1.0, np.sqrt(0.5 * vmf.one_minus_cosine(a, b)))))


def _numbered(run: np.ndarray, t: np.ndarray, order: np.ndarray, least: float) -> np.ndarray:
    counts = np.bincount(run)
    first = np.r_[0, np.cumsum(counts)[:-1]]
    long = t[first + counts - 1] - t[first] >= least - 1e-9
    number = np.where(long, np.cumsum(long) - 1, -1)
    out = np.empty(len(t), np.int64)
    out[order] = number[run]
    return out


def _plane(d: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Degrees sideways and upwards (..., 2) of directions (..., 3), seen from ``first`` (..., 3): azimuthal
    equidistant."""
    level = np.hypot(first[..., 0], first[..., 1])
    steep = level < 1e-9  # who looks straight up has no level of their own
    side = np.stack(
        [np.where(steep, 1.0, first[..., 1]), np.where(steep, 0.0, -first[..., 0]), np.zeros_like(level)], axis=-1
    )
    side = side / np.where(steep, 1.0, level)[..., None]
    upright = np.cross(side, first)
    dot = lambda u: np.sum(d * u, axis=-1)
    x, y, z = dot(side), dot(upright), dot(first)
    r = np.hypot(x, y)
    scale = np.where(r > 1e-12, np.degrees(np.arctan2(r, z)) / np.maximum(r, 1e-12), np.degrees(1.0))
    return np.stack([x * scale, y * scale], axis=-1)


def _may_start(d: np.ndarray, full: np.ndarray, n: int, dispersion: float) -> np.ndarray:
    """Where a window of the least duration holds together, (n,) bool: all starts at once, since most of them fail."""
    out = full < n
    starts = np.flatnonzero(out)
    if not starts.size:
        return out
    width = int((full[starts] - starts).max()) + 1
    for block in np.array_split(starts, max(1, starts.size * width >> 20)):
        at = np.minimum(block[:, None] + np.arange(width), full[block][:, None])
        plane = _plane(d[at], d[block][:, None, :])
        out[block] = np.ptp(plane, axis=1).sum(axis=1) <= dispersion
    return out


def _grow(d: np.ndarray, start: int, end: int, limit: int, dispersion: float) -> int:
    """Where the window from ``start`` ends that holds together and is at least up to ``end``."""
    step = 32
    while True:
        upto = min(end + step, limit)
        plane = _plane(d[start:upto], d[start])
        spread = (np.maximum.accumulate(plane) - np.minimum.accumulate(plane)).sum(axis=1)
        apart = np.flatnonzero(spread > dispersion)
        if apart.size:
            return start + int(apart[0])
        if upto == limit:
            return limit
        end, step = upto, 4 * step


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0:
            raise NergError(f"{name} must be positive, got {value}")
