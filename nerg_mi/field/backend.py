"""The Dr.Jit array types of one backend.

A field belongs to one backend (LLVM or CUDA): its weights are arrays of that
backend. Nothing here depends on the Mitsuba variant in use, so that the code
survives a change of variant; the types derive from arguments.
"""

from __future__ import annotations

from types import ModuleType

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError


def namespace(source: str | dr.ArrayBase | type[dr.ArrayBase] | None) -> ModuleType:
    """Module holding the differentiable array types of a backend.

    ``source``: the name of a Mitsuba variant (``"llvm_ad_rgb"``; None, where none is active, is one that cannot be
    used), ``"llvm"``, ``"cuda"``, or any JIT array or array type. Returns ``drjit.llvm.ad`` or ``drjit.cuda.ad``.
    Raises ``NergError`` for scalar variants, which have no JIT arrays.
    """
    if source is None or isinstance(source, str):
        name = source or "none"
    else:
        backend = dr.backend_v(source)
        name = {dr.JitBackend.LLVM: "llvm", dr.JitBackend.CUDA: "cuda"}.get(backend, str(backend))
    if name.startswith("llvm"):
        import drjit.llvm.ad as ns
    elif name.startswith("cuda"):
        import drjit.cuda.ad as ns
    else:
        raise NergError(
            f'fields need a JIT variant such as "llvm_ad_rgb" or "cuda_ad_rgb", not "{name}"; '
            "select one with mi.set_variant()"
        )
    return ns


def is_cuda(ns: ModuleType) -> bool:
    """True when ``ns`` is the CUDA backend, where networks run in fp16."""
    return ns.__name__.startswith("drjit.cuda")


def aligned(array: np.ndarray, dtype: type = np.float32) -> np.ndarray:
    """A copy of ``array``, of type ``dtype``, that begins at a multiple of 64 bytes.

    Dr.Jit reads NumPy memory in place, and gathers several features in one load only from aligned memory. The alignment
    is also part of a kernel: each combination of those of its inputs is compiled anew.
    """
    array = np.asarray(array, dtype)
    memory = np.empty(array.nbytes + 64, np.uint8)
    start = -memory.ctypes.data % 64
    out = memory[start : start + array.nbytes].view(dtype).reshape(array.shape)
    out[...] = array
    return out
