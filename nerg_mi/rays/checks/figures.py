"""What checks of rays are given besides the rays, and what several of them need."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.rays.rays import Rays

MOST = 200_000
"""Rays looked at, where a part of them says as much as all."""


@dataclass(frozen=True, eq=False)
class Figures:
    """What a summary has found of rays already, in the frame of rays."""

    height: np.ndarray  # (3,) 5, 50 and 95 % of the origins' heights, metres
    extent: np.ndarray  # (3,) of the origins' box, metres
    speed: float  # 95 % of the origins' speeds, m/s; NaN if unknown
    step: float | None  # median of a person's positive times between rays, seconds; NaN: none is; None: no times
    order: np.ndarray | None  # (N,) by person and time, as `filters.time_order` gives it


def to_source(rays: Rays) -> np.ndarray:
    """Rotation, or mirror, from the frame of rays back to the file's, (3, 3): file = R ours."""
    matrix = np.asarray(rays.metadata.get("transform", np.eye(4)), dtype=np.float64)[:3, :3]
    return np.linalg.inv(matrix / np.cbrt(abs(np.linalg.det(matrix))))
