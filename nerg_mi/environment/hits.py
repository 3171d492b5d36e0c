"""Volume made of hit points: its extent, its voxels and their colour."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.files.safe_read import translate_read_errors
from nerg_mi.maths.geometry import Box, intersect_box_numpy
from nerg_mi.ranges import LENGTHS, check_number
from nerg_mi.tracking.rays import Rays

from .rendering_files import check_vol

# ---- Hit extent ----
#
# Extent and voxel size of a volume made of hit points, within a maximum number of voxels.
#
# Rays through windows end tens of metres behind the room. A box around all hit points would spend most voxels on empty
# space. The box is therefore cut where this saves most voxels per hit point; hit points beyond it are projected along
# their rays onto its surface (the shell), with the right direction and too short a distance.

DEFAULT_VOXEL = 0.08  # Default voxel edge in metres, if the extent allows it

MAX_VOXELS = 1 << 24  # Maximum number of voxels: a file of 64 MiB, 8,600 cubic metres in voxels of the default edge

PADDING_VOXELS = 6  # Voxels of padding around the points

# Fraction of the hit points at either end of an axis that the box may exclude, because a glance through a gap ends tens
# of metres away. The same fraction of the origins is excluded if the box must be cut, because a tracker that loses a
# participant reports arbitrary positions.
_OUTLIER_QUANTILE = 0.005
# Minimum fraction of the hit points inside the box; below it, voxels of the default edge become larger instead
_MIN_INSIDE = 0.75
_MARGIN = 1.0  # Margin in metres around the observers that is never cut
_MAX_SAMPLE, _NUM_STEPS = 1 << 15, 512
# Cutting continues while one step, a 512th of the points, saves this fraction of the maximum number of voxels.
_MIN_SAVING = 0.01


@dataclass(frozen=True)
class HitExtent:
    """Voxel grid of a volume of hit points, in the frame of the rays."""

    lower: np.ndarray  # Lower corner (3,) of the box in metres
    shape: tuple[int, int, int]  # Number of voxels along x, y and z
    voxel: float  # Voxel edge in metres
    is_cut: bool = False  # Whether hit points outside the box are projected onto its shell
    outside_fraction: float = 0.0  # Fraction of the hit points outside the box

    @property
    def upper(self) -> np.ndarray:
        """Upper corner (3,) of the box in metres."""
        return self.lower + np.array(self.shape) * self.voxel

    @property
    def shell(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the shell, the box without its padding, onto which outside hit points are projected."""
        return self.lower + PADDING_VOXELS * self.voxel, self.upper - PADDING_VOXELS * self.voxel

    def is_outside_shell(self, hits: np.ndarray) -> np.ndarray:
        """Return which of ``hits`` (N, 3) are projected onto the shell, (N,) bool; none if the extent is not cut."""
        if not self.is_cut:
            return np.zeros(len(hits), bool)
        # Allow half a voxel, so that a wall at the cut is not projected.
        low, high = self.shell[0] - 0.5 * self.voxel, self.shell[1] + 0.5 * self.voxel
        return np.logical_not(((hits >= low) & (hits <= high)).all(axis=1))


