"""Kernels that a function launches."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import numpy as np


def list_kernels_each(function: Callable[[int], object], count: int) -> list[set[str]]:
    """Return the hashes of the kernels of ``function(0)`` to ``function(count - 1)``.

    Memory is allocated and freed between the calls, so that NumPy's arrays have other alignments each time.
    """
    kernels, memory, rng = [], [], np.random.default_rng(0)
    for number in range(count):
        memory += [np.ones(size, np.float32) for size in rng.integers(1, 1 << 10, 200)]
        del memory[:: int(rng.integers(2, 5))]
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            function(number)
            kernels.append({k["hash"] for k in dr.kernel_history([dr.KernelType.JIT])})
    return kernels
