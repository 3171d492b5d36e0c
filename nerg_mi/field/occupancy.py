"""Where a field may hold density: a bit a cell, and how far away the next one is.

Marching skips a step only when its midpoint lies in an empty cell. The distance
to the nearest occupied cell (chessboard metric) lets a ray leap over many empty
cells with one look-up.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any, ClassVar

import drjit as dr
import numpy as np

_FAR = 255


class OccupancyGrid:
    """Grid over the unit cube, x varying fastest.

    ``bits``: bool array, indexed [z, y, x] (a field's has equal edges, R). ``threshold``: the density (1/unit) below
    which a cell counts as empty; it is the bound that skipping rests on and is recorded in checkpoints. Raises
    ``ValueError`` for bits without three axes.
    """

    DRJIT_STRUCT: ClassVar[dict[str, Any]] = {"distance": None}

    def __init__(self, bits: np.ndarray, ns: ModuleType, threshold: float):
        bits = np.asarray(bits, bool)
        if bits.ndim != 3 or 0 in bits.shape:
            raise ValueError(f"an occupancy grid has three axes of at least one cell, got shape {bits.shape}")
        self.bits, self.threshold = bits, float(threshold)
        self.cells = bits.shape[::-1]
        self.distance = ns.UInt8(chessboard(bits).ravel())

    @property
    def coarse(self) -> OccupancyGrid:
        """Itself: it refines no other grid (``refined.RefinedGrid.coarse``)."""
        return self

    @property
    def resolution(self) -> int:
        """Cells along an edge of a cubic grid."""
        if len(set(self.cells)) != 1:
            raise ValueError(f"a grid of {self.cells} cells has no single resolution; fields need a cubic one")
        return self.cells[0]

    @property
    def fraction(self) -> float:
        """Share of the cells that are occupied."""
        return float(self.bits.mean())

    def empty_cells(self, u, active=True):
        """Distance in cells (UInt32) from the cell of ``u`` (unit cube) to an occupied one; 0: occupied.

        Points outside of the cube are clamped to its nearest cell.
        """
        uint = dr.uint32_array_t(type(u.x))
        c = [uint(dr.clip(x * n, 0, n - 1)) for x, n in zip((u.x, u.y, u.z), self.cells)]
        index = c[0] + self.cells[0] * (c[1] + self.cells[1] * c[2])
        return uint(dr.gather(type(self.distance), self.distance, index, active))

    def packed(self) -> np.ndarray:
        """The bits as bytes, (R^3 / 8,), x fastest, lowest bit first."""
        return np.packbits(self.bits.ravel(), bitorder="little")

    @staticmethod
    def from_packed(data: np.ndarray, resolution: int, ns: ModuleType, threshold: float) -> OccupancyGrid:
        """The cubic grid of ``resolution`` cells an edge whose ``packed`` bits are ``data`` (uint8); ``ValueError`` if
        they are too few."""
        return OccupancyGrid(unpacked(data, resolution), ns, threshold)


def unpacked(data: np.ndarray, resolution: int) -> np.ndarray:
    """The bits (R, R, R) of a cubic grid of ``resolution`` R whose ``packed`` form is ``data`` (uint8); ``ValueError``
    if they are too few."""
    if data.size * 8 < resolution**3:
        raise ValueError(
            f"an occupancy grid of resolution {resolution} needs {resolution**3 // 8} bytes, got {data.size}"
        )
    return np.unpackbits(data, bitorder="little")[: resolution**3].reshape((resolution,) * 3).astype(bool)


def chessboard(bits: np.ndarray) -> np.ndarray:
    """Chessboard distance in cells to the nearest occupied one, 0..255 (uint8, 0: occupied), of a bool array.

    The occupied cells are grown by one layer at a time, 64 cells of a row in a word, and cells are counted for as long
    as they are not reached: the count is kept as the planes of its binary digits, of which a step changes two in the
    mean. Cells behind the end of a row are reached no sooner than through the row, and left out at last.
    """
    if not bits.any():
        return np.full(bits.shape, _FAR, np.uint8)
    *_, n = bits.shape
    wide = np.zeros((*bits.shape[:-1], -(-n // 64) * 64), bool)
    wide[..., :n] = True
    inside = _words(wide)
    wide[..., :n] = bits
    reached, planes = _words(wide), []
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
        reached = _grown_words(reached)
    distance = np.zeros(wide.shape, np.uint8)
    for k, plane in enumerate(planes):
        distance |= np.unpackbits(plane.view(np.uint8), axis=-1, bitorder="little") << np.uint8(k)
    return np.ascontiguousarray(distance[..., :n])


def _words(cells: np.ndarray) -> np.ndarray:
    """Rows of ``cells`` (bool, a multiple of 64 in the last axis) as words, the lowest bit first."""
    return np.packbits(cells, axis=-1, bitorder="little").view("<u8")


def _grown_words(words: np.ndarray) -> np.ndarray:
    """``grown`` of cells in words."""
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


def grown(cells: np.ndarray) -> np.ndarray:
    """``cells`` (bool, three axes) and all that touch one of them, by a face, an edge or a corner."""
    # An axis at a time: a tenth of the work of a dilation by the whole cube.
    for axis in range(3):
        before, grown = np.moveaxis(cells, axis, 0), cells.copy()
        moved = np.moveaxis(grown, axis, 0)
        moved[1:] |= before[:-1]
        moved[:-1] |= before[1:]
        cells = grown
    return cells
