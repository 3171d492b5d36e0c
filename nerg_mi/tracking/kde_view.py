"""Kernel densities of gaze rays for observers in the integrator."""

from __future__ import annotations

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import DataSummary
from nerg_mi.fields.kde import Backend, SphericalKde, SphericalKdeTable
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.types import Float, Point3f, Vector3f

from .rays import Rays

MIN_TABLE_DIRECTIONS = 4096  # Minimum number of directions for which a table is faster

# Kernel density of gaze rays as an observer view, to compare with a gaze field in the integrator
# (``transport.observer``).
#
# The density is estimated from the rays with the nearest origins (NeRG, Section 5.3, and the baseline of ``nerg eval
# gaze``). The rays are selected once per observer; the density is summed at every pixel or tabulated
# (:mod:`nerg_mi.fields.kde`).


class KdeView:
    """Kernel density of the rays nearest to an observer in a scene.

    Parameters
    ----------
    rays : Rays
        Gaze rays.
    count : int
        Number of nearest rays.
    kappa : float
        Concentration of their kernels.
    to_world : Similarity, optional
        Similarity from the frame of the rays to the scene.
    backend : Backend
        Dr.Jit backend (LLVM or CUDA) on which the density is evaluated. Default: that of Mitsuba's variant.

    Raises
    ------
    NergError
        If there are no rays.

    Notes
    -----
    Surfaces hidden from the observer fade as for a gaze field.
    """

    is_occluded = True

    def __init__(
        self,
        rays: Rays,
        count: int = 4096,
        kappa: float = 20.0,
        to_world: Similarity | None = None,
        backend: Backend = None,
    ) -> None:
        if len(rays) == 0:
            raise NergError("the ray file contains no rays; pass a file with at least one")
        self.to_world, self.backend = to_world or Similarity(), backend
        self.count, self.kappa = min(count, len(rays)), kappa
        self.basis = DataSummary(len(rays), len(np.unique(rays.person)), tracking=rays.tracking)
        self._origin, self._direction = rays.origin, rays.direction

    def find_nearest(self, p: np.ndarray) -> np.ndarray:
        """Return the directions (count, 3) of the rays with origins nearest to ``p`` (3,), in metres in the frame of
        the rays.
        """
        square = ((self._origin - p) ** 2).sum(axis=1)
        if self.count == len(square):
            return self._direction
        return self._direction[np.argpartition(square, self.count - 1)[: self.count]]

    def for_position(self, p_o: Point3f) -> ObservedKde:
        """Return the density of the observer at ``p_o`` (in the scene, one lane)."""
        p = np.array(self.to_world.point_to_local(p_o), np.float64).ravel()
        rays = self.find_nearest(p)
        kde = SphericalKde(rays, np.array([0, len(rays)]), self.kappa, backend=self.backend)
        return ObservedKde(kde, self.to_world)


class ObservedKde:
    """Kernel density of one observer; ``to_world`` maps the frame of ``kde`` to the scene.

    From ``MIN_TABLE_DIRECTIONS`` directions on a table is used if it is cheaper; otherwise the density is summed
    exactly.
    """

    def __init__(self, kde: SphericalKde, to_world: Similarity) -> None:
        self.kde, self.to_world = kde, to_world
        self.table: SphericalKdeTable | None = None  # Made on first use

    def evaluate(self, r_o: Vector3f) -> Float:
        """Evaluate the density (1/sr) in unit scene directions ``r_o``, without derivatives."""
        d = self.to_world.direction_to_local(dr.detach(r_o))
        ns, lanes = self.kde.ns, dr.width(d)
        d = ns.Array3f(d.x, d.y, d.z)
        with dr.suspend_grad():
            # The whole table is computed, whatever part is visible; a texel costs a fifth of a lane.
            if lanes < MIN_TABLE_DIRECTIONS or not SphericalKdeTable.is_worthwhile(self.kde, lanes // 4):
                return self.kde.density(dr.zeros(ns.UInt32, lanes), d)
            if self.table is None:
                self.table = SphericalKdeTable(self.kde)
            return self.table.density(d)
