"""From some point of a training on, every cell that rendering will visit is sampled; found a piece a step.

Cells that were left out stopped learning, and what hashing made of them shows once a picture is rendered under the
bound of what the field has become (`DensityGrid.bound`): the last part of a run must clear it. Finding them at once
would take as long as hundreds of steps.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from nerg_mi.maths.types import UInt32

from .density_grid import DensityGrid

# Every cell is looked at in alternate corners of its 2 x 2 x 2 parts: each half along each axis has two of them.
_STRATA = ((0, 0, 0), (1, 1, 0), (1, 0, 1), (0, 1, 1))
_PARTS = 8
# Groups of training rays that decide which cells matter.
_LOOKS = 32


class Settling:
    """Which cells the `DensityGrid.bound` of this moment would hold, nearly: by fewer points a cell and fewer rays.

    ``at``: pieces done; ``found``: cells (UInt8 each) with density; ``shown``: cells that absorb some of a training
    ray's light.
    """

    PROBES = len(_STRATA) * _PARTS
    PIECES = PROBES + _LOOKS

    def __init__(self, grid: DensityGrid):
        self.grid, self.at = grid, 0
        self.found, self.shown = (dr.zeros(grid.ns.UInt8, grid.resolution**3) for _ in range(2))
        self.dense = None
        dr.eval(self.found, self.shown)

    @property
    def done(self) -> bool:
        return self.at >= self.PIECES

    def restore(self, at: int, found: np.ndarray, shown: np.ndarray) -> None:
        """Go on from a stored state."""
        UInt8 = self.grid.ns.UInt8
        self.at, self.found, self.shown, self.dense = at, UInt8(found), UInt8(shown), None

    def advance(self, density, lit, seed: int) -> None:
        """The next piece; with the last one the grid is told.

        ``density``: of the field, as `DensityGrid.bound` has it; ``lit(density, occupied, rng)``: points (Array3f,
        world) of samples that some training rays see, or None; ``seed``: of the points and rays.
        """
        if self.done:
            return
        grid, rng = self.grid, np.random.default_rng((seed, self.at))
        if self.at < self.PROBES:
            part = grid.part(self.at)
            open_: UInt32 = dr.compress(dr.gather(grid.ns.UInt8, self.found, part) == 0)
            if dr.width(open_) > 0:
                index = dr.gather(grid.ns.UInt32, part, open_)
                grid.probe(self.found, index, density, rng, _STRATA[self.at // _PARTS], 2)
        else:
            if self.dense is None:
                self.dense = grid.ns.UInt8(grid.grown(self.found).ravel())
            p = lit(density, lambda p, active: grid.within(self.dense, p, active), rng)
            if p is not None:
                grid.mark(self.shown, p)
        self.at += 1
        if self.done:
            grid.keep(grid.grown(self.shown) & grid.grown(self.found))
