"""From NumPy to Dr.Jit so that kernels are the same for any number of values.

Dr.Jit reads the memory of NumPy's arrays where it lies. A vector that is made of one array has its length in the
kernel, as the distance of its components, and an array that begins anywhere has a kernel of its own, too, whose loads
expect no alignment: both are compiled anew where another number of rays is traced.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

ALIGNMENT = 64
"""Bytes: the widest packet's."""


def aligned(values: ArrayLike, dtype: DTypeLike = np.float32) -> np.ndarray:
    """A copy (N,) of ``values`` that begins at a whole packet."""
    return _columns(np.ravel(np.asarray(values))[:, None], np.dtype(dtype))[0]


def vector_of(kind: Any, rows: ArrayLike, dtype: DTypeLike = np.float32) -> Any:
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
