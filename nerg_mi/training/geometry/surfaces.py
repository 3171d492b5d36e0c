"""Where observers in a place meet surfaces."""

from __future__ import annotations

import numpy as np

from nerg_mi.maths.geometry import AnyBox, box_interval
from nerg_mi.transport.geometry import trace_depth
from nerg_mi.transport.observer_gaze import nearest_depth

from .places import NOWHERE, GazePlace

SURFACE_OPACITY = 0.5
"""Opacity from which on a ray has met a surface; the integrator's default."""


def surface_distances(
    place: GazePlace, positions: np.ndarray, directions: np.ndarray, depth: str = "median", fill: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (P, D) from ``positions`` (P, 3) along unit ``directions`` (P, D, 3) to the surface that each meets,
    float32, and which meet none, (P, D) bool; all in the frame and units of the place.

    ``depth``: kind of depth that is the surface (``transport.depth``). Without any geometry everything is
    ``NOWHERE`` away and nothing counts as escaped. A direction that meets no surface ends where it leaves the place's
    box (or after the box's diagonal, where it never enters): it still needs a p_od at which the field is evaluated.
    With ``fill`` it ends at the depth of the directions of its position nearest to it that do meet one: where the
    geometry has holes.
    """
    P, D = directions.shape[:2]
    if place.medium is None:
        return np.full((P, D), NOWHERE, np.float32), np.zeros((P, D), bool)
    origins = np.repeat(np.asarray(positions, np.float64), D, axis=0)
    flat = np.asarray(directions, np.float64).reshape(-1, 3)
    distance, opacity = trace_depth(place.medium, origins, flat, kind=depth)
    escaped = opacity < SURFACE_OPACITY
    distance[escaped] = box_exit(place.box, origins[escaped], flat[escaped])
    distance, escaped = distance.reshape(P, D), escaped.reshape(P, D)
    if fill:
        for p in np.flatnonzero(escaped.any(axis=1) & ~escaped.all(axis=1)):
            met = ~escaped[p]
            distance[p, escaped[p]] = nearest_depth(directions[p, met], distance[p, met], directions[p, escaped[p]])
    return distance, escaped


def box_exit(box: AnyBox, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance (N,) at which rays leave ``box``; its diagonal for rays that never enter it."""
    near, far = box_interval(origins, directions, box.lower, box.upper)
    return np.where((far > 0) & (near <= far) & np.isfinite(far), far, box.diagonal)
