"""Fixations of gaze samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths import vmf

from .filters import group_by_person
from .rays import Rays

# ---- Fixations ----
#
# I-VT and I-DT of Salvucci and Goldberg (2000), on directions in the world frame.
#
# Angles are in degrees, times in seconds. A pause of a participant longer than ``gap`` ends a fixation. Both functions
# return the number of the fixation of each ray, or -1; numbers increase by participant and time.

_MAX_GAP = 0.1


def detect_fixations_ivt(
    rays: Rays, velocity: float = 100.0, min_duration: float = 0.06, gap: float = _MAX_GAP
) -> np.ndarray:
    """Detect fixations by velocity (I-VT): runs of rays that turn at most by ``velocity`` degrees per second and last
    at least ``min_duration`` seconds.

    The velocity of a ray is measured from the previous ray; that of the first ray of a run, to the next one. The
    default of 100 degrees per second suits gaze in the world frame of people who walk and turn; 30 is common for a
    stationary head. Returns (N,) int64.
    """
    _require_positive(velocity=velocity, min_duration=min_duration, gap=gap)
    order, starts = group_by_person(rays)
    t, d = rays.t[order], rays.direction[order]
    step = np.diff(t)
    joined = (step > 0) & (step <= gap)
    joined[starts[1:-1] - 1] = False
    with np.errstate(divide="ignore", invalid="ignore"):
        slow = joined & (_angles(d[1:], d[:-1]) <= velocity * step)
    # Slow steps join rays into a run; a ray after a fast step starts a new one.
    run = np.cumsum(np.r_[True, ~slow]) - 1
    return _number_long_runs(run, t, order, min_duration)


def detect_fixations_idt(
    rays: Rays, dispersion: float = 3.0, min_duration: float = 0.1, gap: float = _MAX_GAP
) -> np.ndarray:
    """Detect fixations by dispersion (I-DT): a window of ``min_duration`` seconds with a dispersion of at most
    ``dispersion`` degrees grows as long as this holds; otherwise the window starts one ray later.

    Dispersion is the horizontal plus the vertical range (max - min) of the directions, in the tangent plane of the
    sphere at the window's first direction (azimuthal equidistant projection, horizontal and vertical axes). Returns
    (N,) int64.
    """
    _require_positive(dispersion=dispersion, min_duration=min_duration, gap=gap)
    order, starts = group_by_person(rays)
    t, d = rays.t[order], rays.direction[order]
    bounds = np.flatnonzero(np.r_[True, np.diff(t) > gap])
    bounds = np.union1d(bounds, starts)
    label = np.full(len(t), -1, np.int64)
    number = 0
    for a, b in zip(bounds[:-1], bounds[1:]):
        # The last ray of the shortest window from each start; b if too little time is left.
        full = np.searchsorted(t[a:b], t[a:b] + min_duration - 1e-9) + a
        start, possible = a, _find_window_starts(d[a:b], full - a, b - a, dispersion)
        for s in np.flatnonzero(possible) + a:
            if s < start:
                continue
            start = _grow_window(d, s, full[s - a] + 1, b, dispersion)
            label[s:start] = number
            number += 1
    out = np.empty_like(label)
    out[order] = label
    return out


def average_fixations(rays: Rays, label: np.ndarray) -> tuple[Rays, np.ndarray]:
    """Average the rays of each fixation.

    Returns F rays, with the mid time and the mean origin, direction, confidence, hit point and head (of those that are
    finite) of the rays with the same number in ``label`` (N,; -1: none), and the durations (F,) in seconds. Raises
    `NergError` if there is no fixation.
    """
    rows = np.flatnonzero(label >= 0)
    if not rows.size:
        raise NergError(
            "no fixation was detected; raise the velocity or the dispersion threshold, or lower the minimum duration"
        )
    _, index, number = np.unique(label[rows], return_index=True, return_inverse=True)
    n = np.bincount(number).astype(np.float64)
    mean = lambda v: np.stack([np.bincount(number, weights=c) for c in v[rows].T], axis=1) / n[:, None]
    direction = mean(rays.direction)
    first, last = np.full(len(n), np.inf), np.full(len(n), -np.inf)
    np.minimum.at(first, number, rays.t[rows])
    np.maximum.at(last, number, rays.t[rows])
    hit = None if rays.hit is None else _nanmean_by_group(rays.hit[rows], number)
    head = None if rays.head is None else _nanmean_by_group(rays.head[rows], number)
    if head is not None:
        head /= np.linalg.norm(head, axis=1, keepdims=True)
    fixations = replace(
        rays.select(rows[index]),
        t=0.5 * (first + last),
        origin=mean(rays.origin),
        hit=hit,
        head=head,
        direction=direction / np.linalg.norm(direction, axis=1, keepdims=True),
        confidence=np.clip(np.bincount(number, weights=rays.confidence[rows]) / n, 0.0, 1.0),
    )
    return fixations, last - first


def _nanmean_by_group(values: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Means (F, C) of the finite rows of ``values`` (N, C) per ``number`` (N,); NaN for groups without finite rows."""
    is_finite = np.isfinite(values).all(axis=1)
    weight = np.bincount(number, weights=is_finite.astype(float))
    sums = np.stack([np.bincount(number, weights=np.where(is_finite, c, 0.0)) for c in values.T], axis=1)
    with np.errstate(invalid="ignore"):
        return sums / weight[:, None]


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles in degrees between unit vectors."""
    return np.degrees(2.0 * np.arcsin(np.minimum(1.0, np.sqrt(0.5 * vmf.one_minus_cosine(a, b)))))


def _number_long_runs(run: np.ndarray, t: np.ndarray, order: np.ndarray, min_duration: float) -> np.ndarray:
    counts = np.bincount(run)
    first = np.r_[0, np.cumsum(counts)[:-1]]
    long = t[first + counts - 1] - t[first] >= min_duration - 1e-9
    number = np.where(long, np.cumsum(long) - 1, -1)
    out = np.empty(len(t), np.int64)
    out[order] = number[run]
    return out


def _project_to_plane(d: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Horizontal and vertical angles (..., 2) in degrees of directions (..., 3) from ``first`` (..., 3), in the
    azimuthal equidistant projection."""
    level = np.hypot(first[..., 0], first[..., 1])
    steep = level < 1e-9  # a vertical direction has no horizontal axis of its own
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


