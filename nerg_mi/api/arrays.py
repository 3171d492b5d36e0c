"""What comes in from NumPy, checked, and what goes out to it, labelled."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerg_mi.errors import NergError, plain
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.ranges import FARTHEST

Floats: TypeAlias = NDArray[np.float32]


def points(values: ArrayLike, name: str) -> Floats:
    """``values`` as (N, 3) float32; one point (3,) is one row. Raises `NergError`, which calls it ``name``."""
    try:
        array = np.asarray(values, np.float64)
    except OverflowError as error:
        raise NergError(
            f"{name} must have coordinates from {-FARTHEST:g} to {FARTHEST:g}, and one is beyond"
        ) from error
    except (TypeError, ValueError) as error:
        raise NergError(f"{name} must be numbers x, y, z, or rows of them, got {plain(repr(values), 60)}") from error
    array = array[None] if array.shape == (3,) else array
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
        raise NergError(f"{name} must have the shape (3,) or (N, 3), got {array.shape}")
    check_coordinates(array, name)
    return np.ascontiguousarray(array, np.float32)


def unit(values: ArrayLike, count: int, name: str) -> Floats:
    """``values`` as ``count`` unit vectors (N, 3); one direction serves all. Raises `NergError`."""
    array = points(values, name).astype(np.float64)
    if len(array) not in (1, count):
        raise NergError(f"{name} must be one or as many as the origins, {count}, got {len(array)}")
    length = np.linalg.norm(array, axis=1, keepdims=True)
    if not np.all(length > 0):
        raise NergError(f"{name} must not be zero, and row {int(np.flatnonzero(length == 0)[0])} is")
    return np.ascontiguousarray(np.broadcast_to(array / length, (count, 3)), np.float32)


@dataclass(frozen=True, eq=False, repr=False)
class Labelled:
    """Arrays by name: ``result["gaze"]`` and ``result.gaze`` are the same array.

    ``values``: the arrays, of which the first axes are those that ``axes`` names and a last one, where there is one
    more, the channels. ``observers`` (M, 3): the positions that the rows of the axis ``observer`` belong to; None where
    every element has an observer of its own. ``names``: those of the arrays. An array that does not depend on the
    observer is the same for all of them and cannot be written to.
    """

    values: Mapping[str, Floats]
    axes: tuple[str, ...]
    observers: Floats | None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.values)

    def __getitem__(self, name: str) -> Floats:
        try:
            return self.values[name]
        except KeyError:
            raise KeyError(f'there is no "{name}" here, but {listed(self.names)}; ask for it by quantities=') from None

    def __getattr__(self, name: str) -> Floats:
        # Asked while an object is copied or unpickled, when there are no values yet.
        if name.startswith("_") or name == "values":
            raise AttributeError(name)
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(error.args[0]) from None

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *self.names})

    def __iter__(self) -> Iterator[str]:
        return iter(self.values)

    def __len__(self) -> int:
        return len(self.values)

    def __contains__(self, name: object) -> bool:
        return name in self.values

    def __repr__(self) -> str:
        some = next(iter(self.values.values()))
        size = ", ".join(f"{axis} {length}" for axis, length in zip(self.axes, some.shape))
        width = max(map(len, self.names))
        lines = [f"  {name:<{width}}  {value.shape}, {value.dtype}" for name, value in self.values.items()]
        return "\n".join([f"{type(self).__name__}({size})", *lines])


def same_for_all(value: Floats, observers: int) -> Floats:
    """``value`` with an axis of ``observers`` in front, read-only, without a copy."""
    return np.broadcast_to(value, (observers, *value.shape))


def listed(names: Sequence[str]) -> str:
    """Names for a sentence."""
    return ", ".join(names)
