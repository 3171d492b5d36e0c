"""Volume rendering of packed samples in float64 NumPy, ray by ray (Mildenhall et al. 2020, eq. 3)."""

import numpy as np


def weights(tau: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Weights (N,) of samples of optical depth ``tau`` (N,); ``ray`` (N,): index of each sample's ray."""
    out = np.zeros(len(tau))
    for r in np.unique(ray):
        mine = np.flatnonzero(ray == r)
        light = 1.0
        for i in mine:
            out[i] = light * (1 - np.exp(-tau[i]))
            light *= np.exp(-tau[i])
    return out


def ray_sum(x: np.ndarray, ray: np.ndarray, rays: int) -> np.ndarray:
    """Sum of ``x`` along each ray, (rays,)."""
    return np.bincount(ray, x, rays)
