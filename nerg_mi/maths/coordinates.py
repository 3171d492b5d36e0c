"""Checks for coordinates too far from the origin for single precision, in which Mitsuba computes."""

from __future__ import annotations

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.ranges import MAX_COORDINATE

MAX_ORIGIN_DISTANCE = 20_000.0
"""Maximum distance from the origin, in units, of data that is small compared with that distance: its resolution is 2 mm
there."""

_WIDTHS = 10
_SAMPLE, _STRAY = 100_000, 0.01


def check_coordinates(points: np.ndarray, name: str) -> None:
    """Raise `NergError` for coordinates of ``points`` (N, 3) that are NaN or exceed `MAX_COORDINATE`; ``name``: for the
    message."""
    within = np.abs(points) <= MAX_COORDINATE
    if not within.all():
        row = int(np.flatnonzero(~within.all(axis=1))[0])
        raise NergError(
            f"{name} must have coordinates from {-MAX_COORDINATE:g} to {MAX_COORDINATE:g}, but row {row} is "
            f"{points[row].tolist()}; correct it, or move the origin closer"
        )


def check_near_origin(points: np.ndarray, name: str, to_file: np.ndarray | None = None) -> None:
    """Raise `NergError` with the offset to subtract, for ``points`` (N, 3) far from the origin.

    Far: beyond `MAX_ORIGIN_DISTANCE` and `_WIDTHS` times their own extent, as survey coordinates are (UTM, ECEF).
    ``name``: for the message; ``to_file``: (4, 4) transform to the coordinates of the file, in which the offset is
    reported.
    """
    points = points[:: max(len(points) // _SAMPLE, 1)]
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return
    lower, upper = np.quantile(points.astype(np.float64), (_STRAY, 1 - _STRAY), axis=0)
    center, width = (lower + upper) / 2, float((upper - lower).max())
    far = float(np.abs(center).max())
    if far > max(MAX_ORIGIN_DISTANCE, _WIDTHS * width):
        center = center if to_file is None else to_file[:3, :3] @ center + to_file[:3, 3]
        offset = ",".join(f"{v:.0f}" for v in np.round(center, -2) + 0.0)
        raise NergError(
            f"{name} lies {far:,.0f} units from the origin of its coordinates, where single precision has steps of "
            f"{np.spacing(np.float32(far)):.2g}; subtract {offset} from it and from all data in the same coordinates "
            "(scenes, rays, cameras)"
        )
