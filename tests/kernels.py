"""Kernels that a function launches."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import numpy as np

SIZES = (1, 3, 6, 11, 2, 5)


def list_kernels_each(function: Callable[[int], object], count: int) -> list[set[str]]:
    """Return the hashes of the kernels of ``function(0)`` to ``function(count - 1)``.

    Memory is allocated between the calls, so that NumPy's arrays have other alignments each time.
    """
    kernels, memory = [], []
    for number in range(count):
        memory += [np.ones(4 * size, np.float32) for size in SIZES[: 1 + number % len(SIZES)]]
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            function(number)
            kernels.append({k["hash"] for k in dr.kernel_history([dr.KernelType.JIT])})
    return kernels
