"""A place made from what people looked at, where there are no photos: the rays' hit points as a volume.

Eye trackers in virtual reality record where each ray met the scene. Enough of these points outline what matters: the
surfaces that are looked at. They become voxels, small holes are closed, and the result is a Mitsuba grid volume that
depths are traced in and that the integrator ``nerg`` renders as its ``density``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths.geometry import Box, box_interval
from nerg_mi.rays.rays import Rays

from .hit_extent import HitExtent, hit_extent

# Optical depth of a voxel: one is opaque.
_TAU = 8.0
# Rounds of closing, each of which closes gaps of two voxels.
_CLOSING = 4
# Rays that are walked along to find empty space.
_WALKED = 1 << 17


def voxelise_hits(rays: Rays, voxel: float | None = None, extent: HitExtent | None = None) -> tuple[np.ndarray, Box]:
    """Density (z, y, x) in 1/metre, float32, and the box that it fills, both in the rays' frame.

    A voxel is solid where a ray ended. Gaps of up to eight voxels are closed (morphological closing), but not where a
    ray passed on its way to its hit; then voxels through which people put their heads, and their neighbours, are
    emptied. The box is ``extent``, by default the `hit_extent` of ``rays`` with voxels of edge ``voxel`` metres. Hits
    outside of it are left out; where it was cut, they stand where their rays leave its shell. Raises as `hit_extent`
    does.
    """
    from scipy.ndimage import binary_closing, binary_dilation

    extent = extent or hit_extent(rays, voxel)
    if rays.hit is None:
        raise NergError("these rays have no hit points to make a place from; give a radiance field instead (--field)")
    known = np.isfinite(rays.hit).all(axis=1)
    hits, origins = rays.hit[known], rays.origin[known]
    if extent.cut:
        far = extent.beyond_shell(hits)
        hits[far] = _on_shell(origins[far], hits[far], extent)
        there = np.isfinite(hits).all(axis=1)
        hits, origins = hits[there], origins[there]
    hit, cube = _marked(extent, hits), np.ones((3, 3, 3), bool)
    solid = np.asarray(binary_closing(hit, cube, iterations=_CLOSING), bool)
    solid &= hit | ~_passed(origins, hits, extent)
    solid &= ~np.asarray(binary_dilation(_marked(extent, rays.origin), cube), bool)
    density = np.where(solid, np.float32(_TAU / extent.voxel), np.float32(0))
    return density, Box(tuple(extent.lower.tolist()), tuple(extent.upper.tolist()))


def _marked(extent: HitExtent, points: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Voxels (z, y, x) bool that hold one of ``points``, besides those that ``out`` has."""
    out = np.zeros(extent.shape[::-1], bool) if out is None else out
    inside = points[((points > extent.lower) & (points < extent.upper)).all(axis=1)]
    out[tuple(((inside - extent.lower) / extent.voxel).astype(int).T[::-1])] = True
    return out


def _on_shell(origins: np.ndarray, hits: np.ndarray, extent: HitExtent) -> np.ndarray:
    """Where rays to hits beyond the shell leave it, (N, 3); NaN for those that never are within it."""
    way = hits - origins
    enter, leave = box_interval(origins, way, *extent.shell)
    passes = (leave > np.maximum(enter, 0)) & (leave <= 1)
    return np.where(passes[:, None], origins + way * np.where(passes, leave, 0)[:, None], np.nan)


def _passed(origins: np.ndarray, hits: np.ndarray, extent: HitExtent) -> np.ndarray:
    """Voxels that a ray crossed well before it ended."""
    which = np.random.default_rng(0).permutation(len(hits))[:_WALKED]
    origins, way = origins[which], hits[which] - origins[which]
    length = np.linalg.norm(way, axis=1)
    end = length - 2.5 * extent.voxel
    out = _marked(extent, origins[:0])
    if not len(length):
        return out
    # Nobody looks that far without a gap in the place; the few who seem to must not set the number of rounds.
    for t in np.arange(0, np.quantile(length, 0.99), 0.7 * extent.voxel):
        on = end > t
        _marked(extent, origins[on] + way[on] * (t / length[on, None]), out)
    return out


def volume_dict(path: str | Path) -> dict:
    """The Mitsuba plugin, as a dict, that shows what ``formats.volumes.write_volume`` wrote of hit points.

    Without interpolation, which would bring every surface nearer by most of a voxel.
    """
    return {"type": "gridvolume", "filename": str(path), "use_grid_bbox": True, "filter_type": "nearest"}
