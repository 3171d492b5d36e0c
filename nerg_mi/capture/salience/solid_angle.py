"""Solid angles of a picture's pixels, whatever the lens.

A pixel covers the directions between those of its four corners: two spherical triangles, whose areas are exact (Van
Oosterom & Strackee 1983). A pinhole's straight edges are great circles, so that its pixels' areas are exact too and
those of all pixels sum to the frustum's; for other lenses the error falls with the square of the pixel's size. To first
order this is the Jacobian dω/dA of the lens: cos³θ / f² for a pinhole (A in the image plane, focal length f, angle θ
from the axis).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from nerg_mi.capture import lens
from nerg_mi.capture.intrinsics import Intrinsics

# Rows of pixels at a time: photos have many.
_ROWS = 256


@lru_cache(maxsize=4)
def pixel_solid_angles(intrinsics: Intrinsics) -> np.ndarray:
    """Solid angles (height, width), sr, float64, read-only. Pixels that a fisheye lens does not reach have none.

    Raises ``ValueError`` as `lens.undistort` does.
    """
    i = intrinsics
    out = np.empty((i.height, i.width))
    for a in range(0, i.height, _ROWS):
        rows = np.arange(a, min(a + _ROWS, i.height) + 1)
        x, y = np.meshgrid((np.arange(i.width + 1) - i.cx) / i.fx, (rows - i.cy) / i.fy)
        xy = np.stack([x, y], axis=-1)
        d = lens.rays(xy, i)
        corner = d[:-1, :-1], d[:-1, 1:], d[1:, 1:], d[1:, :-1]
        part = triangle(*corner[:3]) + triangle(corner[0], *corner[2:])
        if i.fisheye:
            beyond = np.linalg.norm(xy, axis=-1) >= lens.fisheye_limit(i)[1]
            part[beyond[:-1, :-1] & beyond[:-1, 1:] & beyond[1:, 1:] & beyond[1:, :-1]] = 0
        out[a : a + len(part)] = np.maximum(part, 0)
    out.flags.writeable = False
    return out


def triangle(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Signed areas (...) of spherical triangles with unit corners (..., 3); positive where a, b, c are right-handed."""
    dot = lambda u, v: np.einsum("...i,...i->...", u, v)
    return 2 * np.arctan2(dot(a, np.cross(b, c)), 1 + dot(a, b) + dot(b, c) + dot(c, a))
