"""Where a field may hold density, in cells half as large: a byte for the eight parts of each occupied cell.

The cells that training leaves on hold a wall and the air on both sides of it, and a ray pays for each step in them. Of
their parts those stay that were found to hold something (``refinement``). Distances are kept a cell, parts are looked
up in occupied cells only: two tables of a byte a cell, where a grid of parts would take eight.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from .occupancy import OccupancyGrid, chessboard

PARTS = 2
"""Parts of a cell along each axis."""


class RefinedGrid:
    """``coarse_bits``: bool array (R, R, R), indexed [z, y, x], of a cubic ``OccupancyGrid`` of ``coarse_threshold``;
    ``masks``: for each of its occupied cells, in that order, the bits of its parts (uint8, N), x fastest, lowest bit
    first. ``threshold``: the density (1/unit) below which a part counts as empty, wherever it was looked at;
    ``missed``: mean optical depth, along random lines through the field's box, of all that the cells hold and the parts
    do not. Raises ``ValueError`` for what does not fit together.
    """

    DRJIT_STRUCT: ClassVar[dict[str, Any]] = {"distance": None, "parts": None}

    def __init__(
        self,
        coarse_bits: np.ndarray,
        masks: np.ndarray,
        ns: ModuleType,
        threshold: float,
        coarse_threshold: float,
        missed: float,
    ):
        bits, masks = np.asarray(coarse_bits, bool), np.asarray(masks, np.uint8)
        if bits.ndim != 3 or len(set(bits.shape)) != 1 or masks.shape != (bits.sum(),):
            raise ValueError(
                f"a refined grid needs a byte for each occupied cell of a cube, got {masks.shape} for "
                f"{int(bits.sum())} of {bits.shape}"
            )
        self._ns, self.coarse_bits, self.masks = ns, bits, masks
        self._coarse: OccupancyGrid | None = None
        self.threshold, self.coarse_threshold, self.missed = float(threshold), float(coarse_threshold), float(missed)
        self.cells = tuple(PARTS * n for n in bits.shape[::-1])
        whole = np.zeros(bits.shape, np.uint8)
        whole[bits] = masks
        # Cells of which nothing is left are empty as any other.
        self.distance, self.parts = ns.UInt8(chessboard(whole > 0).ravel()), ns.UInt8(whole.ravel())

    @property
    def coarse(self) -> OccupancyGrid:
        """The grid that was refined, which holds all that this one holds: for weights that are no longer those that
        were looked at, and for formats that know no parts."""
        if self._coarse is None:
            self._coarse = OccupancyGrid(self.coarse_bits, self._ns, self.coarse_threshold)
        return self._coarse

    @property
    def bits(self) -> np.ndarray:
        """A bit a part: bool array, indexed [z, y, x]."""
        out = np.zeros(self.cells[::-1], bool)
        z, y, x = np.nonzero(self.coarse_bits)
        for part, (k, j, i) in enumerate(np.ndindex(PARTS, PARTS, PARTS)):
            out[PARTS * z + k, PARTS * y + j, PARTS * x + i] = self.masks >> part & 1
        return out

    @property
    def resolution(self) -> int:
        """Parts along an edge."""
        return self.cells[0]

    @property
    def fraction(self) -> float:
        """Share of the parts that are occupied."""
        return float(np.unpackbits(self.masks).sum() / np.prod(self.cells))

    def empty_cells(self, u, active=True):
        """Distance in parts (UInt32) from that of ``u`` (unit cube) to an occupied one, or less; 0: occupied.

        Points outside of the cube are clamped to its nearest part.
        """
        uint, n = dr.uint32_array_t(type(u.x)), self.cells[0]
        p = [uint(dr.clip(x * n, 0, n - 1)) for x in (u.x, u.y, u.z)]
        x, y, z = (c >> 1 for c in p)
        cell = x + (n // PARTS) * (y + (n // PARTS) * z)
        away = uint(dr.gather(type(self.distance), self.distance, cell, active))
        parts = uint(dr.gather(type(self.parts), self.parts, cell, active & (away == 0)))
        part = (p[0] & 1) | ((p[1] & 1) << 1) | ((p[2] & 1) << 2)
        # An occupied cell that is k away is at least 2 k - 1 parts away.
        return dr.select(away > 0, PARTS * away - 1, 1 - ((parts >> part) & 1))
