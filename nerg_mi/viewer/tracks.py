"""People of the rays: their paths, and where they are at a moment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.maths.geometry import Similarity
from nerg_mi.probes.probes import place_probes
from nerg_mi.rays.rays import Rays

VERTICES = 20_000
"""Points of all paths together, at most: what a browser draws without effort."""

GAP = 1.0
"""Seconds without a ray that end a path, and that a person is still shown after the last one."""

RAYS = 1 << 11
"""Rays that are drawn at most."""

PROBES = 512
"""Probes that are drawn at most."""

ALL = "everybody"


@dataclass(frozen=True, eq=False)
class Pose:
    """``person``, their eye ``at`` (3,) and ``ahead`` (3,), a unit vector, both in the place."""

    person: str
    at: np.ndarray
    ahead: np.ndarray


class Tracks:
    """Rays in the place: ``align`` leads there from their own frame."""

    def __init__(self, rays: Rays, align: Similarity):
        order = np.lexsort((rays.t, rays.person))
        self._rays = rays.select(order)
        matrix = self._matrix = np.asarray(align.matrix, float)
        turn = matrix[:3, :3] / align.scale
        self.at = self._rays.origin @ matrix[:3, :3].T + matrix[:3, 3]
        self.ahead = self._rays.direction @ turn.T

    @property
    def times(self) -> tuple[float, float]:
        """When the first ray and the last one are, in seconds."""
        return (float(self._rays.t.min()), float(self._rays.t.max())) if len(self._rays) else (0.0, 0.0)

    @property
    def groups(self) -> list[str]:
        """Everybody, and the cohorts."""
        return [ALL, *self._rays.cohorts]

    @property
    def people(self) -> list[str]:
        """Names of those who have rays."""
        return [self._rays.persons[k] for k in np.unique(self._rays.person)]

    def segments(self, group: str = ALL) -> tuple[np.ndarray, np.ndarray]:
        """Line segments (S, 2, 3) of the paths of a cohort, and the person's number (S,) of each."""
        rows = np.flatnonzero(self._of(group))
        rows = rows[:: max(len(rows) // VERTICES, 1)]
        person, t = self._rays.person[rows], self._rays.t[rows]
        step = max(np.median(np.diff(t)) if len(t) > 1 else 0.0, 0.0)
        if len(rows) < 2:
            return np.zeros((0, 2, 3), np.float32), person[:0]
        joined = (np.diff(person) == 0) & (np.diff(t) <= max(GAP, 4 * step))
        pairs = np.stack([self.at[rows[:-1]], self.at[rows[1:]]], axis=1)[joined]
        return pairs.astype(np.float32), person[:-1][joined]

    def at_time(self, time: float, group: str = ALL) -> list[Pose]:
        """Where those of a cohort are whose nearest ray is within `GAP` of ``time``."""
        near = np.flatnonzero(self._of(group) & (np.abs(self._rays.t - time) <= GAP))
        found = []
        for person in np.unique(self._rays.person[near]):
            own = near[self._rays.person[near] == person]
            k = own[np.argmin(np.abs(self._rays.t[own] - time))]
            found.append(Pose(self._rays.persons[person], self.at[k], self.ahead[k]))
        return found

    def sample(self, group: str = ALL, most: int = RAYS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Eyes (K, 3) and unit directions (K, 3) of ``most`` rays of a cohort at most, evenly through each person's
        time, and the person's number (K,)."""
        rows = np.flatnonzero(self._of(group))
        rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)] if len(rows) else rows
        return self.at[rows], self.ahead[rows], self._rays.person[rows]

    def probes(self, group: str = ALL) -> tuple[np.ndarray, np.ndarray]:
        """Positions (P, 3) in the place of the probes that a density of a cohort's rays would have by default, and how
        many rays each holds (P,). Raises `NergError` where nobody stayed long enough for one."""
        rows = np.flatnonzero(self._of(group))
        found = place_probes(self._rays.select(rows), count=PROBES)
        turn, shift = self._matrix[:3, :3], self._matrix[:3, 3]
        return found.positions @ turn.T + shift, found.counts

    def _of(self, group: str) -> np.ndarray:
        if group == ALL or self._rays.cohort is None:
            return np.ones(len(self._rays), bool)
        return self._rays.cohort == self._rays.cohorts.index(group)