def _find_window_starts(d: np.ndarray, full: np.ndarray, n: int, dispersion: float) -> np.ndarray:
    """Mask (n,) bool of starts whose window of minimum duration passes the threshold. Tests all starts at once, since
    most of them fail."""
    out = full < n
    starts = np.flatnonzero(out)
    if not starts.size:
        return out
    width = int((full[starts] - starts).max()) + 1
    for block in np.array_split(starts, max(1, starts.size * width >> 20)):
        at = np.minimum(block[:, None] + np.arange(width), full[block][:, None])
        plane = _project_to_plane(d[at], d[block][:, None, :])
        out[block] = np.ptp(plane, axis=1).sum(axis=1) <= dispersion
    return out


def _grow_window(d: np.ndarray, start: int, end: int, limit: int, dispersion: float) -> int:
    """End of the largest window from ``start`` that passes the threshold, at least ``end``."""
    step = 32
    while True:
        upto = min(end + step, limit)
        plane = _project_to_plane(d[start:upto], d[start])
        spread = (np.maximum.accumulate(plane) - np.minimum.accumulate(plane)).sum(axis=1)
        exceeding = np.flatnonzero(spread > dispersion)
        if exceeding.size:
            return start + int(exceeding[0])
        if upto == limit:
            return limit
        end, step = upto, 4 * step


def _require_positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0:
            raise NergError(f"{name} must be positive, got {value}")
