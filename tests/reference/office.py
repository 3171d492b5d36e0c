"""A room with windows in closed form: where each ray of the people in it ends."""

import numpy as np

from nerg_mi.rays.rays import Rays

ROOM = np.array([[0.0, 0.0, 0.0], [8.0, 6.0, 3.0]])
WINDOW = np.array([[1.0, 0.8], [5.0, 2.4]])
"""In the wall x = 8: y and z of two corners."""


def office(n: int = 200_000, far: float = 40.0, seed: int = 0) -> Rays:
    """Rays of three people in a room of 8 x 6 x 3 m, evenly in all directions but the steepest; what leaves through the
    window ends 5 to ``far`` metres behind it."""
    rng = np.random.default_rng(seed)
    origin = rng.uniform([1.5, 1.5, 1.5], [6.5, 4.5, 1.7], (n, 3))
    azimuth, z = rng.uniform(0, 2 * np.pi, n), rng.uniform(-0.86, 0.95, n)
    d = np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=1)
    wall = np.where(d > 0, ROOM[1], ROOM[0])
    t = ((wall - origin) / d).min(axis=1)
    out = looks_out(origin, d)
    t[out] += rng.uniform(5, far, out.sum())
    return Rays(np.arange(n) * 0.02, np.arange(n) % 3, tuple("abc"), origin, d, np.ones(n), origin + t[:, None] * d)


def looks_out(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Which rays go through the window, (N,) bool."""
    with np.errstate(divide="ignore"):
        t = np.where(direction[:, 0] > 0, (ROOM[1, 0] - origin[:, 0]) / direction[:, 0], np.nan)
    through = origin[:, 1:] + t[:, None] * direction[:, 1:]
    return ((through > WINDOW[0]) & (through < WINDOW[1])).all(axis=1)
