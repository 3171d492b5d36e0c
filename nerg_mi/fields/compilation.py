"""Compilation of a radiance field: evaluating its density network once, on the vertices of voxels near surfaces."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.types import Array3f, UInt32

from .occupancy import MIN_STEP_OPTICAL_DEPTH, CascadeGrid, cascades_from_contracted, dilate
from .radiance import RadianceNetwork
from .voxels import BLOCK_EDGE, CELLS, VERTICES, VoxelArrays, VoxelGrid

_BATCH = 1 << 12  # Blocks per launch
_LOG_RANGE = (-20.0, 30.0)  # Range of stored log densities: those of the density net are limited to 30
_BYTES_PER_BLOCK = 2 * VERTICES + CELLS // 8 + 4


def compile_density(
    field: RadianceNetwork,
    resolution: int,
    start: VoxelGrid | None = None,
    max_bytes: float = math.inf,
    on_progress: Callable[[float], None] = lambda fraction: None,
) -> VoxelGrid:
    """Density of ``field`` in voxels.

    A cell has matter if the field's occupancy contains its centre and if the density at one of its vertices absorbs
    more than `MIN_STEP_OPTICAL_DEPTH` over a march step.

    Parameters
    ----------
    field : RadianceNetwork
        A field that is not compiled.
    resolution : int
        Cells along an edge of the unit cube of its positions, a multiple of 8.
    start : VoxelGrid, optional
        Voxels of the same field with half the resolution: matter is only searched in and next to its cells.
    max_bytes : float
        Limit of the size of the result. Twice as many candidates are refused before any evaluation.
    on_progress : callable
        Called with the fraction that is done.

    Raises
    ------
    NergError
        If the result would exceed ``max_bytes``, or if nothing has matter.
    """
    if field.voxels is not None:
        raise ValueError("the field is compiled already")
    with dr.suspend_grad():
        candidates = _candidate_blocks(field, resolution, start)
        # About half of the candidates turn out to be empty.
        if _BYTES_PER_BLOCK * len(candidates) > 2 * max_bytes:
            raise NergError(_describe_excess(resolution, _BYTES_PER_BLOCK * len(candidates), max_bytes))
        blocks, masks, values = [], [], []
        for first in range(0, len(candidates), _BATCH):
            part = candidates[first : first + _BATCH]
            log_density, mask = _evaluate_blocks(field, part, resolution)
            some = mask.any(axis=1)
            blocks.append(part[some])
            masks.append(mask[some])
            values.append(log_density[some])
            on_progress(min(1.0, (first + _BATCH) / len(candidates)))
    if not any(map(len, blocks)):
        raise NergError(
            f"the radiance field has no matter at the resolution {resolution}: nowhere in its occupied cells it "
            f"absorbs more than {MIN_STEP_OPTICAL_DEPTH:g} over a march step; train it longer"
        )
    arrays = VoxelArrays(
        resolution,
        np.concatenate([np.zeros(0, np.uint32), *blocks]),
        np.concatenate([np.zeros((0, CELLS // 32), np.uint32), *masks]),
        np.concatenate([np.zeros((0, VERTICES), np.float16), *values]),
    )
    if arrays.size > max_bytes:
        raise NergError(_describe_excess(resolution, arrays.size, max_bytes))
    return VoxelGrid(arrays, field.ns)


def _describe_excess(resolution: int, size: float, limit: float) -> str:
    return (
        f"voxels of the resolution {resolution} would take {size / 1e6:.0f} MB, more than the limit of "
        f"{limit / 1e6:.0f} MB; use a lower resolution or a higher {parameter('memory')}"
    )


def bound_voxel_bytes(field: RadianceNetwork, resolution: int) -> int:
    """Upper bound of the size of `compile_density`'s result in bytes, from the field's occupancy alone."""
    with dr.suspend_grad():
        return _BYTES_PER_BLOCK * len(_candidate_blocks(field, resolution, None))


def attach_voxels(field: RadianceNetwork, voxels: VoxelGrid) -> RadianceNetwork:
    """A compiled field with the networks of ``field``, and ``voxels``, which `compile_density` made of it."""
    compiled = copy.copy(field)
    compiled.occupancy = occupancy_of_voxels(field, voxels) or field.occupancy
    compiled.voxels = voxels
    return compiled


def occupancy_of_voxels(field: RadianceNetwork, voxels: VoxelGrid) -> CascadeGrid | None:
    """Occupancy of a contracted ``field`` for its ``voxels``, whose own cells are not equal along rays; None for a box,
    in which the voxels are the occupancy."""
    if field.box.outer_scale is None or field.occupancy is None:
        return None
    grid = field.occupancy
    return cascades_from_contracted(
        voxels.occupied_parts, field.box.outer_scale, field.ns, grid.threshold, grid.resolution
    )


def _candidate_blocks(field: RadianceNetwork, resolution: int, start: VoxelGrid | None) -> np.ndarray:
    """Flat indices (uint32) of the blocks that may have matter."""
    n = resolution // BLOCK_EDGE
    if start is not None:
        if 2 * start.resolution != resolution:
            raise ValueError(f"voxels of {start.resolution} cells do not start a search in {resolution}")
        # Its parts are the blocks of this resolution. Matter at the border of a cell can belong to the next one.
        return np.flatnonzero(dilate(start.occupied_parts)).astype(np.uint32)
    ns, grid = field.ns, field.occupancy
    if grid is None:
        return np.arange(n**3, dtype=np.uint32)
    # Points along an edge of a block, so that each cell of the occupancy grid contains one.
    count = max(1, math.ceil(BLOCK_EDGE * grid.resolution / resolution)) * (2 if field.box.is_contracted else 1)
    index, occupied = dr.arange(ns.UInt32, n**3), dr.zeros(ns.Bool, n**3)
    corner = find_block_corners(index, n, ns)
    for k in range(count**3):
        offset = ns.Array3f(*[dr.opaque(ns.Float, (k // count**axis % count + 0.5) / count) for axis in range(3)])
        occupied |= _is_occupied(field, (corner + offset) / n)
        dr.eval(occupied)
    blocks = occupied.numpy().reshape(n, n, n)
    if field.box.is_contracted:
        blocks = dilate(blocks)
    return np.flatnonzero(blocks).astype(np.uint32)


def _is_occupied(field: RadianceNetwork, u: Array3f):
    """Whether the occupancy of ``field`` contains ``u`` (unit cube of encoded positions)."""
    p = field.box.from_unit(u)
    inside = field.box.contains(p)
    if field.occupancy is None:
        return inside
    return inside & (field.occupancy.distance_to_occupied(field.box.to_cube(p), inside) == 0)


def find_block_corners(index: UInt32, n: int, ns) -> Array3f:
    """Lower corners of blocks in blocks, x fastest."""
    z, y = index // (n * n), index // n % n
    return ns.Array3f(index % n, y, z)


def _evaluate_blocks(field: RadianceNetwork, blocks: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Log densities (float16, (N, 729)) and masks (uint32, (N, 16)) of the N ``blocks``."""
    ns, n, edge = field.ns, resolution // BLOCK_EDGE, BLOCK_EDGE + 1
    index = ns.UInt32(copy_aligned(blocks, np.uint32))
    vertex = dr.arange(ns.UInt32, len(blocks) * VERTICES)
    block, v = vertex // VERTICES, vertex % VERTICES
    corner = find_block_corners(dr.gather(ns.UInt32, index, block), n, ns) * BLOCK_EDGE
    u = (corner + ns.Array3f(v % edge, v // edge % edge, v // (edge * edge))) / resolution
    value = dr.clip(field.log_density(u), *_LOG_RANGE)
    dr.eval(value)
    # The density per encoded unit, of which the contraction of a box leaves the optical depth of a cell unchanged.
    step = field.march_step or field.box.diagonal / 1024
    threshold = math.log(MIN_STEP_OPTICAL_DEPTH / (step * field.config.density_scale))
    lane = dr.arange(ns.UInt32, len(blocks) * CELLS)
    block, c = lane // CELLS, lane % CELLS
    x, y, z = c % BLOCK_EDGE, c // BLOCK_EDGE % BLOCK_EDGE, c // BLOCK_EDGE**2
    first, highest = block * VERTICES + x + edge * (y + edge * z), ns.Float(-math.inf)
    for k in range(8):
        offset = (k & 1) + edge * (k >> 1 & 1) + edge * edge * (k >> 2)
        highest = dr.maximum(highest, dr.gather(ns.Float, value, first + offset))
    corner = find_block_corners(dr.gather(ns.UInt32, index, block), n, ns) * BLOCK_EDGE
    center = (corner + ns.Array3f(x, y, z) + 0.5) / resolution
    matter = (highest > threshold) & _is_occupied(field, center)
    masks = np.packbits(matter.numpy().reshape(len(blocks), CELLS), axis=1, bitorder="little").view("<u4")
    return ns.Float16(value).numpy().reshape(-1, VERTICES), masks
