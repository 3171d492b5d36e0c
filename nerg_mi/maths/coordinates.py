"""Coordinates that are too far from their origin for single precision, in which Mitsuba computes."""

from __future__ import annotations

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.ranges import MAX_COORDINATE

FAR = 20_000.0
"""Distance of the origin, in units, from which on places that are small beside it are refused: 2 mm are lost there."""

_WIDTHS = 10
_SAMPLE, _STRAY = 100_000, 0.01


def check_coordinates(points: np.ndarray, name: str) -> None:
    """Raise `NergError`, which calls ``points`` (N, 3) by their ``name``, for a coordinate that is no number or beyond
    `FARTHEST`."""
    within = np.abs(points) <= MAX_COORDINATE
    if not within.all():
        row = int(np.flatnonzero(~within.all(axis=1))[0])
        raise NergError(
            f"{name} must have coordinates from {-MAX_COORDINATE:g} to {MAX_COORDINATE:g}, and row {row} is "
            f"{points[row].tolist()}; correct it, or move the origin nearer"
        )


def check_near_origin(points: np.ndarray, what: str, to_file: np.ndarray | None = None) -> None:
    """Raise `NergError`, which names the offset to subtract, for ``points`` (N, 3) beyond `FAR` of the origin and
    `_WIDTHS` times as far from it as they are wide, as those of surveys are (UTM, ECEF). ``what``: whose they are;
    ``to_file``: (4, 4), from their coordinates to those of the file, in which the offset is named."""
    points = points[:: max(len(points) // _SAMPLE, 1)]
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return
    lower, upper = np.quantile(points.astype(np.float64), (_STRAY, 1 - _STRAY), axis=0)
    center, width = (lower + upper) / 2, float((upper - lower).max())
    far = float(np.abs(center).max())
    if far > max(FAR, _WIDTHS * width):
        center = center if to_file is None else to_file[:3, :3] @ center + to_file[:3, 3]
        offset = ",".join(f"{v:.0f}" for v in np.round(center, -2) + 0.0)
        raise NergError(
            f"{what} lies {far:,.0f} units from the origin of its coordinates, where single precision has steps of "
            f"{np.spacing(np.float32(far)):.2g}; subtract {offset} from it and from all that shares its coordinates "
            "(places, rays, cameras)"
        )
