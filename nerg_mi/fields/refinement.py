"""Makes a finer bound of a trained field: which parts of its occupied cells hold anything, and what is missed.

Every part is looked at in the same points of an additive recurrence (Roberts 2018, "The unreasonable effectiveness of
quasirandom sequences", in three dimensions), so that a field always has the same bound. Trained densities are nearly
all either far above or far below any threshold: after a few points the rest are asked for only where one of them came
near it, or where a part beside holds something.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from nerg_mi.maths.arrays import aligned
from nerg_mi.maths.types import Float, UInt32

from .occupancy import PARTS, OccupancyGrid, RefinedGrid, cell_corner, grown

if TYPE_CHECKING:
    from .radiance import RadianceField


POINTS = 64  # Points that a part is looked at in where it is not plain
_FIRST = 8
# A part whose densities at the first points are all below this share of the threshold is empty.
_PLAIN = 1e-4
STEP_DEPTH = 1e-3  # Optical depth of one step from which on a density counts
# The root of x⁴ = x + 1, whose powers are the steps of the recurrence.
_GROWTH = 1.2207440846057596
_SAMPLES = 1 << 17


def refine(field: RadianceField, points: int = POINTS) -> RefinedGrid | None:
    """The refined form of ``field``'s occupancy for its present weights; None where there is no plain grid.

    A density counts from ``STEP_DEPTH`` in a step on, of the field's own length or a 1024th of its box's diagonal.
    """
    grid = field.occupancy
    if isinstance(grid, RefinedGrid):
        grid = grid.coarse
    if not isinstance(grid, OccupancyGrid) or field.box.contracted:
        return None
    step = field.march_step or field.box.diagonal / 1024
    threshold = min(STEP_DEPTH / step, grid.threshold or np.inf)
    ns = field.ns
    with dr.suspend_grad():
        cells = ns.UInt32(aligned(np.flatnonzero(grid.bits), np.uint32))
        masks = _masks(field, grid.bits, cells, threshold, points)
        missed = _missed(field, cells, ns.UInt32(aligned(masks, np.uint32)), grid.resolution, step)
    return RefinedGrid(grid.bits, masks, ns, threshold, grid.threshold, missed)


def _masks(field: RadianceField, bits: np.ndarray, cells: UInt32, threshold: float, points: int) -> np.ndarray:
    """Masks of the parts of ``bits`` (R, R, R), whose occupied cells are ``cells`` (N), that hold a density above the
    ``threshold`` at one of the ``points``: uint8 (N,)."""
    ns, count, resolution = field.ns, PARTS**3, len(bits)
    if dr.width(cells) == 0:
        return np.zeros(0, np.uint8)
    found, near = (dr.zeros(ns.UInt8, count * dr.width(cells)) for _ in range(2))
    for k in range(points):
        if k == _FIRST:
            near |= ns.UInt8(_touching(bits, _packed(found)))
        rest = cast("UInt32", dr.compress((found == 0) & (near > 0) if k >= _FIRST else found == 0))
        if dr.width(rest) == 0:
            break
        # As literals the points would compile a kernel each.
        offset = ns.Array3f(*((0.5 + (k + 1) / _GROWTH ** (axis + 1)) % 1 for axis in range(3)))
        dr.make_opaque(offset)
        shift = ns.Array3f(rest & 1, rest >> 1 & 1, rest >> 2 & 1)
        cell = cell_corner(dr.gather(ns.UInt32, cells, rest // count), resolution, ns)
        sigma = field.density(field.box.from_unit((cell + (shift + offset) / PARTS) / resolution), True)
        dr.scatter(found, ns.UInt8(1), rest, sigma > threshold)
        dr.scatter(near, ns.UInt8(1), rest, sigma > _PLAIN * threshold)
        dr.eval(found, near)
    return _packed(found)


def _packed(found: Any) -> np.ndarray:
    """Masks of cells of the parts that were ``found`` (UInt8 a part)."""
    return np.packbits(found.numpy().reshape(-1, PARTS**3) > 0, axis=1, bitorder="little").ravel()


def _touching(bits: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """Of each part of the occupied cells of ``bits``, whether it is one of ``masks`` or touches one: uint8, ravelled.
    A surface that passes one part may cut a corner off the next."""
    at = np.argwhere(bits)[:, None] * PARTS + np.array(list(np.ndindex(PARTS, PARTS, PARTS)))
    z, y, x = at.reshape(-1, 3).T
    whole = np.zeros([PARTS * n for n in bits.shape], bool)
    whole[z, y, x] = np.unpackbits(masks, bitorder="little")
    return grown(whole)[z, y, x].astype(np.uint8)


def _missed(field: RadianceField, cells: UInt32, masks: UInt32, resolution: int, step: float) -> float:
    """Mean optical depth along random lines through the box of what lies in ``cells`` and in no part of ``masks``.

    By Cauchy's formula (Santaló 1976) that is 4 / S times the integral of the density, S the surface of the box. A
    density counts with what one step absorbs of it, so that a spike weighs no more than light is lost on it.
    """
    if dr.width(cells) == 0:
        return 0.0
    ns, rng = field.ns, np.random.default_rng(0)
    index = ns.UInt32(aligned(rng.integers(0, dr.width(cells), _SAMPLES, np.uint32), np.uint32))
    inside = ns.Array3f(*(ns.Float(aligned(rng.random(_SAMPLES, np.float32))) for _ in range(3)))
    part = [ns.UInt32(c >= 0.5) for c in (inside.x, inside.y, inside.z)]
    bit = (dr.gather(ns.UInt32, masks, index) >> (part[0] | part[1] << 1 | part[2] << 2)) & 1
    u = (cell_corner(dr.gather(ns.UInt32, cells, index), resolution, ns) + inside) / resolution
    sigma = field.density(field.box.from_unit(u), bit == 0)
    lost: Float = dr.select(bit == 0, (1 - dr.exp(-sigma * step)) / step, 0)
    volume = dr.width(cells) * (field.box.cube_side / resolution) ** 3
    a, b, c = np.subtract(field.box.upper, field.box.lower)
    return float(dr.mean(lost)[0]) * volume * 4 / (2 * (a * b + b * c + c * a))
