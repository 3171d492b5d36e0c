"""A place made from what people looked at, where there are no photos: the rays' hit points as a volume.

Eye trackers in virtual reality record where each ray met the scene. Enough of these points outline what matters: the
surfaces that are looked at. They become voxels, small holes are closed, and the result is a Mitsuba grid volume that
depths are traced in and that the integrator ``nerg`` renders as its ``density``.
"""
from __future__ import annotations

from pathlib import Path

import numpy as np

from ..attention.rays import Rays
from ..field.box import Box

VOXEL = 0.08
# Optical depth of a voxel: one is opaque.
_TAU = 8.0
_PAD = 6
# Rounds of closing, each of which closes gaps of two voxels.
_CLOSING = 4
# Rays that are walked along to find empty space.
_WALKED = 1 << 17
# Share of the hit points at either end of an axis that the box need not hold: a glance through a gap ends
# tens of metres behind the place.
_OUTLIERS = 0.005
_MOST = 1 << 26


def voxelise_hits(rays: Rays, voxel: float = VOXEL) -> tuple[np.ndarray, Box]:
    """Density (z, y, x) in 1/metre, float32, and the box that it fills, both in the rays' frame.

    A voxel of edge ``voxel`` metres is solid where a ray ended. Gaps of up to eight voxels are closed (morphological
    closing), but not where a ray passed on its way to its hit; then voxels through which people put their heads, and their
    neighbours, are emptied. The box holds all origins and the hits but for half a percent at each end of each axis; hits
    outside of it are left out. Raises ``ValueError`` for rays without hit points, and where the voxels would be too many.
    """
    from scipy.ndimage import binary_closing, binary_dilation

    known = None if rays.hit is None else np.isfinite(rays.hit).all(axis=1)
    if known is None or not known.any():
        raise ValueError("these rays have no hit points to make a place from; give a radiance field instead (--field)")
    if not voxel > 0:
        raise ValueError(f"a voxel's edge must be positive, got {voxel} m")
    hits, origins = rays.hit[known], rays.origin[known]
    first, last = np.quantile(hits, [_OUTLIERS, 1 - _OUTLIERS], axis=0)
    lower = np.minimum(first, rays.origin.min(axis=0)) - _PAD * voxel
    shape = np.ceil((np.maximum(last, rays.origin.max(axis=0)) - lower) / voxel).astype(int) + _PAD
    if np.prod(shape, dtype=float) > _MOST:
        raise ValueError(f"hit points spread over {' x '.join(map(str, shape))} voxels; drop outliers or enlarge the voxel of {voxel} m")

    def marked(points):
        out = np.zeros(shape[::-1], bool)
        inside = points[((points > lower) & (points < lower + shape * voxel)).all(axis=1)]
        out[tuple(((inside - lower) / voxel).astype(int).T[::-1])] = True
        return out

    hit, cube = marked(hits), np.ones((3, 3, 3), bool)
    solid = binary_closing(hit, cube, iterations=_CLOSING)
    solid &= hit | ~_passed(origins, hits, voxel, marked)
    solid &= ~binary_dilation(marked(rays.origin), cube)
    return np.where(solid, np.float32(_TAU / voxel), np.float32(0)), Box(tuple(lower), tuple(lower + shape * voxel))


def _passed(origins: np.ndarray, hits: np.ndarray, voxel: float, marked) -> np.ndarray:
    """Voxels that a ray crossed well before it ended."""
    which = np.random.default_rng(0).permutation(len(hits))[:_WALKED]
    origins, way = origins[which], hits[which] - origins[which]
    length = np.linalg.norm(way, axis=1)
    end = length - 2.5 * voxel
    out = marked(origins[:0])
    # Nobody looks that far without a gap in the place; the few who seem to must not set the number of rounds.
    for t in np.arange(0, np.quantile(length, 0.99), 0.7 * voxel):
        on = end > t
        out |= marked(origins[on] + way[on] * (t / length[on, None]))
    return out


def write_volume(path: str | Path, density: np.ndarray, box: Box) -> None:
    """Write ``density`` (z, y, x) as a Mitsuba ``.vol`` file that knows its ``box``.

    It is read by a ``gridvolume`` with ``use_grid_bbox`` set to true and ``filter_type`` ``nearest`` (file format: Mitsuba's ``VolumeGrid``, version 3).
    """
    z, y, x = density.shape
    with open(path, "wb") as out:
        out.write(b"VOL\x03")
        out.write(np.array([1, x, y, z, 1], "<i4").tobytes())
        out.write(np.array([*box.lower, *box.upper], "<f4").tobytes())
        out.write(np.ascontiguousarray(density, "<f4").tobytes())


def volume_dict(path: str | Path) -> dict:
    """The Mitsuba plugin, as a dict, that shows what ``write_volume`` wrote.

    Without interpolation, which would bring every surface nearer by most of a voxel.
    """
    return {"type": "gridvolume", "filename": str(path), "use_grid_bbox": True, "filter_type": "nearest"}
