"""Spherical kernel density in plain NumPy, float64: the sum as it is written."""

import numpy as np


def vmf_density(x, mu, kappa):
    """sinh form of the normaliser: independent of the library's; good for κ of 1e-3 to 300."""
    return kappa / (4 * np.pi * np.sinh(kappa)) * np.exp(kappa * (x @ mu.T))


def kde(directions, rays, offsets, kappa, weights=None):
    """(P, D) densities of probes at shared directions (D, 3)."""
    out = []
    for p, (a, b) in enumerate(zip(offsets[:-1], offsets[1:])):
        w = np.ones(b - a) if weights is None else weights[a:b]
        out.append(vmf_density(directions, rays[a:b], kappa[p]) @ (w / w.sum()))
    return np.array(out)
