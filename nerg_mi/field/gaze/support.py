"""How much data a gaze field rests on around a position: where the rays that it learnt from started, in a few
kilobytes.

Support at p is the sum over rays of Epanechnikov's kernel, Σ_i max(0, 1 - |o_i - p|² / (5R)²), R the radius of a probe:
a ray that started at p counts as one, a ray 5R away not at all. A field knows more than its probes: kernels of R are
zero wherever a field is asked for what it was not shown, where its error grows with the distance still. How well
those of 5 R rank the errors: docs/gaze-evaluation.md.

Rays are kept as cells of R/2 with their number, mean origin and variance. The sum over a cell within reach follows
from these exactly. In one that the reach cuts, the squared distances are taken to be spread uniformly.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.ranges import FARTHEST

CELLS = 2
"""Cells along R."""
REACH = 5.0
"""Radii R from which a ray still counts."""

# Cells that are looked at for the one with the greatest support.
_DENSE = 64


class RaySupport:
    """``cells`` (n, 5): mean origin (3), number of rays, and their mean squared distance from that; ``radius``: R. Both
    in one frame. ``reach``: how far away a ray still counts."""

    def __init__(self, cells: np.ndarray, radius: float):
        self.cells, self.radius = np.ascontiguousarray(cells, np.float32).reshape(-1, 5), float(radius)
        self.reach = REACH * self.radius
        if not np.all(np.isfinite(self.cells)) or not 0 < self.radius <= FARTHEST:
            raise ValueError(f"the support of a gaze field needs finite cells and a positive radius, got {self.radius}")

    @staticmethod
    def of(origins: np.ndarray, radius: float) -> RaySupport:
        """That of rays from ``origins`` (N, 3), for probes of ``radius``."""
        origins = np.asarray(origins, np.float64).reshape(-1, 3)
        lower = origins.min(axis=0)
        index = np.floor((origins - lower) * (CELLS / radius)).astype(np.int64)
        _, cell, count = np.unique(
            np.ravel_multi_index(index.T, index.max(axis=0) + 1), return_inverse=True, return_counts=True
        )
        mean = np.stack([np.bincount(cell, weights=x) for x in origins.T], axis=1) / count[:, None]
        apart = np.bincount(cell, weights=((origins - mean[cell]) ** 2).sum(axis=1)) / count
        return RaySupport(np.concatenate([mean, count[:, None], apart[:, None]], axis=1), radius)

    def at(self, p):
        """Support at ``p`` (Array3f or Point3f of one lane), a Float of one lane: rays that count, without
        derivatives."""
        Float: Any = dr.float32_array_t(type(p.x))
        p = dr.detach(p)
        x, y, z, count, apart = (Float(np.ascontiguousarray(column)) for column in self.cells.T)
        square = dr.square(x - p.x) + dr.square(y - p.y) + dr.square(z - p.z)
        scale = 1 / self.reach**2
        inside = 1 - (square + apart) * scale
        # Half the width of a uniform law with the variance of |o - p|² in a cell whose rays spread alike in all
        # directions.
        reach = dr.sqrt(4 * square * apart) * scale + 1e-9
        cut = dr.square(dr.maximum(inside + reach, 0)) / (4 * reach)
        return dr.sum(count * dr.select(inside > reach, inside, cut))

    def densest(self) -> np.ndarray:
        """Where most rays started (3,) float64, by kernels of R: of the mean origins of the cells with most rays; of
        equal ones the first."""
        cells = self.cells.astype(np.float64)
        best = cells[np.argsort(-cells[:, 3], kind="stable")[:_DENSE], :3]
        square = ((best[:, None] - cells[None, :, :3]) ** 2).sum(axis=-1) + cells[:, 4]
        return best[np.argmax((np.maximum(1 - square / self.radius**2, 0) * cells[:, 3]).sum(axis=1))]
