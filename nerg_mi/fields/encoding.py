"""Encodings of directions (spherical harmonics) and positions (hash grid) for networks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from nerg_mi.maths.types import Array3f, Bool, Float

from .mlp import namespace

# ---- Real spherical harmonics as an encoding of directions ----
#
# Order and signs are those of instant-ngp and torch-ngp (Condon-Shortley phase, l = 0..3, m = -l..l), like Dr.Jit's
# ``sh_eval``.


def encode_direction(d, degree: int = 4) -> list:
    """The ``degree**2`` harmonics (list of Floats) of a unit direction ``d`` (Array3f)."""
    if not 1 <= degree <= 10:
        raise ValueError(f"the degree of the direction encoding must lie in 1..10, got {degree}")
    return list(dr.sh_eval(d, degree - 1))


# ---- Multiresolution hash grid (Müller et al. 2022, "Instant Neural Graphics Primitives") ----
#
# The memory layout is torch-ngp's, so that its checkpoints load without loss: a vertex stride of resolution + 1 on
# dense levels (no aliasing at the far faces), rows rounded up to a multiple of 8, scales in float32, and zero outside
# the unit cube. A level whose (resolution + 1)^3 vertices do not fit into the table is hashed with the primes of the
# paper.

_PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True)
class HashGridConfig:
    """Sizes of a hash grid. Resolutions grow geometrically from the coarsest level to the finest."""

    # Maximum values that are read from a file, by name.
    max_sizes: ClassVar[Mapping[str, int]] = {
        "levels": 64,
        "features": 4,
        "log2_rows": 26,
        "base": 1 << 20,
        "dimensions": 3,
    }

    levels: int = 16  # Grids of different resolution, whose features are concatenated
    features: int = 2  # Numbers per vertex of a level: 2 or 4
    log2_rows: int = 19  # Base 2 logarithm of the maximum number of rows per level
    base: int = 16  # Cells along an edge of the coarsest level
    finest: int | float = 2048  # Cells along an edge of the finest level
    dimensions: int = 3  # 3 for a grid over the unit cube, 2 for the unit square

    def __post_init__(self):
        if self.levels < 1 or self.base < 1 or self.finest < self.base:
            raise ValueError(
                f"a hash grid needs levels >= 1 and finest >= base >= 1, got levels={self.levels}, "
                f"base={self.base}, finest={self.finest}"
            )
        if self.dimensions not in (2, 3):
            raise ValueError(f"a hash grid has 2 or 3 dimensions, got {self.dimensions}")
        if self.features not in (2, 4):
            raise ValueError(f"features must be 2 or 4 (one packet load per vertex), got {self.features}")
        if not 3 <= self.log2_rows <= 26:
            raise ValueError(f"log2_rows must lie in 3..26, got {self.log2_rows}")

    @property
    def size(self) -> int:
        """Number of features per point."""
        return self.levels * self.features

    def parameter_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the parameters by name."""
        return {"table": (self.offsets()[-1] * self.features,)}

    def describe(self) -> str:
        """The sizes in a few words."""
        return f"{self.levels} x {self.features}, 2^{self.log2_rows} rows, {self.base} to {self.finest}"

    def to_dict(self) -> dict[str, Any]:
        """The JSON object for a checkpoint."""
        return asdict(self)

    @staticmethod
    def check_kind(data: Mapping[str, Any]) -> None:
        """Raise ``ValueError`` unless the JSON object ``data`` describes a hash grid."""
        if data.get("kind", "hashgrid") != "hashgrid":
            kind = str(data["kind"])[:40]
            raise ValueError(f"its positions are encoded by {kind!r}, which this version does not know")

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> HashGridConfig:
        """The inverse of `to_dict`. Raises ``ValueError`` or ``TypeError`` for invalid data."""
        cls.check_kind(data)
        return cls(**{k: v for k, v in data.items() if k != "kind"})

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
        """First row of each level, followed by the total, (levels + 1,)."""
        return [0, *np.cumsum(self.level_rows()).tolist()]


