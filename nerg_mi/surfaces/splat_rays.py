r"""What tracked rays leave on Gaussian splats, and how much gaze meets none.

A ray leaves on each Gaussian that it meets what it would contribute to a picture, T_i α_i: the light that reaches it
times the share that it takes. All of them and what goes through add up to one. It comes to one of the two sides of the
Gaussian (`splat_areas.sides_of`).

Gaze per area is that share by the area that a Gaussian takes of what is seen (`splat_areas`): of rays that fall on a
surface with the density D, a Gaussian receives D ∫ T_i α_i dA, whatever else is around.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from nerg_mi.maths.arrays import vector_of
from nerg_mi.transport.media.splats.arrays import SplatArrays

from .cones import bundle
from .gaze_source import Looker, along_through
from .ray_source import RaySettings, TrackedRays
from .sphere_rule import sphere_rule
from .splat_areas import sides_of
from .splat_hits import groups_of_hits
from .sums import Sums

DIRECTIONS = 1 << 14
"""In which an observer's gaze is looked at, about."""

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


def gaze_and_escaped(arrays: SplatArrays, looker: Looker, eye: np.ndarray, cone: float = 0.0) -> tuple[float, float]:
    """What the gaze of ``looker``, an observer at ``eye`` (3,) in the frame of ``arrays``, adds up to over the sphere,
    and how much of it meets no Gaussian: what comes through, as of rays. ``cone``: as of `gaze_source.GazeSettings`.
    """
    import mitsuba as mi

    along = along_through(looker, cone)
    density = lambda d: np.broadcast_to(np.array(along(vector_of(mi.Vector3f, d)), np.float64), (len(d),))
    with dr.suspend_grad():
        directions, angles = sphere_rule(density, DIRECTIONS)
        share, escaped = angles * density(directions), 0.0
        for group in groups_of_hits(arrays, np.broadcast_to(eye, directions.shape), directions):
            escaped += float((share[group.rows] * group.left)[group.through].sum())
    return float(share.sum()), escaped
