"""The sanity card of a set of rays: what came in, and whether it is plausible."""
from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from .plausibility import warnings
from .rays import Rays

GAP = 1.0  # seconds: a longer pause of a person does not count as recorded time


@dataclass(frozen=True)
class RaysSummary:
    """Figures of :func:`summarise`; lengths in metres, times in seconds.

    ``duration``: recorded time over all persons, without pauses above one
    second. ``rate``: rays a second of a person (one over the median step), NaN
    when no person has two times. ``eye_height``: 5, 50 and 95 % of the origins'
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

    Raises ``ValueError`` for an empty set.
    """
    if len(rays) == 0:
        raise ValueError("there are no rays to summarise; select fewer away")
    order = np.lexsort((rays.t, rays.person))
    same = np.diff(rays.person[order]) == 0
    step = np.diff(rays.t[order])[same]
    walked = np.linalg.norm(np.diff(rays.origin[order], axis=0), axis=1)[same]
    moving = (step > 0) & (step <= GAP)
    speed = walked[moving] / step[moving]

    hits = np.zeros(len(rays), dtype=bool) if rays.hit is None else np.isfinite(rays.hit).all(axis=1)
    distance = np.linalg.norm(rays.hit[hits] - rays.origin[hits], axis=1) if hits.any() else np.array([np.nan])
    dropped: dict[str, int] = defaultdict(int)
    for entry in rays.metadata.get("dropped", []):
        dropped[entry["reason"]] += entry["count"]

    height = np.percentile(rays.origin[:, 2], [5, 50, 95])
    low, high = rays.origin.min(axis=0), rays.origin.max(axis=0)
    speed_p95 = float(np.percentile(speed, 95)) if speed.size else float("nan")
    return RaysSummary(
        rays=len(rays),
        persons=len(np.unique(rays.person)),
        duration=float(step[moving].sum()),
        rate=float(1.0 / np.median(step[moving])) if moving.any() else float("nan"),
        box_low=low,
        box_high=high,
        eye_height=height,
        speed_p95=speed_p95,
        hit_share=float(hits.mean()),
        hit_distance=float(np.median(distance)),
        duplicates=int((step == 0).sum()),
        rows_read=int(rays.metadata.get("rows_read", len(rays))),
        dropped=dict(dropped),
        cohorts={} if rays.cohort is None else dict(zip(rays.cohorts, np.bincount(rays.cohort, minlength=len(rays.cohorts)).tolist())),
        warnings=tuple(warnings(rays, height, high - low, speed_p95, step)),
    )
