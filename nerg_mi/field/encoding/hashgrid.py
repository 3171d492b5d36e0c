"""Multiresolution hash grid (Müller et al. 2022, "Instant Neural Graphics Primitives").

The memory layout is torch-ngp's, so that its checkpoints load without loss: a
vertex stride of resolution + 1 on dense levels (no aliasing at the far faces),
rows rounded up to a multiple of 8, scales in float32, and zero outside of the
unit cube. A level whose (resolution + 1)^3 vertices do not fit in the table is
hashed with the primes of the paper.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from nerg_mi.field.backend import namespace
from nerg_mi.maths.types import Array3f, Bool, Float

from .protocol import Encoding, EncodingConfig
from .registry import DEFAULT_KIND, register

_PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True)
class HashGridConfig(EncodingConfig):
    """Sizes of a hash grid. Resolutions grow geometrically from the coarsest level to the finest."""

    kind: ClassVar[str] = DEFAULT_KIND
    limits: ClassVar[Mapping[str, int]] = {
        "levels": 64,
        "features": 4,
        "log2_rows": 26,
        "base": 1 << 20,
        "dimensions": 3,
    }

    # Grids of different resolution, whose features are concatenated.
    levels: int = 16
    # Numbers at a vertex of a level: 2 or 4.
    features: int = 2
    # Base 2 logarithm of the rows that a level has at most.
    log2_rows: int = 19
    # Cells along an edge of the coarsest level.
    base: int = 16
    # Cells along an edge of the finest level.
    finest: int | float = 2048
    # 3 for a grid over the unit cube, 2 for one over the unit square.
    dimensions: int = 3

    def __post_init__(self):
        if self.levels < 1 or self.base < 1 or self.finest < self.base:
            raise ValueError(
                f"a hash grid needs levels >= 1 and finest >= base >= 1, got levels={self.levels}, "
                f"base={self.base}, finest={self.finest}"
            )
        if self.dimensions not in (2, 3):
            raise ValueError(f"a hash grid has 2 or 3 dimensions, got {self.dimensions}")
        if self.features not in (2, 4):
            raise ValueError(f"features must be 2 or 4 (one packet load a vertex), got {self.features}")
        if not 3 <= self.log2_rows <= 26:
            raise ValueError(f"log2_rows must lie in 3..26, got {self.log2_rows}")

    @property
    def size(self) -> int:
        """Number of features that the grid returns a point."""
        return self.levels * self.features

    def shapes(self) -> dict[str, tuple[int, ...]]:
        return {"table": (self.offsets()[-1] * self.features,)}

    def describe(self) -> str:
        return f"{self.levels} x {self.features}, 2^{self.log2_rows} rows, {self.base} to {self.finest}"

    def to_dict(self) -> dict[str, Any]:
        # Without a kind: so this version's files of hash grids can be read by all earlier ones.
        return asdict(self)

    def level_scales(self) -> np.ndarray:
        """Scale of each level as float32, (levels,): ``exp2(l log2 s) base - 1``."""
        growth = np.log2(self.finest / self.base) / max(self.levels - 1, 1)
        level = np.arange(self.levels, dtype=np.float32)
        return (np.exp2(level * np.float32(growth)) * np.float32(self.base) - np.float32(1)).astype(np.float32)

    def level_rows(self) -> list[int]:
        """Rows of each level; the allocation uses the float64 resolution, as torch-ngp does."""
        growth = np.exp2(np.log2(self.finest / self.base) / max(self.levels - 1, 1))
        rows = []
        for level in range(self.levels):
            resolution = int(np.ceil(self.base * growth**level))
            vertices = min(2**self.log2_rows, (resolution + 1) ** self.dimensions)
            rows.append(int(np.ceil(vertices / 8) * 8))
        return rows

    def offsets(self) -> list[int]:
        """First row of each level, and the total at the end, (levels + 1,)."""
        return [0, *np.cumsum(self.level_rows()).tolist()]


class HashGrid(Encoding):
    """Trainable features at points of the unit cube.

    ``table`` is the flat parameter array (Float), (rows * features,), the features of one row adjacent and the levels
    one after another; ``mode`` as for `Encoding`.
    """

    DRJIT_STRUCT: ClassVar[dict[str, Any]] = {"table": None}

    def __init__(self, config: HashGridConfig, table: Any, mode: dr.ReduceMode = dr.ReduceMode.Auto):
        self.config, self.table, self.mode = config, table, mode
        (expected,) = config.shapes()["table"]
        if len(table) != expected:
            raise ValueError(f'"grid.table" has {len(table)} entries where its configuration {config} needs {expected}')
        self._scales = config.level_scales()
        self._rows = config.level_rows()
        self._offsets = config.offsets()

    @classmethod
    def random(cls, config: HashGridConfig, ns: ModuleType, rng: np.random.Generator, scale: float = 1e-4) -> HashGrid:
        """A grid with entries uniform in ``[-scale, scale]``."""
        (size,) = config.shapes()["table"]
        return cls(config, ns.Float(rng.uniform(-scale, scale, size).astype(np.float32)))

    def is_hashed(self, level: int) -> bool:
        """Whether the vertices of ``level`` do not fit in its rows."""
        stride = int(np.ceil(self._scales[level])) + 2
        return stride**self.config.dimensions > self._rows[level]

    def __call__(self, p: Array3f, active: Bool = True) -> list[Float]:
        """Features at ``p`` (Array3f in the unit cube, or Array2f): ``levels * features`` Floats, zero outside."""
        p, inside = self._clamped(p, active)
        out = []
        for level in range(self.config.levels):
            out += self._level(level, p, inside)
        return out

    def evaluated(self, p: Array3f, active: Bool = True) -> list[Float]:
        """The same features, evaluated one level after another: the rows of one level stay in the caches.

        Worth it for many scattered points whose features are to be kept in memory anyhow.
        """
        p, inside = self._clamped(p, active)
        dr.eval(p, inside)
        out = []
        for level in range(self.config.levels):
            out += self._level(level, p, inside)
            dr.eval(out)
        return out

    @staticmethod
    def _clamped(p, active):
        """``p`` with 0 for what lies outside of the cube, and the mask of what lies inside."""
        inside = active & dr.all((p >= 0) & (p <= 1))
        # A negative coordinate cast to an unsigned cell would extrapolate by 4e9.
        return dr.select(inside, p, 0), inside

    def _level(self, level: int, p, active) -> list:
        ns = namespace(p)
        packet = {2: ns.Array2f, 4: ns.Array4f}[self.config.features]
        scale = float(self._scales[level])
        pos = [dr.fma(c, scale, 0.5) for c in p]
        cell = [ns.UInt32(c) for c in pos]
        w = [c - ns.Float(i) for c, i in zip(pos, cell)]
        lo, hi = self._corner_indices(level, cell)
        read = lambda index: dr.gather(
            packet, self.table, self._combine(level, index) + self._offsets[level], active, mode=self.mode
        )
        return list(dr.select(active, _blend(read, lo, hi, w, self.config.dimensions - 1, ()), 0))

    def _corner_indices(self, level: int, cell):
        """Per-axis parts of the vertex index, for the lower and the upper corner."""
        if self.is_hashed(level):
            steps = _PRIMES
        else:
            stride = int(np.ceil(self._scales[level])) + 2
            steps = (1, stride, stride * stride)  # as far as there are axes
        lo = [c * s for c, s in zip(cell, steps)]
        return lo, [a + s for a, s in zip(lo, steps)]

    def _combine(self, level: int, index: tuple):
        if not self.is_hashed(level):
            return sum(index[1:], index[0])
        h = index[0]
        for i in index[1:]:
            h = h ^ i
        rows = self._rows[level]
        return h & (rows - 1) if rows & (rows - 1) == 0 else h % rows


def _blend(read, lo: list, hi: list, w: list, axis: int, index: tuple):
    """Lerps from the last axis inwards: seven a feature instead of eight weights and eight products.

    Not a closure: one that calls itself is a cycle, and keeps its arrays until Python looks for those.
    """
    if axis < 0:
        return read(index)
    low, high = (_blend(read, lo, hi, w, axis - 1, (i[axis], *index)) for i in (lo, hi))
    return dr.lerp(low, high, w[axis])


register(HashGridConfig, HashGrid)
