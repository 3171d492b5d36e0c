"""What tracked rays leave on a surface: each as a bundle of rays in a cone, in place of a line without width.

A line ends at one point of a mesh: a thin edge loses it, and a gap lets all of it through. A cone as wide as the
tracker errs and the fovea sees is divided among what it meets (Martin et al., view-cone sampling, arXiv 2601.02721).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .cones import bundle
from .sums import Sums, deposit
from .target import Target

CASTS = 1 << 20
"""Rays that are cast in one launch."""


@dataclass(frozen=True, kw_only=True)
class RaySettings:
    """``cone``: its standard deviation in radian, 0 for a line; ``bundle``: rays of each; ``seed`` of their turns."""

    cone: float = 0.0
    bundle: int = 16
    seed: int = 0

    @property
    def casts(self) -> int:
        """Rays cast for each tracked one."""
        return self.bundle if self.cone > 0 else 1


@dataclass(frozen=True, eq=False)
class TrackedRays:
    """``origins``, unit ``directions`` (N, 3) in the scene and ``weights`` (N,); ``first``: the number of the first one
    among all rays, with which the draws of the bundles begin."""

    origins: np.ndarray
    directions: np.ndarray
    weights: np.ndarray
    first: int = 0

    def __len__(self) -> int:
        return len(self.weights)

    def part(self, start: int, stop: int) -> TrackedRays:
        """The rays from ``start`` up to ``stop``."""
        rows = slice(start, stop)
        return TrackedRays(self.origins[rows], self.directions[rows], self.weights[rows], self.first + start)


def ray_sums(target: Target, rays: TrackedRays, settings: RaySettings) -> Sums:
    """What ``rays`` leave on ``target``: partial sums, which `sums.merge` adds up to those of more rays.

    The draws depend on the seed and on ``rays.first`` alone, so that parts that are cut alike give the same everywhere.
    """
    mesh = target.mesh
    on_faces, on_vertices = np.zeros(len(mesh.faces)), np.zeros(len(mesh.vertices))
    rng = np.random.default_rng([settings.seed, rays.first])
    each, elsewhere, escaped = settings.casts, 0.0, 0.0
    step = max(1, CASTS // each)
    for a in range(0, len(rays), step):
        some = rays.part(a, min(a + step, len(rays)))
        directions = bundle(some.directions, settings.cone, each, rng).reshape(-1, 3)
        ends = target.ends(np.repeat(some.origins, each, axis=0), directions)
        weights = np.repeat(some.weights / each, each)
        on = ends.face >= 0
        found = deposit(mesh.faces, len(mesh.vertices), ends.face[on], ends.place[on], weights[on])
        on_faces, on_vertices = on_faces + found[0], on_vertices + found[1]
        elsewhere += float(weights[ends.elsewhere].sum())
        escaped += float(weights[~on & ~ends.elsewhere].sum())
    weight = float(rays.weights.sum())
    return Sums(on_faces, on_vertices, elsewhere, escaped, weight, weight, len(rays))
