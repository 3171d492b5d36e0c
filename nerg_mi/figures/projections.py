"""Maps of the sphere: how a longitude and a latitude become a place on paper, and back.

Longitude λ in (-π, π] is positive to the right of the front, latitude φ in [-π/2, π/2] positive upwards. Places (x, y)
lie in [-1, 1] x [-1, 1], on paper twice as wide as it is high. One more map is one more entry of `PROJECTIONS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.errors import NergError

_STEPS = 60
_POLE = 1e-12


@dataclass(frozen=True)
class Projection:
    """``name``; ``summary`` for people; ``forward(longitude, latitude)`` gives (x, y), ``inverse(x, y)`` gives
    (longitude, latitude, inside), where ``inside`` tells whether the place belongs to the map."""

    name: str
    summary: str
    forward: Callable[[Any, Any], tuple[np.ndarray, np.ndarray]]
    inverse: Callable[[Any, Any], tuple[np.ndarray, np.ndarray, np.ndarray]]


def _equirectangular(longitude: Any, latitude: Any) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(longitude, np.float64) / np.pi, np.asarray(latitude, np.float64) / (np.pi / 2)


def _from_equirectangular(x: Any, y: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    return np.pi * x, np.pi / 2 * y, (np.abs(x) <= 1) & (np.abs(y) <= 1)


def _mollweide(longitude: Any, latitude: Any) -> tuple[np.ndarray, np.ndarray]:
    """Mollweide 1805, in Snyder, Map projections: a working manual (1987), p. 249: 2θ + sin 2θ = π sin φ."""
    longitude, latitude = np.broadcast_arrays(np.asarray(longitude, np.float64), np.asarray(latitude, np.float64))
    wanted = np.pi * np.sin(latitude)
    # By halving: what Newton's method does at the poles, where the slope is 0, would be slow.
    low, high = np.full(wanted.shape, -np.pi / 2), np.full(wanted.shape, np.pi / 2)
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        less = 2 * middle + np.sin(2 * middle) < wanted
        low, high = np.where(less, middle, low), np.where(less, high, middle)
    θ = 0.5 * (low + high)
    return longitude / np.pi * np.cos(θ), np.sin(θ)


def _from_mollweide(x: Any, y: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    inside = x**2 + y**2 <= 1
    θ = np.arcsin(np.clip(y, -1, 1))
    latitude = np.arcsin(np.clip((2 * θ + np.sin(2 * θ)) / np.pi, -1, 1))
    longitude = np.pi * x / np.maximum(np.cos(θ), _POLE)
    return np.where(inside, np.clip(longitude, -np.pi, np.pi), 0.0), latitude, inside


PROJECTIONS = {
    projection.name: projection
    for projection in (
        Projection("mollweide", "an ellipse with equal areas", _mollweide, _from_mollweide),
        Projection("equirectangular", "latitude and longitude", _equirectangular, _from_equirectangular),
    )
}


def find_projection(name: str) -> Projection:
    """The projection ``name``. Raises `NergError` for one that is not known."""
    if name not in PROJECTIONS:
        raise NergError(f'there is no projection "{name}"; there are {", ".join(PROJECTIONS)}')
    return PROJECTIONS[name]


def resample(panorama: Any, projection: Projection, width: int) -> tuple[np.ndarray, np.ndarray]:
    """A full-sphere picture (h, w, ...), of the sensor `panorama`, on the paper of ``projection``, ``width`` pixels
    wide and half as high: the nearest pixel's value at each, and where the map is (width // 2, width), bool.

    Columns of a panorama are cells around its front, its first and last row lie at the poles
    (`nerg_mi.transport.geometry`).
    """
    panorama = np.asarray(panorama)
    rows, columns = panorama.shape[:2]
    height = width // 2
    x = (2 * np.arange(width) + 1) / width - 1
    y = 1 - (2 * np.arange(height) + 1) / height
    longitude, latitude, inside = projection.inverse(*np.meshgrid(x, y))
    column = np.floor((longitude / (2 * np.pi) + 0.5) * columns).astype(int) % columns
    row = np.clip(np.rint((0.5 - latitude / np.pi) * (rows - 1)).astype(int), 0, rows - 1)
    return panorama[row, column], inside
