"""The sanity card of a set of rays: what came in, and whether it is plausible."""
from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from ..errors import NergError
from .filters import time_order
from .plausibility import warnings
from .rays import Rays

_BLOCK = 1 << 18  # rays looked at at a time: a summary takes little memory besides the rays
GAP = 1.0  # seconds: a longer pause of a person does not count as recorded time


@dataclass(frozen=True)
class RaysSummary:
    """Figures of :func:`summarise`; lengths in metres, times in seconds.

    ``duration``: recorded time over all persons, without pauses above one
    second. ``rate``: rays a second of a person (one over the median step; over that of
    pauses where there is nothing else), NaN when no person has two times. ``eye_height``: 5, 50 and 95 % of the origins'
    heights. ``speed_p95``: 95 % of the origins' speeds. ``duplicates``: rays with
    person and time of another. ``dropped``: rows by reason; ``cohorts``: rays
    by cohort. ``warnings``: sentences about figures that people cannot produce
    (:mod:`nerg_mi.attention.plausibility`).
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
    step, walked = _steps(rays, order)
    moving = (step > 0) & (step <= GAP)
    speed = walked[moving] / step[moving]
    forward = step[moving] if moving.any() else step[step > 0]

    known, distance = _hits(rays)
    dropped: dict[str, int] = defaultdict(int)
    for entry in rays.metadata.get("dropped", []):
        dropped[entry["reason"]] += entry["count"]

    height = np.percentile(rays.origin[:, 2], [5, 50, 95])
    low, high = rays.origin.min(axis=0), rays.origin.max(axis=0)
    speed_p95 = float(np.percentile(speed, 95)) if speed.size else float("nan")
    return RaysSummary(
        rays=len(rays),
        persons=int(np.count_nonzero(np.bincount(rays.person))),
        duration=float(step[moving].sum()),
        rate=float(1.0 / np.median(forward)) if forward.size else float("nan"),
        box_low=low,
        box_high=high,
        eye_height=height,
        speed_p95=speed_p95,
        hit_share=known / len(rays),
        hit_distance=distance,
        duplicates=int((step == 0).sum()),
        rows_read=int(rays.metadata.get("rows_read", len(rays))),
        dropped=dict(dropped),
        cohorts={} if rays.cohort is None else dict(zip(rays.cohorts, np.bincount(rays.cohort, minlength=len(rays.cohorts)).tolist())),
        warnings=tuple(warnings(rays, height, high - low, speed_p95, step, order)),
    )


def _steps(rays: Rays, order: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Times and distances between successive rays of a person, in ``order`` (`time_order`); as many as there are."""
    steps, walked = [], []
    for a in range(0, len(rays) - 1, _BLOCK):
        rows = slice(a, a + _BLOCK + 1)
        rows = rows if order is None else order[rows]
        same = np.diff(rays.person[rows]) == 0
        steps.append(np.diff(rays.t[rows])[same])
        way = np.diff(rays.origin[rows], axis=0)[same]
        walked.append(np.sqrt(np.einsum("ij,ij->i", way, way)))
    return tuple(np.concatenate(parts) if parts else np.empty(0) for parts in (steps, walked))


def _hits(rays: Rays) -> tuple[int, float]:
    """How many hit points are known, and their median distance (NaN without any)."""
    found = []
    for a in range(0, len(rays) if rays.hit is not None else 0, _BLOCK):
        way = rays.hit[a : a + _BLOCK] - rays.origin[a : a + _BLOCK]
        distance = np.sqrt(np.einsum("ij,ij->i", way, way))
        found.append(distance[np.isfinite(distance)])
    distance = np.concatenate(found) if found else np.empty(0)
    return len(distance), float(np.median(distance)) if distance.size else float("nan")
