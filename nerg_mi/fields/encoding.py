"""Encodings of positions and directions, which the networks are given: protocol, registry, and the hash grid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any, ClassVar, Protocol

import drjit as dr
import numpy as np

from nerg_mi.maths.types import Array3f, Bool, Float

from .mlp import namespace

# ---- Real spherical harmonics as an encoding of directions ----
#
# Order and signs are those of instant-ngp and torch-ngp (Condon-Shortley phase,
# l = 0..3, m = -l..l), which Dr.Jit's ``sh_eval`` shares.


def encode_direction(d, degree: int = 4) -> list:
    """The ``degree**2`` harmonics (list of Floats) of a unit direction ``d`` (Array3f)."""
    if not 1 <= degree <= 10:
        raise ValueError(f"the degree of the direction encoding must lie in 1..10, got {degree}")
    return list(dr.sh_eval(d, degree - 1))


# ---- What a field asks of the encoding of its positions ----
#
# An encoding turns a point of the unit cube (or, with two dimensions, of the unit square) into ``config.size`` numbers,
# which the networks are given. A field keeps it as ``grid`` and spells its parameters ``grid.NAME``, as checkpoints do.
#
# A new encoding is one module: a frozen dataclass of its sizes that fulfils `EncodingConfig`, a class that fulfils
# `Encoding`, and a call of :func:`nerg_mi.fields.encoding.register`. Both protocols are to be inherited from,
# for what they already do.


class EncodingConfig(Protocol):
    """Sizes of an encoding: a frozen dataclass of JSON values, whose constructor raises ``ValueError`` for wrong ones.

    Encodings of equal configurations are interchangeable.
    """

    kind: ClassVar[str]  # What a checkpoint calls this kind of encoding
    # By name of a size that is a whole number: the largest that is read from a file.
    max_sizes: ClassVar[Mapping[str, int]]

    @property
    def dimensions(self) -> int:
        """Coordinates of a point, 2 or 3."""
        ...

    @property
    def size(self) -> int:
        """How many numbers a point is encoded by."""
        ...

    @property
    def finest(self) -> float:
        """Cells along an edge of the unit cube that the encoding resolves at most."""
        ...

    def parameter_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the parameters, by name: flat arrays (Float) have one axis, tensors (TensorXf) more."""
        ...

    def describe(self) -> str:
        """The sizes in a few words."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """The JSON object that stands in a checkpoint; see ``encoding.encoding_config`` for the way back."""
        return {"kind": self.kind, **asdict(self)}  # pyright: ignore[reportArgumentType] it is a dataclass


class Encoding(Protocol):
    """Trainable features at points of the unit cube.

    The constructor takes ``config``, the parameters by their names, and ``mode``: how derivatives are added to the
    parameters (``Expand``, a copy for every thread, is a fraction of the cost of atomics for large batches). It raises
    ``ValueError`` where parameters do not have the shapes of ``config``. Each parameter is an attribute of its name and
    an entry of ``DRJIT_STRUCT``, so that Dr.Jit finds it in frozen functions and loops.
    """

    DRJIT_STRUCT: ClassVar[dict[str, Any]]
    config: Any
    mode: dr.ReduceMode

    @classmethod
    def random(cls, config: Any, ns: ModuleType, rng: np.random.Generator) -> Encoding:
        """An untrained encoding of backend ``ns``; equal states of ``rng`` give equal parameters."""
        ...

    def __call__(self, p: Array3f, active: Bool | bool = True) -> list[Float]:
        """``config.size`` Floats at ``p`` (Array3f, or Array2f, of the unit cube).

        Zeros where ``p`` lies outside of the cube or is not ``active``. Derivatives reach the parameters and ``p``.
        """
        ...

    def evaluate_eagerly(self, p: Array3f, active: Bool | bool = True) -> list[Float]:
        """The same numbers in memory, for many points at once; an encoding may have a faster way to them."""
        out = self(p, active)
        dr.eval(out)
        return out

    def named(self) -> dict[str, Any]:
        """The parameters by name."""
        return {name: getattr(self, name) for name in self.config.parameter_shapes()}

    def replace(self, name: str, value: Any) -> None:
        """Put ``value`` in the place of the parameter ``name``, of the same shape; `pack` makes it count."""
        setattr(self, name, value)

    def pack(self) -> None:
        """Refresh what the kernels read, where that is not the parameters themselves; derivatives flow through."""

    def kernel_parameters(self) -> list:
        """The flat arrays that evaluations read, attached to the parameters."""
        return [value.array for value in self.named().values()]

    def require(self, config: Any) -> None:
        """Raise ``ValueError`` unless this is an encoding of ``config``."""
        if self.config != config:
            raise ValueError(f"this grid is {self.config} where its field needs {config}")


# ---- Registry ----
#
# The encodings of positions that there are, by the kind that a file names and by the type of their configuration.

DEFAULT_KIND = "hashgrid"
"""What a configuration in a file is of that names no kind, as no file did when there was no other."""

_CONFIGS: dict[str, type[EncodingConfig]] = {}
_ENCODINGS: dict[type[EncodingConfig], type[Encoding]] = {}


def register(config: type[EncodingConfig], encoding: type[Encoding]) -> None:
    """Let configurations of the type ``config`` stand for encodings of the type ``encoding``, in files too.

    Raises ``ValueError`` where another type has its kind.
    """
    if _CONFIGS.get(config.kind, config) is not config:
        raise ValueError(f'there is another encoding of the kind "{config.kind}": {_CONFIGS[config.kind].__name__}')
    _CONFIGS[config.kind], _ENCODINGS[config] = config, encoding


def kinds() -> tuple[str, ...]:
    """The kinds that are registered."""
    return tuple(_CONFIGS)


def config_type(about: Mapping[str, Any]) -> type[EncodingConfig]:
    """The type of configuration that the JSON object ``about`` is of. Raises ``ValueError`` for an unknown kind."""
    kind = about.get("kind", DEFAULT_KIND)
    if not isinstance(kind, str) or kind not in _CONFIGS:
        raise ValueError(
            f"its positions are encoded by {str(kind)[:40]!r}, which this version does not know; it knows "
            f"{', '.join(_CONFIGS)}"
        )
    return _CONFIGS[kind]


def encoding_config(about: Mapping[str, Any]) -> EncodingConfig:
    """The configuration that ``to_dict`` made ``about`` of. Raises ``ValueError`` or ``TypeError`` for what is none."""
    return config_type(about)(**{k: v for k, v in about.items() if k != "kind"})


def random_encoding(config: EncodingConfig, ns: ModuleType, rng: np.random.Generator) -> Encoding:
    """An untrained encoding of ``config`` on backend ``ns``."""
    return _ENCODINGS[type(config)].random(config, ns, rng)


def encoding_from_parameters(
    config: EncodingConfig, parameters: Mapping[str, Any], name: str = "grid", mode: dr.ReduceMode = dr.ReduceMode.Auto
) -> Encoding:
    """The encoding of ``config`` whose parameters stand in ``parameters`` as ``NAME.PARAMETER``; see `Encoding`."""
    arrays = {key: parameters[f"{name}.{key}"] for key in config.parameter_shapes()}
    return _ENCODINGS[type(config)](config, **arrays, mode=mode)  # pyright: ignore[reportCallIssue] as `Encoding` says


# ---- Multiresolution hash grid (Müller et al ----
#
# 2022, "Instant Neural Graphics Primitives").
#
# The memory layout is torch-ngp's, so that its checkpoints load without loss: a vertex stride of resolution + 1 on
# dense levels (no aliasing at the far faces), rows rounded up to a multiple of 8, scales in float32, and zero outside
# of the unit cube. A level whose (resolution + 1)^3 vertices do not fit in the table is hashed with the primes of the
# paper.

_PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True)
class HashGridConfig(EncodingConfig):
    """Sizes of a hash grid. Resolutions grow geometrically from the coarsest level to the finest."""

    kind: ClassVar[str] = DEFAULT_KIND
    max_sizes: ClassVar[Mapping[str, int]] = {
        "levels": 64,
        "features": 4,
        "log2_rows": 26,
        "base": 1 << 20,
        "dimensions": 3,
    }

    levels: int = 16  # Grids of different resolution, whose features are concatenated
    features: int = 2  # Numbers at a vertex of a level: 2 or 4
    log2_rows: int = 19  # Base 2 logarithm of the rows that a level has at most
    base: int = 16  # Cells along an edge of the coarsest level
    finest: int | float = 2048  # Cells along an edge of the finest level
    dimensions: int = 3  # 3 for a grid over the unit cube, 2 for one over the unit square

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

    def parameter_shapes(self) -> dict[str, tuple[int, ...]]:
        return {"table": (self.offsets()[-1] * self.features,)}

    def describe(self) -> str:
        return f"{self.levels} x {self.features}, 2^{self.log2_rows} rows, {self.base} to {self.finest}"

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)  # Without a kind: so this version's files of hash grids can be read by all earlier ones

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
        (expected,) = config.parameter_shapes()["table"]
        if len(table) != expected:
            raise ValueError(f'"grid.table" has {len(table)} entries where its configuration {config} needs {expected}')
        self._scales = config.level_scales()
        self._rows = config.level_rows()
        self._offsets = config.offsets()

    @classmethod
    def random(cls, config: HashGridConfig, ns: ModuleType, rng: np.random.Generator, scale: float = 1e-4) -> HashGrid:
        """A grid with entries uniform in ``[-scale, scale]``."""
        (size,) = config.parameter_shapes()["table"]
        return cls(config, ns.Float(rng.uniform(-scale, scale, size).astype(np.float32)))

    def is_hashed(self, level: int) -> bool:
        """Whether the vertices of ``level`` do not fit in its rows."""
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


# ---- Encodings of positions and directions, which the networks are given ----

# What is there without being asked for registers itself here.
