"""Recordings in the viewer: paths and poses of participants."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.transforms import transform_points
from nerg_mi.tracking.probes import place_probes
from nerg_mi.tracking.rays import Rays

MAX_VERTICES = 20_000
"""Maximum number of vertices of all paths together."""

MAX_GAP = 1.0
"""Seconds without a gaze sample that interrupt a path; a participant stays visible this long after a sample."""

MAX_RAYS = 1 << 11
"""Maximum number of gaze rays to draw."""

MAX_PROBES = 512
"""Maximum number of probes to draw."""

ALL_PARTICIPANTS = "all participants"


@dataclass(frozen=True, eq=False)
class ParticipantPose:
    """The pose of a participant at a moment.

    Parameters
    ----------
    participant : str
        Name of the participant.
    position : ndarray of shape (3,)
        Position of the eye in scene units.
    direction : ndarray of shape (3,)
        Viewing direction, a unit vector in the frame of the scene.
    """

    participant: str
    position: np.ndarray
    direction: np.ndarray


class Tracks:
    """Recordings in the frame of the scene.

    Parameters
    ----------
    rays : Rays
        The recordings.
    align : Similarity
        Transform from the frame of the recordings to the frame of the scene.
    """

    def __init__(self, rays: Rays, align: Similarity):
        order = np.lexsort((rays.t, rays.person))
        self._rays = rays.select(order)
        matrix = self._matrix = np.asarray(align.matrix, float)
        rotation = matrix[:3, :3] / align.scale
        self.origins = transform_points(matrix, self._rays.origin)
        self.directions = self._rays.direction @ rotation.T

    @property
    def time_range(self) -> tuple[float, float]:
        """Times of the first and the last gaze sample, in seconds."""
        return (float(self._rays.t.min()), float(self._rays.t.max())) if len(self._rays) else (0.0, 0.0)

    @property
    def groups(self) -> list[str]:
        """The names of the groups: all participants, and each cohort."""
        return [ALL_PARTICIPANTS, *self._rays.cohorts]

    @property
    def participants(self) -> list[str]:
        """Names of the participants who have gaze samples."""
        return [self._rays.persons[k] for k in np.unique(self._rays.person)]

    def segments(self, group: str = ALL_PARTICIPANTS) -> tuple[np.ndarray, np.ndarray]:
        """Return line segments (S, 2, 3) of the paths of a group, and the index (S,) of the participant of each."""
        rows = np.flatnonzero(self._group_mask(group))
        rows = rows[:: max(len(rows) // MAX_VERTICES, 1)]
        person, t = self._rays.person[rows], self._rays.t[rows]
        step = max(np.median(np.diff(t)) if len(t) > 1 else 0.0, 0.0)
        if len(rows) < 2:
            return np.zeros((0, 2, 3), np.float32), person[:0]
        is_joined = (np.diff(person) == 0) & (np.diff(t) <= max(MAX_GAP, 4 * step))
        pairs = np.stack([self.origins[rows[:-1]], self.origins[rows[1:]]], axis=1)[is_joined]
        return pairs.astype(np.float32), person[:-1][is_joined]

    def poses_at(self, time: float, group: str = ALL_PARTICIPANTS) -> list[ParticipantPose]:
        """Return the poses of the participants of a group who have a gaze sample within `MAX_GAP` of ``time``."""
        near = np.flatnonzero(self._group_mask(group) & (np.abs(self._rays.t - time) <= MAX_GAP))
        poses = []
        for person in np.unique(self._rays.person[near]):
            rows = near[self._rays.person[near] == person]
            k = rows[np.argmin(np.abs(self._rays.t[rows] - time))]
            poses.append(ParticipantPose(self._rays.persons[person], self.origins[k], self.directions[k]))
        return poses

    def sample(
        self, group: str = ALL_PARTICIPANTS, max_rays: int = MAX_RAYS
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sample gaze rays of a group, evenly in time.

        Parameters
        ----------
        group : str
            A name of `groups`.
        max_rays : int
            Maximum number of rays.

        Returns
        -------
        tuple of ndarray
            Origins (K, 3) in scene units, unit directions (K, 3), and the index (K,) of the participant of each ray.
        """
        rows = np.flatnonzero(self._group_mask(group))
        rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), max_rays)).astype(int)] if len(rows) else rows
        return self.origins[rows], self.directions[rows], self._rays.person[rows]

    def place_probes(self, group: str = ALL_PARTICIPANTS) -> tuple[np.ndarray, np.ndarray]:
        """Place the probes that a kernel density of a group's gaze would have by default.

        Returns
        -------
        tuple of ndarray
            Positions (P, 3) in scene units, and the number of gaze samples of each probe (P,).

        Raises
        ------
        NergError
            No position has enough gaze samples.
        """
        rows = np.flatnonzero(self._group_mask(group))
        probes = place_probes(self._rays.select(rows), count=MAX_PROBES)
        return transform_points(self._matrix, probes.positions), probes.counts

    def _group_mask(self, group: str) -> np.ndarray:
        if group == ALL_PARTICIPANTS or self._rays.cohort is None:
            return np.ones(len(self._rays), bool)
        return self._rays.cohort == self._rays.cohorts.index(group)
