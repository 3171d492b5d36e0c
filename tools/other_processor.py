"""Run a command as another processor would: with narrower vectors, whose sums have another order.

    python -m tools.other_processor COMMAND ...

NumPy, OpenBLAS and Dr.Jit select instructions by the processor, and results differ in their last bits. Here, they
select those of a processor without AVX-512 or, where there is none, without AVX2. NumPy and OpenBLAS read this from the
environment, also in child processes. Dr.Jit does not: `limit_drjit`, which tests call, changes its process only.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from pathlib import Path

import nerg_mi  # noqa: F401 (selects libLLVM)

VARIABLE = "NERG_VECTOR_WIDTH"
"""Environment variable with the number of floats in a vector of Dr.Jit's kernels."""


AVX512 = ("AVX512", "X86_V4")
"""Prefixes of NumPy's names for AVX-512."""


def _list_extensions() -> list[str]:
    """Return the instructions that NumPy uses on this processor in addition to those that its build requires."""
    import numpy as np

    return np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])


def has_avx512() -> bool:
    return any(name.startswith(AVX512) for name in _list_extensions())


def make_environment() -> dict[str, str]:
    """Return environment variables for the next narrower kind of processor."""
    extra = _list_extensions()
    widest = [name for name in extra if name.startswith(AVX512)]
    return {
        "NPY_DISABLE_CPU_FEATURES": " ".join(widest or extra),
        "OPENBLAS_CORETYPE": "Haswell" if widest else "Nehalem",
        VARIABLE: "8" if widest else "4",
    }


def limit_drjit(width: int) -> Callable[[], None]:
    """Have Dr.Jit compile kernels with vectors of ``width`` floats and no instructions beyond AVX2, which it requires.

    Dr.Jit exports this function to C++ only. Returns a function that undoes it.
    """
    import drjit
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")  # it detects the processor when it is initialised
    library = ctypes.CDLL(str(Path(drjit.__file__).with_name("libdrjit-core.so")))
    # void jit_llvm_set_target(const char *cpu, const char *features, uint32_t vector_width)
    set_target = library["_Z19jit_llvm_set_targetPKcS0_j"]
    set_target.argtypes, set_target.restype = [ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint32], None
    get_cpu, get_features, get_width = (
        library[name]
        for name in ("_Z19jit_llvm_target_cpuv", "_Z24jit_llvm_target_featuresv", "_Z21jit_llvm_vector_widthv")
    )
    get_cpu.restype = get_features.restype = ctypes.c_char_p
    get_width.restype = ctypes.c_uint32
    before = get_cpu(), get_features(), get_width()
    set_target(b"x86-64-v3", b"", width)
    if get_width() != width:
        raise RuntimeError(f"Dr.Jit uses vectors of {get_width()} floats, not {width}")
    return lambda: set_target(*before)


def main(command: list[str]) -> None:
    environment = make_environment()
    print(*(f"{name}={value!r}" for name, value in environment.items()), flush=True)
    os.execvpe(command[0], command, {**os.environ, **environment})


if __name__ == "__main__":
    main(sys.argv[1:])
