"""Kernel densities of tracked rays in pictures: for a whole picture, and as an observer's view in the integrator."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import DataSummary
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.types import Float, Point3f, Vector3f
from nerg_mi.rays.rays import RayIndex, Rays

from .kde import Backend, SphericalKde, SphericalKdeTable
from .probes import Probes, place_probes

# ---- Frame ----
#
# The ground truth of a whole picture: the kernel density of the rays around an observer, at every pixel.
#
# What the paper shows beside its field (Section 5.3), there in five seconds a frame and more.

METHODS = ("auto", "exact", "table")
MIN_TABLE_DIRECTIONS = 4096  # directions from which on a table is quicker


def make_probe_at(
    rays: Rays, observer: np.ndarray, radius: float = 0.25, *, index: RayIndex | None = None, **options: Any
) -> Probes:
    """The one probe of an observer at ``observer`` (3,), in metres in the rays' frame; ``options`` as for
    :func:`nerg_mi.probes.probes.place_probes`. Raises `NergError` where too few rays start near."""
    options = {"min_rays": 1, "centre": "query", **options}
    return place_probes(rays, radius, queries=np.asarray(observer).reshape(1, 3), index=index, **options)


def compute_directions(observer: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions r_o (N, 3) float32 from ``observer`` (3,) to ``points`` (..., 3), such as the AOV ``position``,
    and the mask (...) of points that have one: finite and not the observer's own place. Others get +z."""
    points = np.asarray(points)
    offset = points.reshape(-1, 3).astype(np.float32) - np.asarray(observer, np.float32)
    length = np.sqrt(np.einsum("ni,ni->n", offset, offset))
    there = np.isfinite(length) & (length > 0)
    offset[~there], length[~there] = (0, 0, 1), 1
    return offset / length[:, None], there.reshape(points.shape[:-1])


def evaluate_kde_frame(
    probe: Probes | SphericalKde,
    directions: np.ndarray | None = None,
    *,
    observer: np.ndarray | None = None,
    points: np.ndarray | None = None,
    mask: np.ndarray | None = None,
    method: str = "auto",
    backend: Backend = None,
) -> np.ndarray:
    """Densities in 1/sr at every pixel, float32, of the shape of the picture.

    ``probe``: one density (:func:`probe_at`). Either ``directions`` (..., 3), unit, from the observer; or ``observer``
    (3,) and ``points`` (..., 3), what each pixel shows. ``mask`` (...): pixels that show a surface; others are 0.

    ``method``: ``exact`` sums all rays at all pixels in one kernel; ``table`` does so on the part of the sphere that is
    seen, at a spacing that resolves the kernels, and interpolates (:mod:`nerg_mi.probes.kde`: within 1e-4 of the
    highest density of one ray's kernel); ``auto`` tabulates from 4,096 pixels on. Run times: docs/explanation/performance.md. Raises
    `NergError` for another word, ``ValueError`` where it is not given where the pixels look, or more than one density.
    """
    if method not in METHODS:
        raise NergError(f'method is "{method}"; it is one of {", ".join(METHODS)}')
    there = None
    if directions is None and points is not None and observer is not None:
        shape = np.shape(points)[:-1]
        directions, there = compute_directions(observer, points)
    elif directions is None or points is not None:
        raise ValueError("say where the pixels look: either directions, or an observer and points")
    else:
        directions = np.asarray(directions, np.float32)
        shape = directions.shape[:-1]
        directions = directions.reshape(-1, 3)
    kde = probe.kde(backend) if isinstance(probe, Probes) else probe
    if kde.count != 1:
        raise ValueError(f"a picture has one observer and needs one probe, got {kde.count}")
    table = method == "table" or (
        method == "auto" and len(directions) >= MIN_TABLE_DIRECTIONS and SphericalKdeTable.is_worthwhile(kde, len(directions))
    )
    density = SphericalKdeTable(kde, directions=directions).evaluate(directions) if table else kde.evaluate(directions)[0]
    density = density.reshape(shape)
    for shown in (there, mask):
        if shown is not None:
            density = np.where(np.asarray(shown, bool), density, np.float32(0))
    return density


# ---- View ----
#
# The kernel density of tracked rays as an observer's view: the ground truth beside a gaze field, inside the integrator
# (``transport.observer``).
#
# An observer's density is that of the rays that started nearest (NeRG, Section 5.3, and the baseline of ``nerg eval
# gaze``). It is gathered once an observer, and summed at every pixel or tabulated (:mod:`nerg_mi.probes.kde`).


class KdeView:
    """``rays`` around observers in the scene.

    ``count``: how many of the nearest; ``kappa``: of their kernels; ``to_world``: from the rays' frame to the scene's;
    ``backend``: as of ``SphericalKde``. What is hidden from the observer fades, as gaze does. Raises `NergError` where
    there are no rays.
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
            raise NergError("there are no rays to show the density of; give a file that has some")
        self.to_world, self.backend = to_world or Similarity(), backend
        self.count, self.kappa = min(count, len(rays)), kappa
        self.basis = DataSummary(len(rays), len(np.unique(rays.person)))
        self._origin, self._direction = rays.origin, rays.direction

    def find_nearest(self, p: np.ndarray) -> np.ndarray:
        """Directions (count, 3) of the rays that started nearest to ``p`` (3,), in metres in the rays' frame."""
        square = ((self._origin - p) ** 2).sum(axis=1)
        if self.count == len(square):
            return self._direction
        return self._direction[np.argpartition(square, self.count - 1)[: self.count]]

    def for_position(self, p_o: Point3f) -> ObservedKde:
        """The density of the observer at ``p_o`` (in the scene, one lane)."""
        p = np.array(self.to_world.point_to_local(p_o), np.float64).ravel()
        rays = self.find_nearest(p)
        kde = SphericalKde(rays, np.array([0, len(rays)]), self.kappa, backend=self.backend)
        return ObservedKde(kde, self.to_world)


class ObservedKde:
    """The density of one observer: that of ``kde``, whose frame ``to_world`` places in the scene.

    ``kde_view.WORTH`` directions or more are looked up in a table, where that costs less; fewer are summed exactly.
    """

    def __init__(self, kde: SphericalKde, to_world: Similarity) -> None:
        self.kde, self.to_world = kde, to_world
        self.table: SphericalKdeTable | None = None  # Made when it first pays

    def evaluate(self, r_o: Vector3f) -> Float:
        """Density (1/sr) in unit scene directions ``r_o``, without derivatives."""
        d = self.to_world.direction_to_local(dr.detach(r_o))
        ns, lanes = self.kde.ns, dr.width(d)
        d = ns.Array3f(d.x, d.y, d.z)
        with dr.suspend_grad():
            # All of a table is made, whatever is seen of it; a texel costs a fifth of a lane.
            if lanes < MIN_TABLE_DIRECTIONS or not SphericalKdeTable.is_worthwhile(self.kde, lanes // 4):
                return self.kde.density(dr.zeros(ns.UInt32, lanes), d)
            if self.table is None:
                self.table = SphericalKdeTable(self.kde)
            return self.table.density(d)
