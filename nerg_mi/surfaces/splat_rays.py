r"""What tracked rays leave on Gaussian splats.

A ray leaves on each Gaussian that it meets what it would contribute to a picture, T_i α_i: the light that reaches it
times the share that it takes. All of them and what goes through add up to one. It comes to one of the two sides of the
Gaussian (`splat_areas.sides_of`).

Gaze per area is that share by the area that a Gaussian takes of what is seen (`splat_areas`): of rays that fall on a
surface with the density D, a Gaussian receives D ∫ T_i α_i dA, whatever else is around.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.transport.media.splats.arrays import SplatArrays

from .cones import bundle
from .ray_source import RaySettings, TrackedRays
from .splat_areas import sides_of
from .splat_hits import groups_of_hits
from .sums import Sums

CASTS = 1 << 17
"""Rays that are cast in one launch: each brings a dozen hits."""


def splat_ray_sums(arrays: SplatArrays, axes: np.ndarray, rays: TrackedRays, settings: RaySettings) -> Sums:
    """What ``rays``, in the frame of ``arrays``, leave on the Gaussians: partial sums, whose ``face`` (2 N,) are the
    shares on their sides 0, then on their sides 1, and whose ``vertex`` is empty.

    ``axes`` (N, 3): their shortest axes. ``escaped`` is the light that meets nothing more; what is left where a march
    ends is unaccounted for: 1e-4 of a ray at most. The draws depend on the seed and on ``rays.first`` alone.
    """
    count = len(axes)
    rng = np.random.default_rng([settings.seed, rays.first])
    each, shares, escaped = settings.casts, np.zeros(2 * count), 0.0
    step = max(1, CASTS // each)
    for a in range(0, len(rays), step):
        some = rays.part(a, min(a + step, len(rays)))
        directions = bundle(some.directions, settings.cone, each, rng).reshape(-1, 3)
        weights = np.repeat(some.weights / each, each)
        for group in groups_of_hits(arrays, np.repeat(some.origins, each, axis=0), directions):
            ray, hit = np.nonzero(group.index >= 0)
            thing, rows = group.index[ray, hit], group.rows[ray]
            side = sides_of(directions[rows], axes[thing])
            share = weights[rows] * group.arriving[ray, hit] * group.absorbed[ray, hit]
            shares += np.bincount(side * count + thing, share, 2 * count)
            escaped += float((weights[group.rows] * group.left)[group.through].sum())
    weight = float(rays.weights.sum())
    return Sums(shares, np.zeros(0), 0.0, escaped, weight, weight, len(rays))
