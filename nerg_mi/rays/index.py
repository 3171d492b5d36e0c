"""Which rays start near a place: a spatial index of millions of origins."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .rays import Rays

_BLOCK = 1 << 21  # neighbours held at a time: memory stays bounded


class Neighbours(NamedTuple):
    """The rays near each of Q places, place after place."""

    indices: np.ndarray  # (n,) of rays; of a place, nearest first
    distances: np.ndarray  # (n,) metres
    offsets: np.ndarray  # (Q + 1,): place q has indices[offsets[q]:offsets[q + 1]]


class RayIndex:
    """A k-d tree of ray origins. ``rays``: a set of rays, or origins (N, 3) in metres."""

    def __init__(self, rays: Rays | np.ndarray) -> None:
        from scipy.spatial import KDTree

        origin = rays.origin if isinstance(rays, Rays) else np.asarray(rays, dtype=np.float64)
        self.count = len(origin)
        # Without balancing: half the time to build, and as fast to ask. The order of rays that are equally far depends
        # on the size of the leaves, and with it the bits of what is made of them.
        self._tree = KDTree(origin, leafsize=16, balanced_tree=False)

    def nearest(self, places: np.ndarray, most: int, radius: float = np.inf) -> Neighbours:
        """The ``most`` nearest rays of each of ``places`` (Q, 3), within ``radius`` metres (those at exactly R
        count)."""
        places = np.asarray(places, dtype=np.float64).reshape(-1, 3)
        if most < 1 or not radius > 0:
            raise ValueError(f"most {most}, radius {radius}: ask for at least one ray within a positive radius")
        most = min(most, self.count)
        # A hair more than R: scipy leaves out what lies at the bound.
        bound = np.nextafter(radius, np.inf) if np.isfinite(radius) else np.inf
        step = max(1, _BLOCK // most)
        indices, distances, counts = [], [], []
        for start in range(0, len(places), step):
            part = places[start : start + step]
            answer = self._tree.query(part, k=most, distance_upper_bound=bound, workers=-1)
            d, i = (np.asarray(v).reshape(len(part), most) for v in answer)
            found = np.isfinite(d)
            indices.append(i[found])
            distances.append(d[found])
            counts.append(found.sum(axis=1))
        offsets = np.concatenate([[0], np.cumsum(np.concatenate(counts))]) if counts else np.zeros(1, np.int64)
        join = lambda parts, kind: np.concatenate(parts) if parts else np.empty(0, kind)
        return Neighbours(join(indices, np.int64), join(distances, np.float64), offsets.astype(np.int64))
