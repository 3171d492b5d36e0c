"""Walls of flat Gaussians that overlap."""

from __future__ import annotations

import numpy as np

from nerg_mi.fields.splats import Splats

TURN_X = (0.0, 1.0, 0.0, 0.0)
"""By half a turn around x: what points along z points against it."""


def wall(z=0.0, side=1.0, apart=0.02, jitter=0.0, opacity=0.9, turned=(1.0, 0.0, 0.0, 0.0), seed=0) -> Splats:
    """A square wall in the plane ``z`` around the axis, of disks that are ``apart`` and 0.7 of that wide."""
    rng = np.random.default_rng(seed)
    x = np.arange(-side / 2 + apart / 2, side / 2, apart)
    p = np.stack([*np.meshgrid(x, x, indexing="ij"), np.full((len(x), len(x)), z)], axis=-1).reshape(-1, 3)
    p[:, 2] += jitter * rng.normal(size=len(p))
    n = len(p)
    scales = np.tile([0.7 * apart, 0.7 * apart, 1e-3], (n, 1))
    return Splats(p, scales, np.tile(turned, (n, 1)), np.full(n, opacity), np.zeros((n, 1, 3)))
