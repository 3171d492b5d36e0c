"""The pixels of a full-sphere picture and the directions they stand for: the mapping of Mitsuba's `envmap`.

A picture of W x H pixels covers the sphere by longitude φ and polar angle θ, in a frame whose +Y points up:

    v = (sin φ sin θ, cos θ, -cos φ sin θ),    φ = 2π x / W,    θ = π (y - 1/2) / (H - 1)

with (x, y) in pixels, the centre of pixel (i, j) at (i + 1/2, j + 1/2). Columns are cells, as usual. Rows are nodes:
`envmap` interpolates between rows whose first and last lie *at* the poles, so that these two stand for half a row each.
Plain NumPy in float64; the sensor plugin `panorama` evaluates the same formulas in Dr.Jit.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.errors import NergError


def _check(width: int, height: int) -> None:
    if width < 1 or height < 2:
        raise NergError(f"a panorama needs at least 1 x 2 pixels and {width} x {height} were asked for")


def pixel_directions(width: int, height: int) -> np.ndarray:
    """Unit direction of each pixel's centre, in the panorama's own frame: shape (height, width, 3), float64."""
    _check(width, height)
    φ = 2 * np.pi * (np.arange(width) + 0.5) / width
    θ = np.pi * np.arange(height) / (height - 1)
    θ, φ = np.meshgrid(θ, φ, indexing="ij")
    return np.stack([np.sin(φ) * np.sin(θ), np.cos(θ), -np.cos(φ) * np.sin(θ)], axis=-1)


def direction_pixels(directions: np.ndarray, width: int, height: int) -> np.ndarray:
    """Where on the picture a direction lies, in pixels: shape (..., 2) as (x, y), the inverse of the mapping above.

    `directions`: (..., 3), in the panorama's own frame, of any length but zero. x is in [0, width], y in
    [1/2, height - 1/2].
    """
    _check(width, height)
    v = np.asarray(directions, dtype=np.float64)
    φ = np.arctan2(v[..., 0], -v[..., 2]) % (2 * np.pi)
    θ = np.arctan2(np.hypot(v[..., 0], v[..., 2]), v[..., 1])  # precise at the poles, where acos is not
    return np.stack([φ / (2 * np.pi) * width, θ / np.pi * (height - 1) + 0.5], axis=-1)


def pixel_solid_angles(width: int, height: int) -> np.ndarray:
    """Solid angle in steradian that each pixel stands for: shape (height, width), float64; the sum is 4π.

    ω = 2π/W (cos θ₀ - cos θ₁) between the borders of the pixel's row, which end at the poles. A density per steradian
    that was rendered with the `panorama` sensor has the integral `(density * pixel_solid_angles(W, H)).sum()`.
    """
    _check(width, height)
    border = np.clip(np.pi * (np.arange(height + 1) - 0.5) / (height - 1), 0, np.pi)
    ω = 2 * np.pi / width * -np.diff(np.cos(border))
    return np.repeat(ω[:, None], width, axis=1)
