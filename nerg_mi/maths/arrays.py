"""Dr.Jit arrays from NumPy arrays without recompiled kernels, and elementary functions without cancellation or
overflow."""

from __future__ import annotations

from typing import Any, cast

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from nerg_mi.errors import NergError
from nerg_mi.files.values import to_numbers
from nerg_mi.ranges import POSITIVE_VALUES

from .types import Float

# ---- Weights ----


def check_weights(weights: ArrayLike, count: int, name: str = "weights") -> np.ndarray:
    """Return ``weights`` (..., count) as float64.

    Raises `NergError`, which calls them ``name``, for another number of weights, for one that is not finite, negative
    or above `POSITIVE_VALUES`, and if all are zero: a density with such weights would be NaN.
    """
    out = to_numbers(weights, name)
    if out.shape[-1:] != (count,):
        raise NergError(f"{name} of shape {out.shape} must be {count:,} numbers that are not negative")
    bad = np.argwhere(~((out >= 0) & (out <= POSITIVE_VALUES.high)))
    if len(bad):
        place = ", ".join(map(str, bad[0]))
        raise NergError(
            f"{name}[{place}] is {out[tuple(bad[0])]:g}, but a weight must be 0 to {POSITIVE_VALUES.high:g}; "
            "correct it, or leave out what it weights"
        )
    if not (out.sum(axis=-1) > 0).all():
        raise NergError(f"all {name} are zero; at least one must be positive")
    return out


# ---- NumPy arrays to Dr.Jit, with kernels that do not depend on their length ----
#
# Dr.Jit uses the memory of NumPy arrays in place. A vector that is made of one array puts the length into the kernel,
# as the distance between components, and the alignment of an array is also part of the kernel. Both cause recompilation
# for another number of rays.

ALIGNMENT = 64  # Bytes of the widest packet


def copy_aligned(values: ArrayLike, dtype: DTypeLike = np.float32) -> np.ndarray:
    """A copy of ``values``, of any shape, that starts at a packet boundary."""
    array = np.asarray(values)
    return _columns(array.reshape(-1, 1), np.dtype(dtype))[0].reshape(array.shape)


def to_vector(vector_type: Any, rows: ArrayLike, dtype: DTypeLike = np.float32) -> Any:
    """The Dr.Jit vector of type ``vector_type`` (e.g. ``mi.Point3f``) with the lanes ``rows`` (N, components)."""
    import drjit as dr

    return vector_type(*map(dr.value_t(vector_type), _columns(np.asarray(rows), np.dtype(dtype))))


def _columns(rows: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """The columns of ``rows`` (N, C) as (C, N), each starting at a packet boundary."""
    count, components = rows.shape
    packet = ALIGNMENT // dtype.itemsize
    stride = -(-count // packet) * packet
    memory = np.empty(components * stride + packet, dtype)
    first = (-memory.ctypes.data // dtype.itemsize) % packet
    columns = memory[first : first + components * stride].reshape(components, stride)[:, :count]
    columns[:] = rows.T
    return columns


# ---- Elementary functions ----
#
# 1 - exp(-x), log(1 + x), quotients of tiny numbers and the logistic function, without cancellation or overflow.


def one_minus_exp(x: Float) -> Float:
    """1 - exp(-x) for x >= 0, to full relative precision also for tiny x; 1 at infinity."""
    # tanh is accurate near 0 and saturates at 1: 1 - exp(-x) = 2 th / (1 + th), th = tanh(x / 2).
    th = dr.tanh(0.5 * x)
    # Explicit derivative: that of tanh, 1 - th², cancels for large x.
    return cast("Float", dr.replace_grad(2 * th / (1 + th), -dr.exp(-x)))


def log1p(x: Float) -> Float:
    """log(1 + x) for -1 < x <= 1, to full relative precision also for tiny x."""
    return 2 * dr.atanh(x / (2 + x))


def quotient(a: Float, b: Float) -> Float:
    """a / b for b != 0. The first derivatives do not square b, which would overflow for b below 1e-19."""
    value = dr.detach(a) / dr.detach(b)
    return cast("Float", dr.replace_grad(value, (a - value * b) * (1 / dr.detach(b))))


def sigmoid(x: Float) -> Float:
    """1 / (1 + exp(-x)), finite with a finite gradient for every finite x."""
    return dr.fma(0.5, dr.tanh(0.5 * x), 0.5)


def kahan_add(total: Float, compensation: Float, term: Float) -> tuple[Float, Float]:
    """``(total + term, compensation)``: compensated summation (Kahan 1965).

    A thousand plain additions lose two digits, and the derivative of a depth divides that error by the opacity.
    """
    term = term - compensation
    after = total + term
    return after, (after - total) - term
