"""Voxels of a compiled field: its log density on the vertices of blocks near surfaces, where these are, and their
colours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.types import Array3f, Bool, Float, UInt32

from .encoding import encode_direction
from .mlp import MLP
from .occupancy import chessboard_distance

# The unit cube has R³ cells, in blocks of 8³. A block with matter stores the log density on its 9³ vertices in half
# precision, and one bit per cell: cells without matter have density 0. Vertices on a face are stored in each block that
# it belongs to, so that the eight vertices of a cell are found from one number.
BLOCK_EDGE = 8  # Cells along an edge of a block
VERTICES = (BLOCK_EDGE + 1) ** 3  # Vertices of a block
CELLS = BLOCK_EDGE**3  # Cells of a block
_WORDS = CELLS // 32  # Words of a block's mask
_PART_EDGE = 4  # Cells along an edge of the parts between which distances are stored
_EMPTY = 0xFFFFFFFF
MAX_RESOLUTION = 2048
"""Maximum number of cells along an edge; tables of all blocks and parts then take 190 MB."""


# ---- Colours ----
#
# Colour is linear in a few numbers q of a point, with factors that depend on the direction d:
#
#     c(p, d) = B_K(d) + Σ_k q_k(p) B_k(d)
#
# B is a matrix times the spherical harmonics of d, one for all points; q are bytes, trilinear between the vertices of a
# lattice in each block. Sums along a ray are those of q, so B is evaluated once per ray.

COLOR_NUMBERS = 8  # Bytes of a vertex
LATTICE_EDGES = (8, 4, 2)
"""Cells of the lattice of colours along an edge of a block, from the finest."""


class VoxelColors:
    """Colours of the blocks of a `VoxelGrid`. Raises ``ValueError`` for arrays that do not belong together.

    Parameters
    ----------
    edge : int
        One of `LATTICE_EDGES`.
    numbers : array
        The bytes q (uint8, (N, (edge + 1)³, `COLOR_NUMBERS`)), x fastest.
    basis : array
        The matrix of B (float32, (3 K + 3, harmonics)): the rows of B_k follow each other, red, green, blue.
    """

    DRJIT_STRUCT: ClassVar[dict[str, Any]] = {"_words": None, "net": None}

    def __init__(self, edge: int, numbers: np.ndarray, basis: np.ndarray, ns: ModuleType):
        degree = math.isqrt(basis.shape[1]) if basis.ndim == 2 else 0
        vertices, outputs = (edge + 1) ** 3, 3 * COLOR_NUMBERS + 3
        if edge not in LATTICE_EDGES or numbers.shape[1:] != (vertices, COLOR_NUMBERS) or numbers.dtype != np.uint8:
            raise ValueError(f"colours of a lattice of {edge} have the shape {numbers.shape} and type {numbers.dtype}")
        if basis.shape != (outputs, degree**2) or not 1 <= degree <= 10 or not np.isfinite(basis).all():
            raise ValueError(f"the basis of colours must be {outputs} finite rows of harmonics, not {basis.shape}")
        self._ns, self.edge, self._degree = ns, edge, degree
        self._words = ns.Int32(copy_aligned(numbers.reshape(-1).view(np.int32), np.int32))
        self.net = MLP([ns.TensorXf(copy_aligned(basis))])
        self.net.pack()

    @property
    def numbers(self) -> np.ndarray:
        """The bytes q of all vertices; not a copy."""
        return self._words.numpy().view(np.uint8).reshape(-1, (self.edge + 1) ** 3, COLOR_NUMBERS)

    @property
    def size(self) -> int:
        """Bytes of the arrays in a file."""
        return 4 * len(self._words) + 4 * int(np.prod(self.net.weights[0].shape))

    def interpolate(self, block: UInt32, position: Array3f, active: Bool) -> list[Float]:
        """The numbers q at a ``position`` (0..1 along each axis) of a ``block``."""
        ns, edge = self._ns, self.edge + 1
        position = position * self.edge
        cell = [ns.UInt32(dr.clip(dr.detach(c), 0, self.edge - 1)) for c in position]
        x, y, z = ([1 - w, w] for w in (c - ns.Float(k) for c, k in zip(position, cell)))
        first = block * edge**3 + cell[0] + edge * (cell[1] + edge * cell[2])
        out = [ns.Float(0)] * COLOR_NUMBERS
        for k in range(8):
            i, j, l = k & 1, k >> 1 & 1, k >> 2
            words = dr.gather(ns.Array2i, self._words, first + (i + edge * (j + edge * l)), active)
            weight = x[i] * y[j] * z[l]
            out = [dr.fma(weight, ns.Float((words[n // 4] >> (8 * (n % 4))) & 255), q) for n, q in enumerate(out)]
        return out

    def decode(self, numbers: list[Float], opacity: Float, d: Array3f) -> list[Float]:
        """Colour times ``opacity`` along unit ``d``, of the sums Σ w q with the weights of ``opacity`` = Σ w."""
        b = self.net(encode_direction(d, self._degree))
        color: list[Any] = [
            b[-3 + c] * opacity + sum(q * b[3 * k + c] for k, q in enumerate(numbers)) for c in range(3)
        ]
        return [dr.clip(c, 0, opacity) for c in color]


# ---- Density ----


@dataclass(frozen=True)
class VoxelArrays:
    """What a file stores of N blocks. Raises ``ValueError`` for arrays that do not belong together."""

    # Cells along an edge of the unit cube, a multiple of 8.
    resolution: int
    # Flat indices (uint32, (N,)) of the stored blocks, x fastest, ascending.
    blocks: np.ndarray
    # One bit per cell (uint32, (N, 16)), x fastest, lowest bit first.
    masks: np.ndarray
    # Log density (float16, (N, 729)) on the vertices, x fastest: of the density in the field's encoded units.
    log_density: np.ndarray

    def __post_init__(self):
        r, n = self.resolution, len(self.blocks)
        if not (isinstance(r, int) and BLOCK_EDGE <= r <= MAX_RESOLUTION and r % BLOCK_EDGE == 0):
            raise ValueError(
                f"the resolution of voxels must be a multiple of {BLOCK_EDGE} up to {MAX_RESOLUTION}, not {r}"
            )
        if self.masks.shape != (n, _WORDS) or self.log_density.shape != (n, VERTICES):
            raise ValueError(
                f"{n} blocks of voxels need masks of {_WORDS} words and {VERTICES} densities each, not "
                f"{self.masks.shape} and {self.log_density.shape}"
            )
        ascend = np.all(np.diff(self.blocks.astype(np.int64)) > 0)
        if not ascend or self.blocks.max(initial=0) >= (r // BLOCK_EDGE) ** 3:
            raise ValueError("the indices of blocks of voxels must ascend and lie within the cube")
        # The bits of the exponent: np.isfinite takes a second for half precision.
        if ((self.log_density.view(np.uint16) & 0x7C00) == 0x7C00).any():
            raise ValueError("the log densities of voxels must be finite")

    @property
    def size(self) -> int:
        """Bytes of the arrays."""
        return sum(a.nbytes for a in (self.blocks, self.masks, self.log_density))


class VoxelGrid:
    """Densities and occupancy of a compiled field, in the unit cube of its positions. Also a `medium.Occupancy`.

    Parameters
    ----------
    arrays : VoxelArrays
        What the file stores.
    ns : module
        Array types of the backend; see `fields.mlp.namespace`.

    Attributes
    ----------
    resolution : int
        Cells along an edge of the unit cube.
    size : int
        Bytes of the arrays in a file.
    blocks : array
        Flat indices (uint32, (N,)) of the blocks.
    log_density : Float16
        The log densities of all blocks: a parameter that can carry gradients.
    colors : VoxelColors or None
        Colours, which replace those of the networks.
    """

    DRJIT_STRUCT: ClassVar[dict[str, Any]] = {
        **dict.fromkeys(("log_density", "_masks", "_index", "_distance")),
        "colors": None,
    }

    def __init__(self, arrays: VoxelArrays, ns: ModuleType, colors: VoxelColors | None = None):
        if colors is not None and len(colors.numbers) != len(arrays.blocks):
            raise ValueError(f"{len(arrays.blocks)} blocks of voxels have {len(colors.numbers)} blocks of colours")
        self.colors = colors
        n = arrays.resolution // BLOCK_EDGE
        self._ns, self.resolution, self.size, self._blocks_per_edge = ns, arrays.resolution, arrays.size, n
        self.cells, self.blocks, self._stored_masks = (arrays.resolution,) * 3, arrays.blocks, arrays.masks
        index = np.full(n**3, _EMPTY, np.uint32)
        index[arrays.blocks] = np.arange(len(arrays.blocks), dtype=np.uint32)
        self._index = ns.UInt32(index)
        self._masks = ns.UInt32(copy_aligned(arrays.masks.ravel(), np.uint32))
        self.log_density = ns.Float16(copy_aligned(arrays.log_density.ravel(), np.float16))
        self._single: tuple[int, Any] | None = None
        self._distance = ns.UInt8(chessboard_distance(self.occupied_parts).ravel())

    @property
    def occupied_parts(self) -> np.ndarray:
        """Whether each part of a block, of 4³ cells, has a cell with matter: bool array, indexed [z, y, x]."""
        n, k = self._blocks_per_edge, BLOCK_EDGE // _PART_EDGE
        # A word has the bits of four rows of a layer, and half of each row belongs to a part.
        words, half = self._stored_masks.reshape(-1, k, _PART_EDGE, k), np.uint32(0x0F0F0F0F)
        parts = np.stack([(words & half) > 0, (words & ~half) > 0], axis=-1).any(axis=2)
        out = np.zeros((n, k, n, k, n, k), bool)
        z, y, x = np.unravel_index(self.blocks, (n, n, n))
        out[z, :, y, :, x, :] = parts
        return out.reshape(n * k, n * k, n * k)

    def to_arrays(self) -> VoxelArrays:
        """What a file stores, with the current log densities."""
        log_density = self.log_density.numpy().reshape(-1, VERTICES)
        return VoxelArrays(self.resolution, self.blocks, self._stored_masks, log_density)

    @property
    def coarse(self) -> VoxelGrid:
        """The grid itself: it refines no other one."""
        return self

    @property
    def occupied_fraction(self) -> float:
        """Fraction of the cells that have matter."""
        count = sum(int(np.unpackbits(part.view(np.uint8)).sum()) for part in np.array_split(self._stored_masks, 64))
        return count / self.resolution**3

    def named(self) -> dict[str, Any]:
        """The parameters by name."""
        basis = {} if self.colors is None else {"color_basis": self.colors.net.weights[0]}
        return {"log_density": self.log_density, **basis}

    def replace(self, name: str, value: Any) -> None:
        """Replace the parameter ``name`` by ``value`` of the same shape."""
        if name == "color_basis" and self.colors is not None:
            self.colors.net.replace("0", value)
            self.colors.net.pack()
        else:
            setattr(self, name, value)

    def kernel_parameters(self) -> list[Any]:
        """The arrays that evaluations read. The first one is attached to ``log_density``: itself, or with derivatives a
        copy in single precision, which the sums of gradients need."""
        basis = [] if self.colors is None else [self.colors.net.buffer]
        if not dr.grad_enabled(self.log_density):
            return [self.log_density, *basis]
        # A loop that is recorded cannot convert an array, so the copy is made before it and kept.
        if self._single is None or self._single[0] != self.log_density.index_ad:
            self._single = self.log_density.index_ad, self._ns.Float(self.log_density)
        return [self._single[1], *basis]

    def _cell(self, u: Array3f) -> list[UInt32]:
        """The cell of points of the unit cube, along each axis; points outside belong to its nearest cell."""
        return [self._ns.UInt32(dr.clip(c * self.resolution, 0, self.resolution - 1)) for c in u]

    def _block(self, cell: list[UInt32], active: Bool | bool) -> UInt32:
        """Number of the block of a ``cell``, or `_EMPTY`."""
        b = [c // BLOCK_EDGE for c in cell]
        n = self._blocks_per_edge
        return dr.gather(self._ns.UInt32, self._index, b[0] + n * (b[1] + n * b[2]), active)

    def _bit(self, cell: list[UInt32], block: UInt32, active: Bool | bool) -> UInt32:
        """1 for cells of ``block`` with matter, else 0."""
        x, y, z = (c % BLOCK_EDGE for c in cell)
        c = x + BLOCK_EDGE * (y + BLOCK_EDGE * z)
        word = dr.gather(self._ns.UInt32, self._masks, block * _WORDS + (c >> 5), active)
        return (word >> (c & 31)) & 1

    def distance_to_occupied(self, u: Array3f, active: Bool | bool = True) -> UInt32:
        """A lower bound of the chessboard distance in cells (UInt32) from the cell of ``u`` to one with matter; 0 in
        such a cell. Points outside the cube belong to its nearest cell."""
        cell, n = self._cell(u), self.resolution // _PART_EDGE
        part = [c // _PART_EDGE for c in cell]
        far = self._ns.UInt32(
            dr.gather(type(self._distance), self._distance, part[0] + n * (part[1] + n * part[2]), active)
        )
        near = active & (far == 0)
        bit = self._bit(cell, self._block(cell, near), near)
        # Parts at the distance k are at least 4 (k - 1) + 1 cells away.
        return dr.select(far > 0, _PART_EDGE * far - (_PART_EDGE - 1), 1 - bit)

    def evaluate(self, u: Array3f, active: Bool | bool = True) -> tuple[Float, Bool]:
        """Log density at ``u`` (unit cube), trilinear in each cell, and whether the cell has matter; without it the log
        density is arbitrary. Differentiable in ``u`` and ``log_density``."""
        ns, edge = self._ns, BLOCK_EDGE + 1
        cell = self._cell(dr.detach(u))
        block = self._block(cell, active)
        active = active & (block != _EMPTY)
        active &= self._bit(cell, block, active) > 0
        x, y, z = (c % BLOCK_EDGE for c in cell)
        first = block * VERTICES + x + edge * (y + edge * z)
        source = self.kernel_parameters()[0]
        steps = [(k & 1) + edge * (k >> 1 & 1) + edge * edge * (k >> 2) for k in range(8)]
        corners = [ns.Float(dr.gather(type(source), source, first + step, active)) for step in steps]
        for coordinate, c in zip(u, cell):
            weight = dr.fma(coordinate, self.resolution, -ns.Float(c))
            corners = [dr.lerp(low, high, weight) for low, high in zip(corners[::2], corners[1::2])]
        return corners[0], active

    def color_numbers(self, u: Array3f, active: Bool | bool = True) -> list[Float]:
        """The numbers of `colors` at ``u`` (unit cube); 0 in blocks without matter."""
        ns, colors = self._ns, self.colors
        assert colors is not None
        cell = self._cell(dr.detach(u))
        block = self._block(cell, active)
        corner = ns.Array3f(*(c // BLOCK_EDGE for c in cell))
        return colors.interpolate(block, u * self._blocks_per_edge - corner, active & (block != _EMPTY))
