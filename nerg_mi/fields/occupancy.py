"""Occupancy grids: over a box, refined, and as cascades over contracted space."""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, cast

import drjit as dr
import numpy as np

from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.types import Array3f, Bool, Float, UInt32

if TYPE_CHECKING:
    from typing_extensions import Self

    from .radiance import RadianceNetwork

# ---- Occupancy ----
#
# Where a field may have density: one bit per cell, and the distance to the nearest occupied cell.
#
# A march skips a step only if its midpoint lies in an empty cell. With the chessboard distance to the nearest occupied
# cell, a ray skips many empty cells with one look-up.

_FAR = 255


class _Bits:
    """Base of grids with one bit per cell."""

    DRJIT_STRUCT: ClassVar[dict[str, Any]] = {"distance": None}
    bits: np.ndarray

    @property
    def coarse(self) -> Self:
        """The grid itself: it does not refine another one (`RefinedGrid.coarse`)."""
        return self

    def pack_bits(self) -> np.ndarray:
        """The bits as bytes, level by level, x fastest, lowest bit first; see ``from_packed``."""
        return np.packbits(self.bits.ravel(), bitorder="little")


class OccupancyGrid(_Bits):
    """Grid over the unit cube, x varying fastest.

    ``bits``: bool array, indexed [z, y, x] (cubic for a field, of resolution R). ``threshold``: density (1/unit) below
    which a cell counts as empty, also stored in checkpoints. Raises ``ValueError`` unless ``bits`` has three axes.
    """

    UNRECORDED = ("bits",)

    def __init__(self, bits: np.ndarray, ns: ModuleType, threshold: float):
        bits = np.asarray(bits, bool)
        if bits.ndim != 3 or 0 in bits.shape:
            raise ValueError(f"an occupancy grid has three axes of at least one cell, got shape {bits.shape}")
        self.bits, self.threshold = bits, float(threshold)
        self.cells = bits.shape[::-1]
        self.distance = ns.UInt8(chessboard_distance(bits).ravel())

    @property
    def resolution(self) -> int:
        """Cells along an edge of a cubic grid."""
        if len(set(self.cells)) != 1:
            raise ValueError(f"a grid of {self.cells} cells has no single resolution; fields need a cubic one")
        return self.cells[0]

    @property
    def occupied_fraction(self) -> float:
        """Fraction of the cells that are occupied."""
        return float(self.bits.mean())

    def distance_to_occupied(self, u: Array3f, active: Bool | bool = True) -> UInt32:
        """Chessboard distance in cells (UInt32) from the cell of ``u`` (unit cube) to an occupied one; 0: occupied.

        Points outside the cube are clamped to its nearest cell.
        """
        uint: Any = dr.uint32_array_t(type(u.x))
        c = [uint(dr.clip(x * n, 0, n - 1)) for x, n in zip((u.x, u.y, u.z), self.cells)]
        index = c[0] + self.cells[0] * (c[1] + self.cells[1] * c[2])
        return uint(dr.gather(type(self.distance), self.distance, index, active))

    @staticmethod
    def from_packed(data: np.ndarray, resolution: int, ns: ModuleType, threshold: float) -> OccupancyGrid:
        """The cubic grid with ``resolution`` cells per edge from packed bits ``data`` (uint8). Raises ``ValueError`` if
        they are too few."""
        return OccupancyGrid(unpack_bits(data, resolution), ns, threshold)


def unpack_bits(data: np.ndarray, resolution: int) -> np.ndarray:
    """The bits (R, R, R) of a cubic grid of ``resolution`` R from packed bits ``data`` (uint8). Raises ``ValueError``
    if they are too few."""
    if data.size * 8 < resolution**3:
        raise ValueError(
            f"an occupancy grid of resolution {resolution} needs {resolution**3 // 8} bytes, got {data.size}"
        )
    return np.unpackbits(data, bitorder="little")[: resolution**3].reshape((resolution,) * 3).astype(bool)


def cell_corner(index: UInt32, resolution: int, ns: ModuleType) -> Array3f:
    """Lower corners of cells of a cubic grid, x fastest, in cells."""
    z = index // (resolution * resolution)
    y = index // resolution - z * resolution
    return ns.Array3f(index - (z * resolution + y) * resolution, y, z)


