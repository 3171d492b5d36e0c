"""Where a job computes: the Mitsuba variant and the number of threads."""

from __future__ import annotations

from types import ModuleType

from nerg_mi.threads import set_thread_count


def select_backend(mode: str | None, threads: int | None = None) -> ModuleType:
    """Make the Mitsuba variant ``mode`` the active one and return its Dr.Jit namespace, such as ``drjit.llvm.ad``.

    ``mode``: None for the best that works here; ``threads``: of the CPU, None or 0 for all. Raises `NergError` for a
    variant that does not exist or does not work.
    """
    from nerg_mi.fields.mlp import namespace
    from nerg_mi.rendering.scene import activate

    active = activate(mode)
    if threads:
        set_thread_count(threads)
    return namespace(active)
