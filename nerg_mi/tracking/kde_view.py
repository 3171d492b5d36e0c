"""Kernel densities of gaze rays for whole pictures, and for observers in the integrator."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import DataSummary
from nerg_mi.fields.kde import Backend, SphericalKde, SphericalKdeTable
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.types import Float, Point3f, Vector3f

from .probes import Probes, place_probes
from .rays import RayIndex, Rays

# ---- Frame ----
#
# Ground truth of a whole picture: the kernel density of the rays around an observer, at every pixel.
#
# The paper compares it with its field (Section 5.3), where a frame takes five seconds and more.

METHODS = ("auto", "exact", "table")
MIN_TABLE_DIRECTIONS = 4096  # Minimum number of directions for which a table is faster


def make_probe_at(
    rays: Rays, observer: np.ndarray, radius: float = 0.25, *, index: RayIndex | None = None, **options: Any
) -> Probes:
    """Make the probe of an observer at ``observer`` (3,), in metres in the frame of the rays.

    ``options`` are those of :func:`nerg_mi.tracking.probes.place_probes`. Raises `NergError` if too few rays start
    nearby.
    """
    options = {"min_rays": 1, "centre": "query", **options}
    return place_probes(rays, radius, queries=np.asarray(observer).reshape(1, 3), index=index, **options)


def compute_directions(observer: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute unit directions from an observer to points.

    Parameters
    ----------
    observer : numpy.ndarray
        Observer position (3,).
    points : numpy.ndarray
        Points (..., 3), such as the AOV ``position``.

    Returns
    -------
    directions : numpy.ndarray
        Unit directions (N, 3), float32; +z for invalid points.
    mask : numpy.ndarray
        Mask (...) of valid points: finite and different from the observer's position.
    """
    points = np.asarray(points)
    offset = points.reshape(-1, 3).astype(np.float32) - np.asarray(observer, np.float32)
    length = np.sqrt(np.einsum("ni,ni->n", offset, offset))
    is_valid = np.isfinite(length) & (length > 0)
    offset[~is_valid], length[~is_valid] = (0, 0, 1), 1
    return offset / length[:, None], is_valid.reshape(points.shape[:-1])


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
    """Evaluate the kernel density at every pixel of a picture.

    Parameters
    ----------
    probe : Probes or SphericalKde
        One density (:func:`make_probe_at`).
    directions : numpy.ndarray, optional
        Unit directions (..., 3) from the observer. Alternatively pass ``observer`` and ``points``.
    observer, points : numpy.ndarray, optional
        Observer position (3,) and the points (..., 3) that the pixels show.
    mask : numpy.ndarray, optional
        Pixels (...) that show a surface; others are 0.
    method : str
        ``exact`` sums all rays at all pixels in one kernel. ``table`` interpolates a table of the visible part of the
        sphere, with an error below 1e-4 of the maximum of a single kernel (:mod:`nerg_mi.fields.kde`). ``auto`` uses a
        table from 4,096 pixels on.
    backend : Backend
        Dr.Jit backend (LLVM or CUDA) on which the density is evaluated. Default: that of Mitsuba's variant.

    Returns
    -------
    numpy.ndarray
        Densities (...) in 1/sr, float32, with the shape of the picture.

    Raises
    ------
    NergError
        For an unknown method.
    ValueError
        If the directions are not given exactly once, or ``probe`` has more than one density.
    """
    if method not in METHODS:
        raise NergError(f'the method must be one of {", ".join(METHODS)}, got "{method}"')
    is_valid = None
    if directions is None and points is not None and observer is not None:
        shape = np.shape(points)[:-1]
        directions, is_valid = compute_directions(observer, points)
    elif directions is None or points is not None:
        raise ValueError("pass either directions, or an observer and points")
    else:
        directions = np.asarray(directions, np.float32)
        shape = directions.shape[:-1]
        directions = directions.reshape(-1, 3)
    kde = probe.kde(backend) if isinstance(probe, Probes) else probe
    if kde.count != 1:
        raise ValueError(f"a picture needs exactly one probe, got {kde.count}")
    use_table = method == "table" or (
        method == "auto"
        and len(directions) >= MIN_TABLE_DIRECTIONS
        and SphericalKdeTable.is_worthwhile(kde, len(directions))
    )
    density = (
        SphericalKdeTable(kde, directions=directions).evaluate(directions) if use_table else kde.evaluate(directions)[0]
    )
    density = density.reshape(shape)
    for pixels in (is_valid, mask):
        if pixels is not None:
            density = np.where(np.asarray(pixels, bool), density, np.float32(0))
    return density


# ---- View ----
#
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
