"""What a report says about the programs that made it."""

from __future__ import annotations

import platform

from nerg_mi import __version__, llvm


def versions(mode: str) -> dict[str, str]:
    """Version of each program that has a part in the numbers, by name; ``mode``: the Mitsuba variant in use."""
    import drjit
    import mitsuba
    import numpy

    out = {
        "nerg_mi": __version__,
        "mitsuba": mitsuba.__version__,
        "drjit": drjit.__version__,  # pyright: ignore[reportAttributeAccessIssue] which its stubs leave out
        "numpy": numpy.__version__,
        "python": platform.python_version(),
    }
    library = llvm.current()
    if mode.startswith("llvm") and library is not None:
        out["libLLVM"] = ".".join(map(str, library.version))
    if mode.startswith("cuda"):
        out["cuda"] = ".".join(map(str, drjit.detail.cuda_version()))
    return out
