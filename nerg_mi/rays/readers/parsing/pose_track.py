"""Where something was and how it was turned, sample by sample, and in between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.ranges import FARTHEST, TIMES


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Poses of a head or a camera in N >= 2 samples, to be interpolated."""

    times: np.ndarray  # (N,) seconds, strictly rising
    vectors: np.ndarray  # (N, 3) rotations to the world as Rodrigues vectors, radians
    places: np.ndarray  # (N, 3) origins in the world, in its unit of length

    @classmethod
    def of_samples(cls, times: np.ndarray, vectors: np.ndarray, places: np.ndarray) -> PoseTrack | None:
        """A track of samples in any order; those with something missing, or beyond `FARTHEST`, are left out, and of
        those at one time all but the first. None where fewer than two are left."""
        within = lambda v: (np.abs(v) <= FARTHEST).all(axis=1)
        good = (np.abs(times) <= TIMES.high) & within(vectors) & within(places)
        kept = np.flatnonzero(good)
        kept = kept[np.unique(times[kept], return_index=True)[1]]
        return cls(times[kept], vectors[kept], places[kept]) if len(kept) >= 2 else None

    def at(self, t: np.ndarray, gap: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rotations (n, 3, 3) and places (n, 3) at the times ``t`` (n,), seconds, turned along the shortest way and
        moved along a straight line between the samples around them; and where nothing is known, (n,) bool: before the
        first sample, after the last, or farther than ``gap`` seconds from the nearest."""
        from scipy.spatial.transform import Rotation, Slerp

        times = self.times
        inside = np.clip(np.nan_to_num(t), times[0], times[-1])
        after = np.clip(np.searchsorted(times, inside), 1, len(times) - 1)
        apart = np.abs(t[:, None] - times[np.stack([after - 1, after], axis=1)])
        lost = (apart.min(axis=1) > gap) | (inside != t)
        turn = Slerp(times, Rotation.from_rotvec(self.vectors))(inside).as_matrix()
        place = np.stack([np.interp(inside, times, self.places[:, i]) for i in range(3)], axis=1)
        return turn, place, lost
