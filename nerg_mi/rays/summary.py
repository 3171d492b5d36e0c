"""The sanity card of a set of rays: what came in, and whether it is plausible."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError

from .filters import time_order
from .plausibility import find_warnings
from .rays import Rays

_BLOCK = 1 << 18  # rays looked at at a time: a summary takes little memory besides the rays
GAP = 1.0  # seconds: a longer pause of a person does not count as recorded time


@dataclass(frozen=True)
class RaysSummary:
    """Figures of :func:`summarise`; lengths in metres, times in seconds.

    ``duration``: recorded time over all persons, without pauses above one
    second. ``rate``: rays a second of a person (one over the median step; over that of
    pauses where there is nothing else), NaN when no person has two times. ``eye_height``: 5, 50 and 95 % of the
    origins' heights. ``speed_p95``: 95 % of the origins' speeds. ``duplicates``: rays with
    person and time of another. ``dropped``: rows by reason; ``cohorts``: rays
    by cohort. ``warnings``: sentences about figures that people cannot produce
    (:mod:`nerg_mi.rays.plausibility`).
    """

    rays: int
    persons: int
    duration: float
    rate: float
    box_low: np.ndarray
    box_high: np.ndarray
    eye_height: np.ndarray
    speed_p95: float
    hit_share: float
    hit_distance: float
    duplicates: int
    rows_read: int
    dropped: dict[str, int]
    cohorts: dict[str, int]
    warnings: tuple[str, ...]


def summarise(rays: Rays) -> RaysSummary:
    """Figures and warnings for rays in our frame (z up, metres).

    Raises `NergError` for an empty set.
    """
    if len(rays) == 0:
        raise NergError("there are no rays to summarise; select fewer away")
    order = time_order(rays)
    step, speed = _steps(rays, order)
    duplicates, some = int(np.count_nonzero(step == 0)), bool(step.size)
    positive = step[step > 0]
    median_step = float(np.median(positive)) if positive.size else float("nan")
    del positive
    moving = (step > 0) & (step <= GAP)
    if not moving.all():
        step, speed = step[moving], speed[moving]
    speed /= step
    speed_p95 = float(np.percentile(speed, 95, overwrite_input=True)) if speed.size else float("nan")
    del speed
    rate = 1.0 / (float(np.median(step)) if step.size else median_step)

    known, distance = _hits(rays)
    dropped: dict[str, int] = defaultdict(int)
    for entry in rays.metadata.get("dropped", []):
        dropped[entry["reason"]] += entry["count"]

    height = np.percentile(rays.origin[:, 2], [5, 50, 95])
    low, high = rays.origin.min(axis=0), rays.origin.max(axis=0)
    return RaysSummary(
        rays=len(rays),
        persons=int(np.count_nonzero(np.bincount(rays.person))),
        duration=float(step.sum()),
        rate=rate,
        box_low=low,
        box_high=high,
        eye_height=height,
        speed_p95=speed_p95,
        hit_share=known / len(rays),
        hit_distance=distance,
        duplicates=duplicates,
        rows_read=int(rays.metadata.get("rows_read", len(rays))),
        dropped=dict(dropped),
        cohorts={}
        if rays.cohort is None
        else dict(zip(rays.cohorts, np.bincount(rays.cohort, minlength=len(rays.cohorts)).tolist())),
        warnings=tuple(find_warnings(rays, height, high - low, speed_p95, median_step if some else None, order)),
    )


def _steps(rays: Rays, order: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Times and distances between successive rays of a person, in ``order`` (`time_order`); as many as there are."""
    step, walked = np.empty((2, max(0, len(rays) - 1)))
    count = 0
    for a in range(0, len(step), _BLOCK):
        rows = slice(a, a + _BLOCK + 1)
        rows = rows if order is None else order[rows]
        same = np.diff(rays.person[rows]) == 0
        here = slice(count, count := count + np.count_nonzero(same))
        step[here] = np.diff(rays.t[rows])[same]
        way = np.diff(rays.origin[rows], axis=0)[same]
        walked[here] = np.sqrt(np.einsum("ij,ij->i", way, way))
    return step[:count], walked[:count]


def _hits(rays: Rays) -> tuple[int, float]:
    """How many hit points are known, and their median distance (NaN without any)."""
    if rays.hit is None:
        return 0, float("nan")
    distance, count = np.empty(len(rays)), 0
    for a in range(0, len(rays), _BLOCK):
        way = rays.hit[a : a + _BLOCK] - rays.origin[a : a + _BLOCK]
        found = np.sqrt(np.einsum("ij,ij->i", way, way))
        found = found[np.isfinite(found)]
        distance[count : count + len(found)] = found
        count += len(found)
    return count, float(np.median(distance[:count], overwrite_input=True)) if count else float("nan")
