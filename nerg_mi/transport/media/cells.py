"""The voxels of a grid volume: where its interpolant has kinks, and what bounds it."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.occupancy import OccupancyGrid
from nerg_mi.maths.types import Float

from .local_ray import LocalRay

if TYPE_CHECKING:
    import mitsuba as mi

# Share of a voxel by which a point on a boundary counts as beyond it; far below what a sample can tell.
_NUDGE = 1e-4
# Voxels whose values are asked for at a time.
_ASKED = 1 << 20


class VoxelCells:
    """Axis-aligned cells between which a grid's interpolant has no kink.

    ``lower``, ``upper``: corners of the volume in the scene; ``resolution``: voxels along x, y, z; ``shift``: 0.5 for
    trilinear interpolation, whose pieces meet at voxel centres, 0 for nearest neighbours. ``edge``: of the smallest
    cell, in scene units.
    """

    def __init__(self, lower: Sequence[float], upper: Sequence[float], resolution: Sequence[int], shift: float):
        self._lower = list(lower)
        self._scale = [r / (u - l) for r, l, u in zip(resolution, lower, upper)]
        self._shift = shift
        self.edge = min(1 / s for s in self._scale)

    def next_boundary(self, ray: LocalRay, t: Float) -> Float:
        """Distance at which ``ray`` leaves the cell that it is in just beyond ``t``; rounding may put it before
        ``t``."""
        end = type(t)(dr.inf)
        for o, d, lower, scale in zip(
            (ray.o.x, ray.o.y, ray.o.z), (ray.d.x, ray.d.y, ray.d.z), self._lower, self._scale
        ):
            a, b = (o - lower) * scale - self._shift, d * scale
            c = dr.fma(b, t, a)
            wall = dr.select(b > 0, dr.floor(c + _NUDGE) + 1, dr.ceil(c - _NUDGE) - 1)
            end = dr.minimum(end, dr.select(b != 0, (wall - a) / dr.select(b != 0, b, 1), dr.inf))
        return end


def describe(volume: mi.Volume) -> tuple[VoxelCells, np.ndarray] | None:
    """Cells and voxel values (z, y, x) of an axis-aligned Mitsuba ``gridvolume``; None for any other volume.

    Mitsuba does not tell a volume's transform or interpolation, so both are found by asking for values and
    comparing them with the grid's: what does not match is treated as any other volume. Raises ``NergError`` for a
    grid with values that are not finite or with two channels, of which Mitsuba evaluates none.
    """
    import mitsuba as mi

    if volume.class_name() != "GridVolume":
        return None
    data = np.array(mi.traverse(volume)["data"], np.float32)
    channels = data.size // max(int(np.prod(data.shape[:3])), 1)
    if channels not in (1, 3):
        raise NergError(f'the grid of "density" has {channels} channels; give one with a single channel')
    data = data.reshape(data.shape[:3] + (-1,))[..., 0]
    if not np.all(np.isfinite(data)):
        bad = np.argwhere(~np.isfinite(data))
        raise NergError(
            f'the grid of "density" holds {len(bad)} values that are not finite, the first in voxel '
            f"(z, y, x) = {tuple(bad[0].tolist())}; replace them"
        )
    box = volume.bbox()
    lower, upper = np.array(box.min, float), np.array(box.max, float)
    resolution = data.shape[::-1]
    size = (upper - lower) / resolution
    scale = max(float(np.abs(data).max()), 1e-30)

    def matches(shift: float, tolerance: float) -> bool:
        """Whether the volume has the grid's values at ``shift`` of a voxel from every voxel's lower corner."""
        # Every voxel is asked for: few of them tell a grid that is mostly empty from its mirror image. Some layers at a
        # time: positions take thirty times the memory of values.
        layers = max(1, _ASKED // (data.shape[1] * data.shape[2]))
        for first in range(0, data.shape[0], layers):
            part = data[first : first + layers]
            z, y, x = np.indices(part.shape, np.float32).reshape(3, -1)
            cell = np.stack([x, y, z + first]) + shift
            it = dr.zeros(mi.Interaction3f)
            it.p = mi.Point3f((lower[:, None] + cell * size[:, None]).astype(np.float32))
            if not np.allclose(np.array(volume.eval_1(it)), part.ravel(), atol=tolerance * scale):
                return False
        return True

    if not matches(0.5, 1e-3):
        return None
    # A quarter voxel off the centre, nearest neighbours still return the centre's value.
    nearest = matches(0.25, 1e-6)
    if nearest and not np.allclose(data, data.flat[0]):
        return VoxelCells(lower.tolist(), upper.tolist(), resolution, 0.0), data
    return VoxelCells(lower.tolist(), upper.tolist(), resolution, 0.5), data


def bound(data: np.ndarray, ns: ModuleType) -> OccupancyGrid | None:
    """Cells of a cubic grid over the volume that may hold density: voxel maxima dilated by one voxel.

    The bound holds for every point that either interpolation can reach. None when nothing could be skipped.
    """
    from scipy.ndimage import maximum_filter

    # Beyond its border a grid goes on with its border's voxels, mirrored ones or those of the far side.
    reach = (maximum_filter(data, 3, mode="nearest") > 0) | (maximum_filter(data, 3, mode="wrap") > 0)
    if reach.all():
        return None
    return OccupancyGrid(reach, ns, 0.0)
