"""What checks of rays are given, and what several of them need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nerg_mi.rays.frozen import find_frozen
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.sessions import Sessions, find_sessions

MOST = 200_000
"""Rays looked at, where a part of them says as much as all."""

ENOUGH = 50
"""Rays from which on something can be said of what most of them do: a second of a recording."""

_NAMED = 3  # people


@dataclass(frozen=True, eq=False)
class Figures:
    """Rays, and what a summary has found of them already, in the frame of rays."""

    rays: Rays
    height: np.ndarray  # (3,) 5, 50 and 95 % of the origins' heights, metres
    extent: np.ndarray  # (3,) of the origins' box, metres
    speed: float  # 95 % of the origins' speeds, m/s; NaN if unknown
    step: float | None  # median of a person's positive times between rays, seconds; NaN: none is; None: no times
    order: np.ndarray | None  # (N,) by person and time, as `filters.time_order` gives it

    @cached_property
    def sessions(self) -> Sessions:
        """Recordings, in the order in which rays are stored."""
        return find_sessions(self.rays)

    @cached_property
    def frozen(self) -> np.ndarray:
        """Rays (N,) bool whose gaze stands still while the head moves."""
        return find_frozen(self.rays, self.sessions)

    @property
    def floor_known(self) -> bool:
        """Whether the height 0 is the floor, as far as the reader of the files knows."""
        return self.rays.metadata.get("floor") != "unknown"

    @property
    def selected(self) -> bool:
        """Whether rays between others were left out since the import, so that the times between them say little."""
        return any(step.get("step") in ("thin", "fixations") for step in self.rays.metadata.get("steps", []))


def to_source(rays: Rays) -> np.ndarray:
    """Rotation, or mirror, from the frame of rays back to the file's, (3, 3): file = R ours."""
    matrix = np.asarray(rays.metadata.get("transform", np.eye(4)), dtype=np.float64)[:3, :3]
    return np.linalg.inv(matrix / np.cbrt(abs(np.linalg.det(matrix))))


def group_medians(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """Medians (count,) of the ``values`` (n,) with the same number ``group`` (n,); NaN where there are none."""
    order = np.lexsort((values, group))
    ends = np.searchsorted(group[order], np.arange(count + 1))
    n, values = np.diff(ends), values[order]
    if not values.size:
        return np.full(count, np.nan)
    low, high = (np.clip(ends[:-1] + k, 0, len(values) - 1) for k in ((n - 1) // 2, n // 2))
    return np.where(n > 0, 0.5 * (values[low] + values[high]), np.nan)


def name_some(names: Sequence[str]) -> str:
    """``ann, bo, cy and 4 more``."""
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")
