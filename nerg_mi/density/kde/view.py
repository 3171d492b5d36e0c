"""The kernel density of tracked rays as an observer's view: the ground truth beside a gaze field, inside the
integrator (``transport.observer.views``).

An observer's density is that of the rays that started nearest (NeRG, Section 5.3, and the baseline of
``nerg eval gaze``). It is gathered once an observer, and summed at every pixel or tabulated
(:mod:`nerg_mi.density.kde.table`).
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.field.gaze.basis import Basis
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.types import Float, Point3f, Vector3f
from nerg_mi.rays.rays import Rays

from .estimate import Backend, SphericalKde
from .frame import WORTH
from .table import SphericalKdeTable


class KdeView:
    """``rays`` around observers in the scene.

    ``count``: how many of the nearest; ``kappa``: of their kernels; ``to_world``: from the rays' frame to the scene's;
    ``backend``: as of ``SphericalKde``. What is hidden from the observer fades, as gaze does. Raises `NergError` where
    there are no rays.
    """

    occluded = True

    def __init__(
        self,
        rays: Rays,
        count: int = 4096,
        kappa: float = 20.0,
        to_world: Similarity | None = None,
        backend: Backend = None,
    ) -> None:
        if len(rays) == 0:
            raise NergError("there are no rays to show the density of; give a file that has some")
        self.to_world, self.backend = to_world or Similarity(), backend
        self.count, self.kappa = min(count, len(rays)), kappa
        self.basis = Basis(len(rays), len(np.unique(rays.person)))
        self._origin, self._direction = rays.origin, rays.direction

    def nearest(self, p: np.ndarray) -> np.ndarray:
        """Directions (count, 3) of the rays that started nearest to ``p`` (3,), in metres in the rays' frame."""
        square = ((self._origin - p) ** 2).sum(axis=1)
        if self.count == len(square):
            return self._direction
        return self._direction[np.argpartition(square, self.count - 1)[: self.count]]

    def at(self, p_o: Point3f) -> ObservedKde:
        """The density of the observer at ``p_o`` (in the scene, one lane)."""
        p = np.array(self.to_world.point_to_local(p_o), np.float64).ravel()
        rays = self.nearest(p)
        kde = SphericalKde(rays, np.array([0, len(rays)]), self.kappa, backend=self.backend)
        return ObservedKde(kde, self.to_world)


class ObservedKde:
    """The density of one observer: that of ``kde``, whose frame ``to_world`` places in the scene.

    ``frame.WORTH`` directions or more are looked up in a table, where that costs less; fewer are summed exactly.
    """

    def __init__(self, kde: SphericalKde, to_world: Similarity) -> None:
        self.kde, self.to_world = kde, to_world
        # Made when it first pays.
        self.table: SphericalKdeTable | None = None

    def value(self, r_o: Vector3f) -> Float:
        """Density (1/sr) in unit scene directions ``r_o``, without derivatives."""
        d = self.to_world.direction_to_local(dr.detach(r_o))
        ns, lanes = self.kde.ns, dr.width(d)
        d = ns.Array3f(d.x, d.y, d.z)
        with dr.suspend_grad():
            # All of a table is made, whatever is seen of it; a texel costs a fifth of a lane.
            if lanes < WORTH or not SphericalKdeTable.fits(self.kde, lanes // 4):
                return self.kde.density(dr.zeros(ns.UInt32, lanes), d)
            if self.table is None:
                self.table = SphericalKdeTable(self.kde)
            return self.table.density(d)
