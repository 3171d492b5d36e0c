"""Arrays of Dr.Jit: made from NumPy's without new kernels, and elementary functions that neither cancel nor
overflow."""

from __future__ import annotations

from typing import Any, cast

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from .types import Float

# ---- From NumPy to Dr.Jit so that kernels are the same for any number of values ----
#
# Dr.Jit reads the memory of NumPy's arrays where it lies. A vector that is made of one array has its length in the
# kernel, as the distance of its components, and an array that begins anywhere has a kernel of its own, too, whose loads
# expect no alignment: both are compiled anew where another number of rays is traced.

ALIGNMENT = 64  # Bytes: the widest packet's


def copy_aligned(values: ArrayLike, dtype: DTypeLike = np.float32) -> np.ndarray:
    """A copy of ``values``, of any shape, that begins at a whole packet."""
    array = np.asarray(values)
    return _columns(array.reshape(-1, 1), np.dtype(dtype))[0].reshape(array.shape)


def to_vector(kind: Any, rows: ArrayLike, dtype: DTypeLike = np.float32) -> Any:
    """The Dr.Jit vector type ``kind`` (``mi.Point3f``, say) whose lanes are ``rows`` (N, components)."""
    import drjit as dr

    return kind(*map(dr.value_t(kind), _columns(np.asarray(rows), np.dtype(dtype))))


def _columns(rows: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """The columns of ``rows`` (N, C), as (C, N), each of which begins at a whole packet."""
    count, components = rows.shape
    packet = ALIGNMENT // dtype.itemsize
    stride = -(-count // packet) * packet
    memory = np.empty(components * stride + packet, dtype)
    first = (-memory.ctypes.data // dtype.itemsize) % packet
    columns = memory[first : first + components * stride].reshape(components, stride)[:, :count]
    columns[:] = rows.T
    return columns


# ---- Elementary ----
#
# 1 - exp(-x), log(1 + x), quotients of tiny numbers and the logistic function, without cancellation or overflow.


def one_minus_exp(x: Float) -> Float:
    """1 - exp(-x) for x >= 0, to full relative precision also for tiny x; 1 at infinity."""
    # tanh is accurate near 0 and saturates at 1: 1 - exp(-x) = 2 th / (1 + th), th = tanh(x / 2).
    th = dr.tanh(0.5 * x)
    # The derivative is written out: that of tanh, 1 - th², cancels as x grows.
    return cast("Float", dr.replace_grad(2 * th / (1 + th), -dr.exp(-x)))


def log1p(x: Float) -> Float:
    """log(1 + x) for -1 < x <= 1, to full relative precision also for tiny x."""
    return 2 * dr.atanh(x / (2 + x))


def quotient(a: Float, b: Float) -> Float:
    """a / b for b != 0. Its first derivatives do not square b, which would overflow below 1e-19."""
    value = dr.detach(a) / dr.detach(b)
    return cast("Float", dr.replace_grad(value, (a - value * b) * (1 / dr.detach(b))))


def sigmoid(x: Float) -> Float:
    """1 / (1 + exp(-x)), finite with its gradient for every finite x."""
    return dr.fma(0.5, dr.tanh(0.5 * x), 0.5)