def compute_hit_extent(rays: Rays, voxel: float | None = None, max_voxels: int = MAX_VOXELS) -> HitExtent:
    """Choose the box and voxel size of a volume of hit points.

    The box holds all origins and the hit points except 0.5 % at each end of each axis. If this needs more than
    ``max_voxels`` voxels, the box is cut, at most down to the observers (except 0.5 % at each end of each axis) plus
    one metre. If that is not enough, or if fewer than three quarters of the hit points would remain, the voxels become
    larger, unless ``voxel`` is given.

    Parameters
    ----------
    rays : Rays
        Gaze rays with hit points.
    voxel : float, optional
        Voxel edge in metres.
    max_voxels : int
        Maximum number of voxels.

    Raises
    ------
    NergError
        If the rays have no hit points, or ``voxel`` is too small or not positive.
    """
    if rays.hit is None or not (has_hit := np.isfinite(rays.hit).all(axis=1)).any():
        raise NergError(
            f"these rays have no hit points; pass a model of the environment with {parameter('environment')}"
        )
    if voxel is not None:
        check_number(voxel, LENGTHS, parameter("voxel_size"))
    hits = rays.hit[has_hit]
    first, last = np.quantile(hits, [_OUTLIER_QUANTILE, 1 - _OUTLIER_QUANTILE], axis=0)
    low, high = np.minimum(first, rays.origin.min(axis=0)), np.maximum(last, rays.origin.max(axis=0))
    edge = DEFAULT_VOXEL if voxel is None else voxel
    if np.prod(_count_voxels(low, high, edge)) <= max_voxels:
        return _pad_extent(low, high, edge)
    core = np.quantile(rays.origin, [_OUTLIER_QUANTILE, 1 - _OUTLIER_QUANTILE], axis=0) + [[-_MARGIN], [_MARGIN]]
    core = np.clip(core, low, high)
    rng = np.random.default_rng(0)
    pick = lambda points: points[rng.permutation(len(points))[:_MAX_SAMPLE]]
    points, sample = np.concatenate([pick(hits), pick(rays.origin)]), pick(hits)
    while True:
        box = _cut_box(low, high, core, points, edge, max_voxels)
        inside_fraction = 0.0 if box is None else ((sample >= box[0]) & (sample <= box[1])).all(axis=1).mean()
        if box is not None and (voxel is not None or inside_fraction >= _MIN_INSIDE):
            extent = replace(_pad_extent(*box, edge), is_cut=True)
            return replace(extent, outside_fraction=float(extent.is_outside_shell(hits).mean()))
        if voxel is not None:
            size = " x ".join(f"{s:.3g}" for s in core[1] - core[0])
            raise NergError(
                f"the participants moved in {size} m, which needs more than {max_voxels:,} voxels of {voxel:g} m; "
                f"use a larger {parameter('voxel_size')} or leave it out"
            )
        edge *= 2 ** (1 / 3)  # Half as many voxels


def _count_voxels(low: np.ndarray, high: np.ndarray, voxel: float) -> np.ndarray:
    """Return the number of voxels along each axis of the box from ``low`` to ``high``, as floats because integers may
    overflow.
    """
    return np.ceil((high - (low - PADDING_VOXELS * voxel)) / voxel) + PADDING_VOXELS


def _pad_extent(low: np.ndarray, high: np.ndarray, voxel: float) -> HitExtent:
    """Return the padded extent of the box from ``low`` to ``high``."""
    return HitExtent(low - PADDING_VOXELS * voxel, tuple(_count_voxels(low, high, voxel).astype(int).tolist()), voxel)


