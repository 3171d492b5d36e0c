"""What a field asks of the encoding of its positions.

An encoding turns a point of the unit cube (or, with two dimensions, of the unit square) into ``config.size`` numbers,
which the networks are given. A field keeps it as ``grid`` and spells its parameters ``grid.NAME``, as checkpoints do.

A new encoding is one module: a frozen dataclass of its sizes that fulfils `EncodingConfig`, a class that fulfils
`Encoding`, and a call of :func:`nerg_mi.field.encoding.registry.register`. Both protocols are to be inherited from,
for what they already do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from types import ModuleType
from typing import Any, ClassVar, Protocol

import drjit as dr
import numpy as np

from nerg_mi.maths.types import Array3f, Bool, Float


class EncodingConfig(Protocol):
    """Sizes of an encoding: a frozen dataclass of JSON values, whose constructor raises ``ValueError`` for wrong ones.

    Encodings of equal configurations are interchangeable.
    """

    # What a checkpoint calls this kind of encoding.
    kind: ClassVar[str]
    # By name of a size that is a whole number: the largest that is read from a file.
    limits: ClassVar[Mapping[str, int]]

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

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the parameters, by name: flat arrays (Float) have one axis, tensors (TensorXf) more."""
        ...

    def describe(self) -> str:
        """The sizes in a few words."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """The JSON object that stands in a checkpoint; see ``registry.encoding_config`` for the way back."""
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

    def __call__(self, p: Array3f, active: Bool = True) -> list[Float]:
        """``config.size`` Floats at ``p`` (Array3f, or Array2f, of the unit cube).

        Zeros where ``p`` lies outside of the cube or is not ``active``. Derivatives reach the parameters and ``p``.
        """
        ...

    def evaluated(self, p: Array3f, active: Bool = True) -> list[Float]:
        """The same numbers in memory, for many points at once; an encoding may have a faster way to them."""
        out = self(p, active)
        dr.eval(out)
        return out

    def named(self) -> dict[str, Any]:
        """The parameters by name."""
        return {name: getattr(self, name) for name in self.config.shapes()}

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
