"""The ground truth of a whole picture: the kernel density of the rays around an observer, at every pixel.

What the paper shows beside its field (Section 5.3), there in five seconds a frame and more.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nerg_mi.density.probes import Probes, place_probes
from nerg_mi.errors import NergError
from nerg_mi.rays.index import RayIndex
from nerg_mi.rays.rays import Rays

from .estimate import Backend, SphericalKde
from .table import SphericalKdeTable

METHODS = ("auto", "exact", "table")
WORTH = 4096  # directions from which on a table is quicker


def probe_at(
    rays: Rays, observer: np.ndarray, radius: float = 0.25, *, index: RayIndex | None = None, **options: Any
) -> Probes:
    """The one probe of an observer at ``observer`` (3,), in metres in the rays' frame; ``options`` as for
    :func:`nerg_mi.density.probes.place_probes`. Raises `NergError` where too few rays start near."""
    options = {"min_rays": 1, "centre": "query", **options}
    return place_probes(rays, radius, queries=np.asarray(observer).reshape(1, 3), index=index, **options)


def directions_to(observer: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions r_o (N, 3) float32 from ``observer`` (3,) to ``points`` (..., 3), such as the AOV ``position``,
    and the mask (...) of points that have one: finite and not the observer's own place. Others get +z."""
    points = np.asarray(points)
    offset = points.reshape(-1, 3).astype(np.float32) - np.asarray(observer, np.float32)
    length = np.sqrt(np.einsum("ni,ni->n", offset, offset))
    there = np.isfinite(length) & (length > 0)
    offset[~there], length[~there] = (0, 0, 1), 1
    return offset / length[:, None], there.reshape(points.shape[:-1])


def kde_frame(
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
    seen, at a spacing that resolves the kernels, and interpolates (:mod:`nerg_mi.density.kde.table`: within 1e-4 of the
    highest density of one ray's kernel); ``auto`` tabulates from 4,096 pixels on. Run times: docs/rays.md. Raises
    `NergError` for another word, ``ValueError`` where it is not given where the pixels look, or more than one density.
    """
    if method not in METHODS:
        raise NergError(f'method is "{method}"; it is one of {", ".join(METHODS)}')
    there = None
    if directions is None and points is not None and observer is not None:
        shape = np.shape(points)[:-1]
        directions, there = directions_to(observer, points)
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
        method == "auto" and len(directions) >= WORTH and SphericalKdeTable.fits(kde, len(directions))
    )
    density = SphericalKdeTable(kde, used=directions).evaluate(directions) if table else kde.evaluate(directions)[0]
    density = density.reshape(shape)
    for shown in (there, mask):
        if shown is not None:
            density = np.where(np.asarray(shown, bool), density, np.float32(0))
    return density
