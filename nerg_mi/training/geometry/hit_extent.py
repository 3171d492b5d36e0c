"""How far a place made of hit points reaches, and how fine it is, so that its voxels stay within a stated number.

Rays that leave through windows end tens of metres behind the room in which people are. A box around all of them would
spend nearly every voxel on air. So the box gives up hit points where that saves most voxels for each of them; those
beyond it are drawn where their rays leave it (its shell), in their true directions at too short a distance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.ranges import LENGTHS, check_number
from nerg_mi.rays.rays import Rays

VOXEL = 0.08
"""Edge of a voxel in metres where none is asked for and the place is not too large for it."""

MOST = 1 << 24
"""Voxels of a place: a file of 64 MiB, 8,600 cubic metres in voxels of the default edge."""

PAD = 6
"""Voxels around the points that a box holds."""

# Share of the hit points at either end of an axis that the box need not hold: a glance through a gap ends tens of
# metres behind the place. The same of the origins, where a box must be cut: a tracker that loses somebody puts them
# anywhere.
_OUTLIERS = 0.005
# Share of the hit points that a box keeps at least, before voxels of a default edge become larger instead.
_KEPT = 0.75
# Metres around where people were that a box keeps at least: what is looked at most is near.
_MARGIN = 1.0
_SAMPLE, _STEPS = 1 << 15, 512
# A box that is cut goes on being cut while one step, a 512th of the points, saves this share of the most voxels that
# may be.
_WORTH = 0.01


@dataclass(frozen=True)
class HitExtent:
    """Voxels of a place of hit points, in the rays' frame."""

    # Lower corner (3,) of the box in metres.
    lower: np.ndarray
    # Voxels along x, y and z.
    shape: tuple[int, int, int]
    # Their edge in metres.
    voxel: float
    # Whether hit points beyond the box stand on its shell.
    cut: bool = False
    # Their share of the hit points.
    beyond: float = 0.0

    @property
    def upper(self) -> np.ndarray:
        """Upper corner (3,) of the box in metres."""
        return self.lower + np.array(self.shape) * self.voxel

    @property
    def shell(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the box on which hit points beyond stand: inside of the padding."""
        return self.lower + PAD * self.voxel, self.upper - PAD * self.voxel

    def beyond_shell(self, hits: np.ndarray) -> np.ndarray:
        """Which of ``hits`` (N, 3) stand on the shell, (N,) bool; none of a place that was not cut."""
        if not self.cut:
            return np.zeros(len(hits), bool)
        # A wall along which the box was cut is no more than half a voxel beyond it.
        low, high = self.shell[0] - 0.5 * self.voxel, self.shell[1] + 0.5 * self.voxel
        return np.logical_not(((hits >= low) & (hits <= high)).all(axis=1))


def hit_extent(rays: Rays, voxel: float | None = None, most: int = MOST) -> HitExtent:
    """The box of a place of at most ``most`` voxels made from the hit points of ``rays``.

    It holds all origins and the hits but for half a percent at each end of each axis. Where these are too many voxels
    it is cut to where most of them are worth their room, at the least to where people were (all but half a percent at
    each end of each axis) and a metre around. Where that is not enough, or less than three quarters of the hit points
    would be left, voxels become larger; not so a ``voxel`` that was asked for.

    Raises `NergError` for rays without hit points and for a ``voxel`` that is too small or not positive.
    """
    if rays.hit is None or not (known := np.isfinite(rays.hit).all(axis=1)).any():
        raise NergError("these rays have no hit points to make a place from; give a radiance field instead (--field)")
    if voxel is not None:
        check_number(voxel, LENGTHS, "--voxel")
    hits = rays.hit[known]
    first, last = np.quantile(hits, [_OUTLIERS, 1 - _OUTLIERS], axis=0)
    low, high = np.minimum(first, rays.origin.min(axis=0)), np.maximum(last, rays.origin.max(axis=0))
    edge = VOXEL if voxel is None else voxel
    if np.prod(_count(low, high, edge)) <= most:
        return _padded(low, high, edge)
    core = np.quantile(rays.origin, [_OUTLIERS, 1 - _OUTLIERS], axis=0) + [[-_MARGIN], [_MARGIN]]
    core = np.clip(core, low, high)
    rng = np.random.default_rng(0)
    pick = lambda points: points[rng.permutation(len(points))[:_SAMPLE]]
    points, sample = np.concatenate([pick(hits), pick(rays.origin)]), pick(hits)
    while True:
        box = _cut(low, high, core, points, edge, most)
        kept = 0.0 if box is None else ((sample >= box[0]) & (sample <= box[1])).all(axis=1).mean()
        if box is not None and (voxel is not None or kept >= _KEPT):
            extent = replace(_padded(*box, edge), cut=True)
            return replace(extent, beyond=float(extent.beyond_shell(hits).mean()))
        if voxel is not None:
            size = " x ".join(f"{s:.3g}" for s in core[1] - core[0])
            raise NergError(
                f"people were in {size} m, which is more than {most:,} voxels of {voxel:g} m; "
                "enlarge the voxel (--voxel) or leave it out"
            )
        # Half as many voxels.
        edge *= 2 ** (1 / 3)


def _count(low: np.ndarray, high: np.ndarray, voxel: float) -> np.ndarray:
    """Voxels along each axis of the box around ``low`` and ``high``, as floats: they may be too many for integers."""
    return np.ceil((high - (low - PAD * voxel)) / voxel) + PAD


def _padded(low: np.ndarray, high: np.ndarray, voxel: float) -> HitExtent:
    """The extent of the box around ``low`` and ``high``."""
    return HitExtent(low - PAD * voxel, tuple(_count(low, high, voxel).astype(int).tolist()), voxel)


def _cut(
    low: np.ndarray, high: np.ndarray, core: np.ndarray, points: np.ndarray, voxel: float, most: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Corners of a box of at most ``most`` voxels, from ``low`` to ``high`` cut face by face down to ``core`` (2, 3) at
    the least: each time where giving up a 512th of ``points`` (N, 3) saves most voxels. None where ``core`` is too
    large."""
    box = np.stack([low, high])
    step = max(1, len(points) // _STEPS)
    while True:
        points = points[((points >= box[0]) & (points <= box[1])).all(axis=1)]
        count = np.prod(_count(box[0], box[1], voxel))
        best, cut = 0.0, None
        for axis in range(3):
            along = np.sort(points[:, axis])
            for side in (0, 1):
                # As far as the next points reach, or as far as it may be cut if there are none.
                to = core[side, axis]
                if len(along) > step:
                    to = min(to, along[step]) if side == 0 else max(to, along[-1 - step])
                worth = abs(to - box[side, axis]) / (box[1, axis] - box[0, axis])
                if worth > best:
                    best, cut = worth, (side, axis, to)
        if count <= most and best * count < _WORTH * most:
            break
        if cut is None:
            return None
        box[cut[0], cut[1]] = cut[2]
    return box[0], box[1]
