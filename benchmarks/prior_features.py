"""What geometry says of a direction that somebody could look in: features of a smoothed map of log distance.

The map of an observer is the normalised convolution (Knutsson and Westin 1993) of the log distances in 2,048 directions
of equal area by a von Mises-Fisher kernel, so that places of voxels, of shapes and of a radiance field are alike, and
holes are closed by what lies around them. Which directions meet no surface is not told: in a place of hit points it
would say where people looked.
"""

from __future__ import annotations

import numpy as np

FEATURES = ("elevation", "distance", "relative", "rise", "height", "incidence", "upward", "edge")
"""Sine of the elevation; log of the distance (metres), and less its mean over the observer's sphere (openness is what
it is less of); height of the point above the observer, and above the ground; cosine of the angle of incidence; upward
part of the normal; standard deviation of the log distance within the kernel."""

# Directions of the map; concentration of its kernel (4.5 degrees), and of the one that closes holes, and its share.
_SOURCES, _KAPPA, _FILL, _SHARE = 2048, 160.0, 12.0, 1e-4
# Bound of the derivative of the log distance (1/radian), and of distances (metres).
_STEEP, _NEAR, _FAR = 6.0, 0.15, 30.0


class DistanceMaps:
    """Smoothed maps of log distance of observers at ``centres`` (P, 3) in a `GazePlace`, metres."""

    def __init__(self, place, centres: np.ndarray):
        from nerg_mi.maths.sphere import fibonacci_directions
        from nerg_mi.training.geometry.surfaces import surface_distances

        self.centres, self.sources = centres, fibonacci_directions(_SOURCES)
        scale = place.align.scale
        spread = np.broadcast_to(self.sources, (len(centres), *self.sources.shape))
        distance, escaped = surface_distances(
            place, place.points_from_rays(centres), place.directions_from_rays(spread)
        )
        self.known = (~escaped).astype(float)
        # Without a single surface everything is two metres away.
        self.known[escaped.all(axis=1)] = 1
        distance = np.where(escaped.all(axis=1, keepdims=True), 2.0, distance / scale)
        self.log = np.log(np.clip(distance, _NEAR, _FAR)) * self.known

    def features(self, directions: np.ndarray) -> np.ndarray:
        """`FEATURES` (P, D, 8) in ``directions`` (D, 3) or (P, D, 3)."""
        own, shared = directions.ndim == 3, None
        if not own:
            shared = self._kernel(directions)
        level = np.array([self._smooth(self._kernel(self.sources[::8]), p)[0].mean() for p in range(len(self.log))])
        out = []
        for p in range(len(self.log)):
            r = directions[p] if own else directions
            log, gradient, spread = self._smooth(self._kernel(r) if own else shared, p, r)
            distance = np.exp(log)
            normal = gradient - r
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            rise = distance * r[:, 2]
            out.append(
                np.stack(
                    [
                        r[:, 2],
                        log,
                        log - level[p],
                        rise,
                        rise + self.centres[p, 2],
                        -(normal * r).sum(axis=1),
                        normal[:, 2],
                        spread,
                    ],
                    axis=1,
                )
            )
        return np.stack(out).astype(np.float32)

    def _kernel(self, directions: np.ndarray) -> np.ndarray:
        cosine = directions @ self.sources.T
        return np.exp(_KAPPA * (cosine - 1)) + _SHARE * np.exp(_FILL * (cosine - 1))

    def _smooth(self, kernel: np.ndarray, p: int, r: np.ndarray | None = None):
        """``(log distance, its gradient on the sphere, its standard deviation)``, (D,), (D, 3), (D,)."""
        known, log = self.known[p], self.log[p]
        weight = kernel @ known
        mean = kernel @ log / weight
        if r is None:
            return mean, None, None
        square = kernel @ (log**2) / weight
        # The derivative of the kernel that is narrow; of the other it is next to nothing.
        pull = kernel @ (log[:, None] * self.sources) / weight[:, None]
        pull -= mean[:, None] * (kernel @ (known[:, None] * self.sources)) / weight[:, None]
        gradient = _KAPPA * (pull - (pull * r).sum(axis=1, keepdims=True) * r)
        steep = np.linalg.norm(gradient, axis=1, keepdims=True)
        gradient *= np.minimum(1, _STEEP / np.maximum(steep, 1e-9))
        return mean, gradient, np.sqrt(np.maximum(square - mean**2, 0))