def _cut_box(
    low: np.ndarray, high: np.ndarray, core: np.ndarray, points: np.ndarray, voxel: float, max_voxels: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Cut the box from ``low`` to ``high`` to at most ``max_voxels`` voxels, at most down to ``core`` (2, 3).

    Each step cuts the face where giving up a 512th of ``points`` (N, 3) saves most. Returns the corners, or None if
    ``core`` is too large.
    """
    box = np.stack([low, high])
    step = max(1, len(points) // _NUM_STEPS)
    while True:
        points = points[((points >= box[0]) & (points <= box[1])).all(axis=1)]
        count = np.prod(_count_voxels(box[0], box[1], voxel))
        best, cut = 0.0, None
        for axis in range(3):
            along = np.sort(points[:, axis])
            for side in (0, 1):
                # Cut to the next points, or as far as allowed if there are none.
                position = core[side, axis]
                if len(along) > step:
                    position = min(position, along[step]) if side == 0 else max(position, along[-1 - step])
                saving = abs(position - box[side, axis]) / (box[1, axis] - box[0, axis])
                if saving > best:
                    best, cut = saving, (side, axis, position)
        if count <= max_voxels and best * count < _MIN_SAVING * max_voxels:
            break
        if cut is None:
            return None
        box[cut[0], cut[1]] = cut[2]
    return box[0], box[1]


# ---- Hit geometry ----
#
# A volume made of the hit points of the rays, for environments without photos or a mesh.
#
# Eye trackers in virtual reality record where each ray hits the scene. Enough hit points outline the surfaces that are
# looked at. They become voxels, small holes are closed, and the result is a Mitsuba grid volume in which depths are
# traced and that the integrator ``nerg`` renders as its ``density``.

_TAU = 8.0  # Optical depth of a voxel, so that one is opaque
_CLOSING = 4  # Iterations of the morphological closing; each closes gaps of two voxels
_TRAVERSED_RAYS = 1 << 17  # Number of rays that are traversed to find empty space


def voxelise_hits(rays: Rays, voxel: float | None = None, extent: HitExtent | None = None) -> tuple[np.ndarray, Box]:
    """Make a density volume from the hit points of gaze rays.

    A voxel is solid if a ray ended in it. Gaps of up to eight voxels are closed (morphological closing), except where a
    ray passed on its way to its hit point. Voxels that contain observers, and their neighbours, are emptied.

    Parameters
    ----------
    rays : Rays
        Gaze rays with hit points.
    voxel : float, optional
        Voxel edge in metres, if ``extent`` is not given.
    extent : HitExtent, optional
        Voxel grid. Default: `compute_hit_extent`. Hit points outside are left out, or projected onto its shell if it is
        cut.

    Returns
    -------
    density : numpy.ndarray
        Density (z, y, x) in 1/metre, float32.
    box : Box
        Bounds of the volume in the frame of the rays.

    Raises
    ------
    NergError
        As `compute_hit_extent`.
    """
    from scipy.ndimage import binary_closing, binary_dilation

    extent = extent or compute_hit_extent(rays, voxel)
    assert rays.hit is not None  # as checked with the extent
    has_hit = np.isfinite(rays.hit).all(axis=1)
    hits, origins = rays.hit[has_hit], rays.origin[has_hit]
    if extent.is_cut:
        is_outside = extent.is_outside_shell(hits)
        hits[is_outside] = _project_to_shell(origins[is_outside], hits[is_outside], extent)
        is_valid = np.isfinite(hits).all(axis=1)
        hits, origins = hits[is_valid], origins[is_valid]
    hit, cube = _mark_voxels(extent, hits), np.ones((3, 3, 3), bool)
    solid = np.asarray(binary_closing(hit, cube, iterations=_CLOSING), bool)
    solid &= hit | ~_find_crossed_voxels(origins, hits, extent)
    solid &= ~np.asarray(binary_dilation(_mark_voxels(extent, rays.origin), cube), bool)
    density = np.where(solid, np.float32(_TAU / extent.voxel), np.float32(0))
    return density, Box(tuple(extent.lower.tolist()), tuple(extent.upper.tolist()))


def _mark_voxels(extent: HitExtent, points: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Return the voxels (z, y, x) bool that hold one of ``points``, in addition to those of ``out``."""
    out = np.zeros(extent.shape[::-1], bool) if out is None else out
    inside = points[((points > extent.lower) & (points < extent.upper)).all(axis=1)]
    out[tuple(((inside - extent.lower) / extent.voxel).astype(int).T[::-1])] = True
    return out


def _project_to_shell(origins: np.ndarray, hits: np.ndarray, extent: HitExtent) -> np.ndarray:
    """Return where rays to hit points outside the shell leave it, (N, 3); NaN for rays that are never inside."""
    direction = hits - origins
    enter, leave = intersect_box_numpy(origins, direction, *extent.shell)
    is_crossing = (leave > np.maximum(enter, 0)) & (leave <= 1)
    return np.where(is_crossing[:, None], origins + direction * np.where(is_crossing, leave, 0)[:, None], np.nan)


def _find_crossed_voxels(origins: np.ndarray, hits: np.ndarray, extent: HitExtent) -> np.ndarray:
    """Return the voxels that a ray crosses well before its end."""
    subset = np.random.default_rng(0).permutation(len(hits))[:_TRAVERSED_RAYS]
    origins, direction = origins[subset], hits[subset] - origins[subset]
    length = np.linalg.norm(direction, axis=1)
    end = length - 2.5 * extent.voxel
    out = _mark_voxels(extent, origins[:0])
    if not len(length):
        return out
    # The longest rays pass through gaps; they must not determine the number of iterations.
    for t in np.arange(0, np.quantile(length, 0.99), 0.7 * extent.voxel):
        is_before_end = end > t
        _mark_voxels(extent, origins[is_before_end] + direction[is_before_end] * (t / length[is_before_end, None]), out)
    return out


def make_volume_dict(path: str | Path) -> dict:
    """Return the Mitsuba plugin dictionary of a volume file of hit points.

    It does not interpolate, which would move every surface forward by most of a voxel.
    """
    return {"type": "gridvolume", "filename": str(path), "use_grid_bbox": True, "filter_type": "nearest"}


# ---- Hit shading ----
#
# Shading of a volume of hit points, whose colour is unknown: grey by the orientation of the surface, so that floors,
# walls and shelves are distinguishable.


NO_DATA_GREY = 0.65
"""Grey behind hit points, so that their gaps are not mistaken for dark surfaces."""

# Linear grey of surfaces that face along ±x, ±y and ±z.
_GREY = np.array([0.34, 0.16, 0.55])
_CELL = 2
_SMOOTH = 1.2


def shade_hits(density: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute a colour volume for a density volume of hit points.

    Parameters
    ----------
    density : numpy.ndarray
        Density (z, y, x).
    lower, upper : numpy.ndarray
        Corners (3,) of its box.

    Returns
    -------
    color : numpy.ndarray
        Linear colour (z, y, x, 3), float32, in cells of 2 x 2 x 2 voxels.
    upper : numpy.ndarray
        Upper corner (3,) of the box of the colour volume; its lower corner is ``lower``.

    Notes
    -----
    A surface faces the axis along which the occupancy changes most, averaged over some cells around it.
    """
    from scipy.ndimage import gaussian_filter

    shape = np.array(density.shape)
    pad = (-shape) % _CELL
    solid = np.pad(density > 0, [(0, p) for p in pad])
    cells = (shape + pad) // _CELL
    coarse = solid.reshape(cells[0], _CELL, cells[1], _CELL, cells[2], _CELL).mean(axis=(1, 3, 5), dtype=np.float32)
    # A volume of one cell is surrounded by empty cells, so that it faces that axis.
    thin = [(int(n == 1), int(n == 1)) for n in cells]
    padded = np.pad(coarse, thin)
    # The two sides of a sheet have opposite gradients, hence the absolute value.
    slope = [gaussian_filter(np.abs(np.gradient(padded, axis=axis)), _SMOOTH) for axis in (2, 1, 0)]
    within = tuple(slice(before, before + n) for (before, _), n in zip(thin, cells))
    square = np.stack([s * s for s in slope], axis=-1)[within]
    total = square.sum(axis=-1)
    grey = np.divide(
        square @ _GREY.astype(np.float32), total, out=np.full_like(total, _GREY.mean()), where=total > 1e-9
    )
    edge = (np.asarray(upper) - lower) / shape[::-1]
    return np.repeat(grey[..., None], 3, axis=-1).astype(np.float32), lower + cells[::-1] * _CELL * edge


def read_hit_volume(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the density (z, y, x) of the hit-point volume ``path``, and the lower and upper corner of its box.

    Raises `NergError` for other files.
    """
    check_vol(path)
    with translate_read_errors(path, "volume of hit points"):
        shape = np.fromfile(path, "<i4", 4, offset=8)
        lower, upper = np.fromfile(path, "<f4", 6, offset=24).astype(float).reshape(2, 3)
        density = np.fromfile(path, "<f4", int(np.prod(shape, dtype=np.int64)), offset=48)
    if shape[3] != 1 or not (np.isfinite([lower, upper]).all() and (lower < upper).all()):
        raise NergError(
            f'"{path}" is not a volume of hit points; give one that "nerg train gaze --environment hits" has written'
        )
    return density.reshape(shape[2], shape[1], shape[0]), lower, upper
