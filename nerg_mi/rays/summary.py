"""The sanity card of a set of rays: what came in, and whether it is plausible."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError

from .checks.figures import Figures
from .checks.registry import find_warnings
from .filters import time_order
from .rays import Rays

_BLOCK = 1 << 18  # rays looked at at a time: a summary takes little memory besides the rays
GAP = 1.0  # seconds: a longer pause of a person does not count as recorded time


@dataclass(frozen=True)
class RaysSummary:
    """Figures of :func:`summarise`, of rays in the frame of rays."""

    rays: int
    persons: int
    duration: float  # seconds recorded over all persons, without pauses above one second
    rate: float  # rays a second of a person, by the median step; NaN when no person has two times
    box_low: np.ndarray  # (3,) of the origins, metres
    box_high: np.ndarray
    eye_height: np.ndarray  # (3,) 5, 50 and 95 % of the origins' heights, metres
    speed_p95: float  # 95 % of the origins' speeds, m/s; NaN if unknown
    hit_share: float  # of the rays whose hit point is known
    hit_distance: float  # median distance of the hit points, metres; NaN without any
    duplicates: int  # rays with person and time of another
    rows_read: int  # by the import
    dropped: dict[str, int]  # rows by reason
    cohorts: dict[str, int]  # rays by cohort
    warnings: tuple[str, ...]  # about figures that people cannot produce (`nerg_mi.rays.checks`)


def summarise(rays: Rays) -> RaysSummary:
    """Figures and warnings.

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
    figures = Figures(rays, height, high - low, speed_p95, median_step if some else None, order)
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
        warnings=tuple(find_warnings(figures)),
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