def chessboard_distance(bits: np.ndarray) -> np.ndarray:
    """Chessboard distance in cells to the nearest occupied cell of a bool array: 0..255 (uint8, 0: occupied).

    The occupied cells are dilated by one layer per iteration, with 64 cells of a row in a word, and each iteration
    counts the cells not yet reached. The count is stored as bit planes, of which an iteration changes two on average.
    Padding behind the end of a row is reached no earlier than through the row, and is removed at the end.
    """
    if not bits.any():
        return np.full(bits.shape, _FAR, np.uint8)
    *_, n = bits.shape
    wide = np.zeros((*bits.shape[:-1], -(-n // 64) * 64), bool)
    wide[..., :n] = True
    inside = _to_words(wide)
    wide[..., :n] = bits
    reached, planes = _to_words(wide), []
    for _ in range(_FAR):
        carry = inside & ~reached
        if not carry.any():
            break
        for k in range(8):
            if k == len(planes):
                planes.append(np.zeros_like(inside))
            planes[k], carry = planes[k] ^ carry, planes[k] & carry
            if not carry.any():
                break
        reached = _dilate_words(reached)
    distance = np.zeros(wide.shape, np.uint8)
    for k, plane in enumerate(planes):
        distance |= np.unpackbits(plane.view(np.uint8), axis=-1, bitorder="little") << np.uint8(k)
    return np.ascontiguousarray(distance[..., :n])


def _to_words(cells: np.ndarray) -> np.ndarray:
    """Rows of ``cells`` (bool, a multiple of 64 in the last axis) as words, lowest bit first."""
    return np.packbits(cells, axis=-1, bitorder="little").view("<u8")


def _dilate_words(words: np.ndarray) -> np.ndarray:
    """`dilate` for cells in words."""
    one, last = np.uint64(1), np.uint64(63)
    out = words | words << one | words >> one
    out[..., 1:] |= words[..., :-1] >> last
    out[..., :-1] |= words[..., 1:] << last
    for axis in range(words.ndim - 1):
        before = np.moveaxis(out, axis, 0)
        out = out.copy()
        moved = np.moveaxis(out, axis, 0)
        moved[1:] |= before[:-1]
        moved[:-1] |= before[1:]
    return out


def dilate(cells: np.ndarray) -> np.ndarray:
    """``cells`` (bool, three axes) and all cells that touch one of them by a face, an edge or a corner."""
    # Axis by axis: a tenth of the work of a dilation by the whole cube.
    for axis in range(3):
        before, grown = np.moveaxis(cells, axis, 0), cells.copy()
        moved = np.moveaxis(grown, axis, 0)
        moved[1:] |= before[:-1]
        moved[:-1] |= before[1:]
        cells = grown
    return cells


# ---- Occupancy in nested cubes about the origin, as in instant-ngp and torch-ngp ----

_MAX_PARTS = 64
_MAX_CELLS = 1 << 24


class CascadeGrid(_Bits):
    """Levels of R³ bits over the cubes [-b, b]³, b = min(2^l, ``bound``): a point belongs to the smallest cube that
    contains it.

    ``bits``: bool array (levels, R, R, R), indexed [level, z, y, x]. A march sees one grid of equal cells over [-bound,
    bound]³, fine enough that it divides no cell of any level; this grid is never stored. ``threshold``: as for
    `OccupancyGrid`.
    """

    def __init__(self, bits: np.ndarray, bound: float, ns: ModuleType, threshold: float):
        bits = np.asarray(bits, bool)
        if (
            bits.ndim != 4
            or len(set(bits.shape[1:])) != 1
            or bits.shape[1] % 2
            or len(bits) != count_cascade_levels(bound)
        ):
            raise ValueError(
                f"cascades of a bound of {bound} are {count_cascade_levels(bound)} cubes with an even number of cells "
                f"along each edge, got shape {bits.shape}"
            )
        self.bits, self.bound, self.threshold = bits, float(bound), float(threshold)
        r = bits.shape[1]
        self._halves = [min(2.0**level, self.bound) for level in range(len(bits))]
        parts = [m for m in range(1, _MAX_PARTS + 1) if (self.bound * m).is_integer()]
        if not parts:
            raise ValueError(
                f"the bound {bound} of cascades must be a multiple of 1/m for a whole number m up to {_MAX_PARTS}"
            )
        # Cells of the common grid per cell of each level.
        self._ratios = [int(h * parts[0]) for h in self._halves]
        self.cells = (r * self._ratios[-1],) * 3
        if self.cells[0] > _MAX_CELLS:
            raise ValueError(
                f"cascades of {r} cells to a bound of {bound} need {self.cells[0]} equal cells along an edge; "
                f"float32 distinguishes at most {_MAX_CELLS}"
            )
        self.distance = ns.UInt8(np.stack(self._compute_distances()).ravel())

    @property
    def resolution(self) -> int:
        """Cells along an edge of each level."""
        return self.bits.shape[1]

    @property
    def occupied_fraction(self) -> float:
        """Fraction of the volume that is occupied."""
        volume, inner = 0.0, 0.0
        for level, half in enumerate(self._halves):
            outside = self.bits[level] & ~self._within(level, inner)
            volume += outside.sum() * (2 * half / self.resolution) ** 3
            inner = half
        return float(volume / (2 * self.bound) ** 3)

    def _within(self, level: int, half: float) -> np.ndarray:
        """Cells of ``level`` entirely inside [-half, half]³."""
        edges = np.linspace(-1, 1, self.resolution + 1) * self._halves[level]
        inside = (edges[:-1] >= -half) & (edges[1:] <= half)
        return inside[:, None, None] & inside[:, None] & inside

    def _compute_distances(self) -> list[np.ndarray]:
        """For each level, chessboard distances in its own cells to cells that are occupied or outside the level; 0:
        occupied."""
        out, finer, inner = [], None, 0.0
        for level, bits in enumerate(self.bits):
            full = bits & ~self._within(level, inner)
            if finer is not None:
                full |= self._coarsen(finer, level)
            last = level + 1 == len(self.bits)
            # Cells around a level are not known to be empty, except around the last one.
            padded = np.pad(full, 1, constant_values=not last)
            distance = chessboard_distance(padded)[1:-1, 1:-1, 1:-1]
            out.append(np.where(bits, 0, np.maximum(distance, 1)).astype(np.uint8))
            finer, inner = full, self._halves[level]
        return out

    def _coarsen(self, finer: np.ndarray, level: int) -> np.ndarray:
        """Cells of ``level`` that overlap an occupied cell of the previous level."""
        r, small, large = self.resolution, self._ratios[level - 1], self._ratios[level]
        first = (np.arange(r) * small + r // 2 * (large - small)) // large
        last = (np.arange(r) * small + small - 1 + r // 2 * (large - small)) // large
        z, y, x = np.nonzero(finer)
        out = np.zeros((r, r, r), bool)
        for az in (first, last):
            for ay in (first, last):
                for ax in (first, last):
                    out[az[z], ay[y], ax[x]] = True
        return out

    def distance_to_occupied(self, u: Array3f, active: Bool | bool = True) -> UInt32:
        """Distance in cells of the common grid (UInt32) from the cell of ``u`` (unit cube) to an occupied one; 0:
        occupied.

        Points outside the cube are clamped to its nearest cell.
        """
        uint, r, n = dr.uint32_array_t(type(u.x)), self.resolution, self.cells[0]
        # Integers from here on, so that a point always belongs to the same cell.
        cell = [uint(dr.clip(x * n, 0, n - 1)) for x in (u.x, u.y, u.z)]
        # Twice the distance of the cell's centre from that of the grid.
        away = [dr.abs(dr.int32_array_t(type(u.x))(c) * 2 + 1 - n) for c in cell]
        far = dr.maximum(dr.maximum(away[0], away[1]), away[2])
        last = self._ratios[-1]
        ratio, level, inverse = uint(last), uint(len(self._ratios) - 1), type(u.x)(1 / last)
        for k in range(len(self._ratios) - 2, -1, -1):
            inside, part = far < r * self._ratios[k], self._ratios[k]
            ratio, level = dr.select(inside, part, ratio), dr.select(inside, k, level)
            inverse = dr.select(inside, 1 / part, inverse)
        shift = (n - r * ratio) // 2
        # At least half a cell from the next integer, more than any rounding error.
        c = [uint((type(u.x)(c - shift) + 0.5) * inverse) for c in cell]
        index = c[0] + r * (c[1] + r * (c[2] + r * level))
        k = uint(dr.gather(type(self.distance), self.distance, index, active))
        return dr.select(k > 1, (k - 1) * ratio + 1, k)

    @staticmethod
    def from_packed(data: np.ndarray, resolution: int, bound: float, ns: ModuleType, threshold: float) -> CascadeGrid:
        """The cascades with ``resolution`` cells per edge from packed bits ``data`` (uint8). Raises ``ValueError`` if
        they are too few."""
        count = count_cascade_levels(bound) * resolution**3
        if data.size * 8 < count:
            raise ValueError(
                f"cascades of resolution {resolution} to a bound of {bound} need {count // 8} bytes, got {data.size}"
            )
        bits = np.unpackbits(data, bitorder="little")[:count].reshape(-1, *(resolution,) * 3)
        return CascadeGrid(bits.astype(bool), bound, ns, threshold)


def count_cascade_levels(bound: float) -> int:
    """Number of cubes that torch-ngp uses for a scene of [-bound, bound]³. Raises ``ValueError`` for a bound below
    1."""
    if not (np.isfinite(bound) and bound >= 1):
        raise ValueError(f"the bound of cascades must be at least 1, got {bound}")
    return 1 + int(np.ceil(np.log2(bound)))


def cascades_from_contracted(
    bits: np.ndarray, outer_scale: float, ns: ModuleType, threshold: float, resolution: int | None = None
) -> CascadeGrid:
    """Cascades that cover the occupied cells ``bits`` of a contracted box's unit cube.

    ``bits``: bool array (R, R, R), indexed [z, y, x], in the coordinates that `maths.geometry.ContractedBox` encodes, R
    even; ``outer_scale``: of the box; ``resolution``: cells along each edge of the cascades, even. By default they have
    R, so that R / 2 cells of the inner cube become R. A cell is occupied if it overlaps one of ``bits``.
    """
    r, levels = resolution or len(bits), count_cascade_levels(outer_scale)
    out = np.zeros((levels, r, r, r), bool)
    if bits.any():
        lower, upper = _expand_cells(bits, outer_scale)
        for level in range(levels):
            # In cells of this level; touching is not overlapping.
            scale, shift = r / 2.0 ** (level + 1), r / 2
            first = np.floor(lower * scale + shift + 1e-4).astype(int)
            last = np.ceil(upper * scale + shift - 1e-4).astype(int) - 1
            meets = np.all((last >= 0) & (first < r), axis=1)
            _mark_boxes(out[level], np.clip(first[meets], 0, r - 1), np.clip(last[meets], 0, r - 1))
    return CascadeGrid(out, outer_scale, ns, threshold)


def _expand_cells(bits: np.ndarray, outer_scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Bounding boxes (N, 3), lower and upper corners in half edges of the inner cube, of the contracted cells
    ``bits``."""
    r = len(bits)
    index = np.argwhere(bits)[:, ::-1]
    low, high = 4 * index / r - 2, 4 * (index + 1) / r - 2
    # Within a cell x = y g(n) for contracted y, n = max |y|, with increasing g: its extremes bound each coordinate.
    nearest = np.where((low < 0) & (high > 0), 0, np.minimum(np.abs(low), np.abs(high)))
    farthest = np.maximum(np.abs(low), np.abs(high))

    def growth(n: np.ndarray) -> np.ndarray:
        n = np.clip(n, 1, 2 - 1 / outer_scale)
        return (1 / (n * (2 - n)))[:, None]

    min_growth, max_growth = growth(nearest.max(axis=1)), growth(farthest.max(axis=1))
    lower, upper = low * np.where(low < 0, max_growth, min_growth), high * np.where(high < 0, min_growth, max_growth)
    return np.clip(lower, -outer_scale, outer_scale), np.clip(upper, -outer_scale, outer_scale)


def _mark_boxes(cells: np.ndarray, first: np.ndarray, last: np.ndarray) -> None:
    """Set the ``cells`` [z, y, x] of boxes of cells, from ``first`` (N, 3; x, y, z) to ``last``, inclusive."""
    # Signs at the eight corners of each box, summed along the axes: the work does not depend on the size of the boxes.
    count = np.zeros(np.add(cells.shape, 1), np.int32)
    ends = (first, last + 1)
    for corner in np.ndindex(2, 2, 2):
        x, y, z = (ends[c][:, axis] for axis, c in enumerate(corner))
        np.add.at(count, (z, y, x), 1 - 2 * (sum(corner) % 2))
    for axis in range(3):
        np.cumsum(count, axis=axis, out=count)
    cells |= count[:-1, :-1, :-1] > 0


# ---- Refined occupancy ----
#
# Occupancy at half the cell size: one byte for the eight parts of each occupied cell.
#
# The cells that training leaves occupied contain a wall and air on both sides, and a ray pays for each step in them. A
# refined grid keeps only the parts in which density was found (`refine_occupancy`). Distances are stored per cell, and
# parts are looked up in occupied cells only: two tables of one byte per cell, where a grid of parts would need eight.

PARTS_PER_AXIS = 2  # Parts of a cell along each axis


class RefinedGrid:
    """An occupancy grid with refined cells. Raises ``ValueError`` for inconsistent arguments.

    Parameters
    ----------
    coarse_bits : array
        Bool array (R, R, R), indexed [z, y, x], of a cubic `OccupancyGrid`.
    masks : array
        For each of its occupied cells, in that order, the bits of its parts (uint8, (N,)), x fastest, lowest bit first.
    threshold, coarse_threshold : float
        Density (1/unit) below which a part, or a cell, counts as empty.
    missed_optical_depth : float
        Mean optical depth, along random lines through the field's box, of the density in cells that is not in their
        parts.
    """

    DRJIT_STRUCT: ClassVar[dict[str, Any]] = {"distance": None, "parts": None}

    def __init__(
        self,
        coarse_bits: np.ndarray,
        masks: np.ndarray,
        ns: ModuleType,
        threshold: float,
        coarse_threshold: float,
        missed_optical_depth: float,
    ):
        bits, masks = np.asarray(coarse_bits, bool), np.asarray(masks, np.uint8)
        if bits.ndim != 3 or len(set(bits.shape)) != 1 or masks.shape != (bits.sum(),):
            raise ValueError(
                f"a refined grid needs a byte for each occupied cell of a cube, got {masks.shape} for "
                f"{int(bits.sum())} of {bits.shape}"
            )
        self._ns, self.coarse_bits, self.masks = ns, bits, masks
        self._coarse: OccupancyGrid | None = None
        self.threshold, self.coarse_threshold, self.missed_optical_depth = (
            float(threshold),
            float(coarse_threshold),
            float(missed_optical_depth),
        )
        self.cells = tuple(PARTS_PER_AXIS * n for n in bits.shape[::-1])
        all_masks = np.zeros(bits.shape, np.uint8)
        all_masks[bits] = masks
        # Cells without occupied parts are empty like all others.
        self.distance, self.parts = ns.UInt8(chessboard_distance(all_masks > 0).ravel()), ns.UInt8(all_masks.ravel())

    @property
    def coarse(self) -> OccupancyGrid:
        """The grid that was refined, whose cells cover the parts of this one: for weights that have changed since, and
        for formats without parts."""
        if self._coarse is None:
            self._coarse = OccupancyGrid(self.coarse_bits, self._ns, self.coarse_threshold)
        return self._coarse

    @property
    def bits(self) -> np.ndarray:
        """One bit per part: bool array, indexed [z, y, x]."""
        out = np.zeros(self.cells[::-1], bool)
        z, y, x = np.nonzero(self.coarse_bits)
        for part, (k, j, i) in enumerate(np.ndindex(PARTS_PER_AXIS, PARTS_PER_AXIS, PARTS_PER_AXIS)):
            out[PARTS_PER_AXIS * z + k, PARTS_PER_AXIS * y + j, PARTS_PER_AXIS * x + i] = self.masks >> part & 1
        return out

    @property
    def resolution(self) -> int:
        """Parts along an edge."""
        return self.cells[0]

    @property
    def occupied_fraction(self) -> float:
        """Fraction of the parts that are occupied."""
        return float(np.unpackbits(self.masks).sum() / np.prod(self.cells))

    def distance_to_occupied(self, u: Array3f, active: Bool | bool = True) -> UInt32:
        """Lower bound of the distance in parts (UInt32) from that of ``u`` (unit cube) to an occupied one; 0: occupied.

        Points outside the cube are clamped to its nearest part.
        """
        uint, n = dr.uint32_array_t(type(u.x)), self.cells[0]
        p = [uint(dr.clip(x * n, 0, n - 1)) for x in (u.x, u.y, u.z)]
        x, y, z = (c >> 1 for c in p)
        cell = x + (n // PARTS_PER_AXIS) * (y + (n // PARTS_PER_AXIS) * z)
        cell_distance = uint(dr.gather(type(self.distance), self.distance, cell, active))
        parts = uint(dr.gather(type(self.parts), self.parts, cell, active & (cell_distance == 0)))
        part = (p[0] & 1) | ((p[1] & 1) << 1) | ((p[2] & 1) << 2)
        # An occupied cell at the distance k is at least 2 k - 1 parts away.
        return dr.select(cell_distance > 0, PARTS_PER_AXIS * cell_distance - 1, 1 - ((parts >> part) & 1))


# ---- Refinement of the occupancy of a trained field, and the density that it misses ----
#
# All parts are sampled at the same points of an additive recurrence (Roberts 2018, "The unreasonable effectiveness of
# quasirandom sequences", in three dimensions), so that a field always gets the same grid. Trained densities are almost
# all far above or far below the threshold: after a few points, sampling continues only in parts with a density near the
# threshold, or next to an occupied part.

POINTS_PER_PART = 64  # Maximum number of sample points per part
_FIRST = 8
_EMPTY_FRACTION = (
    1e-4  # Parts whose densities at the first points are all below this fraction of the threshold are empty
)
MIN_STEP_OPTICAL_DEPTH = 1e-3  # Optical depth per step above which a density counts
_GROWTH = 1.2207440846057596  # The root of x⁴ = x + 1, whose powers are the steps of the recurrence
_SAMPLES = 1 << 17


def refine_occupancy(field: RadianceNetwork, points: int = POINTS_PER_PART) -> RefinedGrid | None:
    """The refined occupancy of ``field`` for its current weights; None if its occupancy is not a plain grid.

    A density counts if its optical depth per step exceeds ``MIN_STEP_OPTICAL_DEPTH``; the step is the field's own, or
    1/1024 of its box's diagonal.
    """
    grid = field.occupancy
    if isinstance(grid, RefinedGrid):
        grid = grid.coarse
    if not isinstance(grid, OccupancyGrid) or field.box.is_contracted:
        return None
    step = field.march_step or field.box.diagonal / 1024
    threshold = min(MIN_STEP_OPTICAL_DEPTH / step, grid.threshold or np.inf)
    ns = field.ns
    with dr.suspend_grad():
        cells = ns.UInt32(copy_aligned(np.flatnonzero(grid.bits), np.uint32))
        masks = _find_masks(field, grid.bits, cells, threshold, points)
        missed = _estimate_missed_depth(field, cells, ns.UInt32(copy_aligned(masks, np.uint32)), grid.resolution, step)
    return RefinedGrid(grid.bits, masks, ns, threshold, grid.threshold, missed)


def _find_masks(field: RadianceNetwork, bits: np.ndarray, cells: UInt32, threshold: float, points: int) -> np.ndarray:
    """Masks (uint8, (N,)) of the parts of ``bits`` (R, R, R), with the N occupied ``cells``, whose density exceeds
    ``threshold`` at one of the ``points``."""
    ns, count, resolution = field.ns, PARTS_PER_AXIS**3, len(bits)
    if dr.width(cells) == 0:
        return np.zeros(0, np.uint8)
    occupied, near = (dr.zeros(ns.UInt8, count * dr.width(cells)) for _ in range(2))
    for k in range(points):
        if k == _FIRST:
            near |= ns.UInt8(_find_touching_parts(bits, _pack_masks(occupied)))
        remaining = cast("UInt32", dr.compress((occupied == 0) & (near > 0) if k >= _FIRST else occupied == 0))
        if dr.width(remaining) == 0:
            break
        # Opaque: as literals each point would compile its own kernel.
        offset = ns.Array3f(*((0.5 + (k + 1) / _GROWTH ** (axis + 1)) % 1 for axis in range(3)))
        dr.make_opaque(offset)
        shift = ns.Array3f(remaining & 1, remaining >> 1 & 1, remaining >> 2 & 1)
        cell = cell_corner(dr.gather(ns.UInt32, cells, remaining // count), resolution, ns)
        sigma = field.density(field.box.from_unit((cell + (shift + offset) / PARTS_PER_AXIS) / resolution), True)
        dr.scatter(occupied, ns.UInt8(1), remaining, sigma > threshold)
        dr.scatter(near, ns.UInt8(1), remaining, sigma > _EMPTY_FRACTION * threshold)
        dr.eval(occupied, near)
    return _pack_masks(occupied)


def _pack_masks(occupied: Any) -> np.ndarray:
    """Masks of cells from one UInt8 per part, positive for ``occupied`` parts."""
    return np.packbits(occupied.numpy().reshape(-1, PARTS_PER_AXIS**3) > 0, axis=1, bitorder="little").ravel()


def _find_touching_parts(bits: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """Whether each part of the occupied cells of ``bits`` is one of ``masks`` or touches one: uint8, flattened. A
    surface through one part can cut a corner of the next."""
    part_indices = np.argwhere(bits)[:, None] * PARTS_PER_AXIS + np.array(
        list(np.ndindex(PARTS_PER_AXIS, PARTS_PER_AXIS, PARTS_PER_AXIS))
    )
    z, y, x = part_indices.reshape(-1, 3).T
    occupied = np.zeros([PARTS_PER_AXIS * n for n in bits.shape], bool)
    occupied[z, y, x] = np.unpackbits(masks, bitorder="little")
    return dilate(occupied)[z, y, x].astype(np.uint8)


def _estimate_missed_depth(field: RadianceNetwork, cells: UInt32, masks: UInt32, resolution: int, step: float) -> float:
    """Mean optical depth along random lines through the box of the density in ``cells`` outside the parts of ``masks``.

    By Cauchy's formula (Santaló 1976) it is 4 / S times the integral of the density, with the surface area S of the
    box. Densities are limited to what one step absorbs, so that a spike weighs no more than the light that it absorbs.
    """
    if dr.width(cells) == 0:
        return 0.0
    ns, rng = field.ns, np.random.default_rng(0)
    index = ns.UInt32(copy_aligned(rng.integers(0, dr.width(cells), _SAMPLES, np.uint32), np.uint32))
    inside = ns.Array3f(*(ns.Float(copy_aligned(rng.random(_SAMPLES, np.float32))) for _ in range(3)))
    part = [ns.UInt32(c >= 0.5) for c in (inside.x, inside.y, inside.z)]
    bit = (dr.gather(ns.UInt32, masks, index) >> (part[0] | part[1] << 1 | part[2] << 2)) & 1
    u = (cell_corner(dr.gather(ns.UInt32, cells, index), resolution, ns) + inside) / resolution
    sigma = field.density(field.box.from_unit(u), bit == 0)
    missed: Float = dr.select(bit == 0, (1 - dr.exp(-sigma * step)) / step, 0)
    volume = dr.width(cells) * (field.box.cube_side / resolution) ** 3
    a, b, c = np.subtract(field.box.upper, field.box.lower)
    return float(dr.mean(missed)[0]) * volume * 4 / (2 * (a * b + b * c + c * a))
