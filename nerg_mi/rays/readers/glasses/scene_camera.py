"""Where a pixel, or a pair of angles, of a scene camera looks, in OpenCV's frame: x right, y down, z forward."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.photos.cameras import Intrinsics, undistort_where

_COEFFICIENTS = 8  # k1 k2 p1 p2 k3 k4 k5 k6
_LARGEST = 1e6  # of a calibration's numbers


@dataclass(frozen=True)
class SceneCamera:
    """A calibrated camera: pixels are OpenCV's, the centre of the first one being (0, 0)."""

    lens: Intrinsics

    @classmethod
    def of_opencv(
        cls, matrix: object, coefficients: object, size: Sequence[float] | None = None, where: str = "the calibration"
    ) -> SceneCamera:
        """Of a camera matrix (3, 3) and at most eight coefficients, k1 k2 p1 p2 k3 k4 k5 k6 (those of thin prisms and
        tilted sensors, which follow, must be zero). ``size``: width and height in pixels; without it any pixel is
        taken. Raises `NergError`, naming ``where`` they stand, for what is no calibration."""
        try:
            k = np.asarray(matrix, np.float64).reshape(3, 3)
            d = np.zeros(0) if coefficients is None else np.asarray(coefficients, np.float64).ravel()
            w, h = (0.0, 0.0) if size is None else (float(x) for x in size)
        except (TypeError, ValueError, OverflowError) as error:
            raise NergError(f"{where} needs a camera matrix of 3 x 3 numbers and distortion coefficients") from error
        numbers = np.concatenate([k.ravel(), d, [w, h]])
        if not (np.isfinite(numbers).all() and np.abs(numbers).max() <= _LARGEST and min(k[0, 0], k[1, 1]) > 1e-3):
            raise NergError(f"{where} has no positive focal lengths, or numbers that no camera has; export it again")
        if k[0, 1] != 0 or d[_COEFFICIENTS:].any():
            raise NergError(
                f"{where} has a skew, or coefficients beyond OpenCV's rational model of eight, which are not supported"
            )
        k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(d[:_COEFFICIENTS], (0, max(0, _COEFFICIENTS - len(d)))).tolist()
        fx, fy, cx, cy = (float(x) for x in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
        return cls(Intrinsics(int(w), int(h), fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6))

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (n, 3) of ``pixels`` (n, 2); NaN beyond the picture, and where the lens shows nothing."""
        lens = self.lens
        good = np.isfinite(pixels).all(axis=1)
        if lens.width and lens.height:
            with np.errstate(invalid="ignore"):
                good &= ((pixels >= -0.5) & (pixels <= [lens.width - 0.5, lens.height - 0.5])).all(axis=1)
        out = np.full((len(pixels), 3), np.nan)
        xy, shown = undistort_where((pixels[good] - [lens.cx, lens.cy]) / [lens.fx, lens.fy], lens)
        d = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        out[good] = np.where(shown[:, None], d / np.linalg.norm(d, axis=1, keepdims=True), np.nan)
        return out


def directions_from_angles(angles: np.ndarray) -> np.ndarray:
    """Unit directions (n, 3) of azimuths (to the right) and elevations (up), (n, 2) in degrees."""
    azimuth, elevation = np.radians(angles).T
    return np.stack(
        [np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), np.cos(elevation) * np.cos(azimuth)], axis=1
    )


def angles_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees (n,) between vectors (n, 3) of any length; exact for small angles too. NaN where one is not finite."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))