class HashGrid:
    """Trainable features at points of the unit cube.

    ``table`` is the flat parameter array (Float), (rows * features,), with adjacent features of a row and consecutive
    levels. ``mode`` states how gradients are accumulated into it: ``Expand``, a copy for each thread, costs a fraction
    of atomics for large batches.
    """

    DRJIT_STRUCT: ClassVar[dict[str, Any]] = {"table": None}

    def __init__(self, config: HashGridConfig, table: Any, mode: dr.ReduceMode = dr.ReduceMode.Auto):
        self.config, self.table, self.mode = config, table, mode
        (expected,) = config.parameter_shapes()["table"]
        if len(table) != expected:
            raise ValueError(f'"grid.table" has {len(table)} entries, but its configuration {config} needs {expected}')
        self._scales = config.level_scales()
        self._rows = config.level_rows()
        self._offsets = config.offsets()

    @classmethod
    def random(cls, config: HashGridConfig, ns: ModuleType, rng: np.random.Generator, scale: float = 1e-4) -> HashGrid:
        """A grid with entries uniform in ``[-scale, scale]``."""
        (size,) = config.parameter_shapes()["table"]
        return cls(config, ns.Float(rng.uniform(-scale, scale, size).astype(np.float32)))

    @classmethod
    def from_parameters(
        cls,
        config: HashGridConfig,
        parameters: Mapping[str, Any],
        name: str = "grid",
        mode: dr.ReduceMode = dr.ReduceMode.Auto,
    ) -> HashGrid:
        """The grid of ``config`` with the entry ``NAME.table`` of ``parameters``."""
        return cls(config, parameters[f"{name}.table"], mode)

    def named(self) -> dict[str, Any]:
        """The parameters by name."""
        return {"table": self.table}

    def replace(self, name: str, value: Any) -> None:
        """Replace the parameter ``name`` by ``value`` of the same shape."""
        setattr(self, name, value)

    def check_config(self, config: HashGridConfig) -> None:
        """Raise ``ValueError`` unless this is a grid of ``config``."""
        if self.config != config:
            raise ValueError(f"this grid has the configuration {self.config}, but its field needs {config}")

    def is_hashed(self, level: int) -> bool:
        """Whether the vertices of ``level`` exceed its rows."""
        stride = int(np.ceil(self._scales[level])) + 2
        return stride**self.config.dimensions > self._rows[level]

    def __call__(self, p: Array3f, active: Bool | bool = True) -> list[Float]:
        """Features at ``p`` (Array3f in the unit cube, or Array2f): ``levels * features`` Floats, zero outside."""
        p, inside = self._clamped(p, active)
        out = []
        for level in range(self.config.levels):
            out += self._level(level, p, inside)
        return out

    def evaluate_eagerly(self, p: Array3f, active: Bool | bool = True) -> list[Float]:
        """The same features, evaluated level by level, so that the rows of one level stay in the caches.

        Useful for many scattered points whose features are stored anyway.
        """
        p, inside = self._clamped(p, active)
        dr.eval(p, inside)
        out = []
        for level in range(self.config.levels):
            out += self._level(level, p, inside)
            dr.eval(out)
        return out

    def attach(self, features: list[Float], p: Array3f) -> list[Float]:
        # Not the grid itself, which Dr.Jit would copy by its constructor.
        with_table = lambda table: HashGrid(self.config, table, self.mode)
        return dr.custom(_TableDerivatives, self.table, features, p, with_table)

    def scatter(self, p: Array3f, features: list[Float]) -> Float:
        """Sum ``features`` at ``p`` over the vertices around, times the weights of the interpolation, in a new table.

        This is the transpose of the evaluation, level by level as in `evaluate_eagerly`. Each level has its own array,
        because with `dr.ReduceMode.Expand` each evaluation copies a whole array for every thread and adds the copies.
        """
        p, inside = self._clamped(p, True)
        packet = self._packet(p)
        tables = []
        for level, rows in enumerate(self._rows):
            parts = features[level * self.config.features : (level + 1) * self.config.features]
            cell, w = self._locate(level, p)
            lo, hi = self._corner_indices(level, cell)
            table = dr.zeros(type(self.table), rows * self.config.features)
            for corner in np.ndindex(*(2,) * self.config.dimensions):
                index = self._combine(level, tuple((hi if c else lo)[k] for k, c in enumerate(corner)))
                weight = 1.0
                for c, x in zip(corner, w):
                    weight *= x if c else 1 - x
                dr.scatter_add(table, packet(*[weight * x for x in parts]), index, inside, self.mode)
            dr.eval(table)
            tables.append(table)
        return dr.concat(tables)

    @staticmethod
    def _clamped(p, active):
        """``p`` with 0 for points outside the cube, and the mask of the points inside."""
        inside = active & dr.all((p >= 0) & (p <= 1))
        # A negative coordinate cast to an unsigned cell would extrapolate by 4e9.
        return dr.select(inside, p, 0), inside

    def _level(self, level: int, p, active) -> list:
        cell, w = self._locate(level, p)
        lo, hi = self._corner_indices(level, cell)
        packet = self._packet(p)
        read = lambda index: dr.gather(
            packet, self.table, self._combine(level, index) + self._offsets[level], active, mode=self.mode
        )
        return list(dr.select(active, _blend(read, lo, hi, w, self.config.dimensions - 1, ()), 0))

    def _packet(self, p) -> type:
        """Array type of the features of a vertex."""
        ns = namespace(p)
        return {2: ns.Array2f, 4: ns.Array4f}[self.config.features]

    def _locate(self, level: int, p) -> tuple[list, list]:
        """Cell of ``level`` that holds ``p``, and the position in it, per axis."""
        ns, scale = namespace(p), float(self._scales[level])
        pos = [dr.fma(c, scale, 0.5) for c in p]
        cell = [ns.UInt32(c) for c in pos]
        return cell, [c - ns.Float(i) for c, i in zip(pos, cell)]

    def _corner_indices(self, level: int, cell):
        """Per-axis parts of the vertex index, for the lower and the upper corner."""
        if self.is_hashed(level):
            steps = _PRIMES
        else:
            stride = int(np.ceil(self._scales[level])) + 2
            steps = (1, stride, stride * stride)  # one per axis
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
    """Interpolate from the last axis inwards: seven lerps per feature instead of eight weights and eight products.

    Not a closure: a closure that calls itself is a reference cycle, and keeps its arrays until garbage collection.
    """
    if axis < 0:
        return read(index)
    low, high = (_blend(read, lo, hi, w, axis - 1, (i[axis], *index)) for i in (lo, hi))
    return dr.lerp(low, high, w[axis])


class _TableDerivatives(dr.CustomOp):
    """Features of a hash grid that were evaluated earlier, with their derivatives by the table."""

    def eval(self, table, features, p, with_table):
        self.p, self.table, self.with_table = p, table, with_table
        return list(features)

    def forward(self):
        self.set_grad_out(self.with_table(self.grad_in("table"))(self.p))

    def backward(self):
        self.set_grad_in("table", self.with_table(self.table).scatter(self.p, self.grad_out()))

    def name(self):
        return "hash grid"
