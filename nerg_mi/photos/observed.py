"""Surface points of a reconstruction, by the images in which they were matched, with the error of their distances."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from nerg_mi.maths.transforms import transform_points

# Standard error of a matched position in pixels. COLMAP's own errors of a point are of this size or smaller, and those
# of its poses are unknown.
_PIXEL_ERROR = 1.0
# Minimum parallax in radians, which keeps errors finite.
_MIN_PARALLAX = 1e-4


@dataclass(frozen=True)
class ObservedPoints:
    """Surface points that were matched in one image.

    Attributes
    ----------
    positions
        (N, 3), world.
    relative_errors
        (N,) standard error of each point's distance from the cameras, relative to that distance.
    """

    positions: np.ndarray
    relative_errors: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)

    def transform(self, similarity: np.ndarray) -> ObservedPoints:
        """Transform the positions by ``similarity`` (4, 4)."""
        return ObservedPoints(transform_points(similarity, self.positions), self.relative_errors)


@dataclass(frozen=True)
class MatchedImage:
    """An image of a reconstruction.

    Attributes
    ----------
    center
        Camera centre (3,), world.
    focal
        Focal length in pixels.
    numbers
        Numbers of the points that were matched in it; numbers of unknown points are ignored.
    """

    center: np.ndarray
    focal: float
    numbers: np.ndarray


class PointTable:
    """Surface points by number, with the error of their distances, estimated from all ``images``.

    Parameters
    ----------
    numbers : ndarray
        (N,) int64, distinct.
    positions : ndarray
        (N, 3), world.
    images : iterable of MatchedImage
        All images of the reconstruction.

    Notes
    -----
    A point that n images see at a parallax a (the root mean square angle between the rays and their mean direction) has
    a distance with a relative standard error of about e / (f a √n), for an error of e pixels and a focal length of f
    pixels. A point with a single image has an infinite error.
    """

    def __init__(self, numbers: np.ndarray, positions: np.ndarray, images: Iterable[MatchedImage]):
        order = np.argsort(numbers, kind="stable")
        self._numbers, self._positions = numbers[order], positions[order]
        count, angle, direction = np.zeros(len(order)), np.zeros(len(order)), np.zeros((len(order), 3))
        for image in images:
            row = self._find_rows(image.numbers)
            ray = self._positions[row] - image.center
            # Rows are distinct, so that plain assignments add all of them.
            direction[row] += ray / np.maximum(np.linalg.norm(ray, axis=1), 1e-12)[:, None]
            angle[row] += _PIXEL_ERROR / image.focal
            count[row] += 1
        n = np.maximum(count, 1)
        parallax = np.sqrt(np.maximum(1 - np.sum((direction / n[:, None]) ** 2, axis=1), _MIN_PARALLAX**2))
        self._errors = np.where(count > 1, angle / n / (parallax * np.sqrt(n)), np.inf)

    def select(self, numbers: np.ndarray) -> ObservedPoints:
        """Return the points with these ``numbers``, without unknown ones and repetitions."""
        row = self._find_rows(numbers)
        return ObservedPoints(self._positions[row], self._errors[row])

    def _find_rows(self, numbers: np.ndarray) -> np.ndarray:
        if not len(self._numbers):
            return np.zeros(0, np.int64)
        numbers = np.unique(numbers)
        row = np.minimum(np.searchsorted(self._numbers, numbers), len(self._numbers) - 1)
        return row[self._numbers[row] == numbers]
