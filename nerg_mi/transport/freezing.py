"""What to mind while ``dr.freeze`` records a function: it will be replayed with other values, and nothing is decided by
them."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr


def recording() -> bool:
    """Whether a frozen function is being recorded: values cannot be read then."""
    return dr.flag(dr.JitFlag.FreezingScope)


@contextmanager
def no_collection() -> Iterator[None]:
    """Keep Python's garbage while a function is recorded: Dr.Jit 1.5 ends the process where an array that lies in
    NumPy's memory is freed."""
    paused = recording() and gc.isenabled()
    if paused:
        gc.disable()
    try:
        yield
    finally:
        if paused:
            if gc.get_freeze_count() == 0:
                # Counts as if everything had just been looked at; otherwise the next object made would collect it all.
                gc.freeze()
                gc.unfreeze()
            gc.enable()
