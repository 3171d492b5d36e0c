"""Limits of the address space (``ulimit -v``), checked before libraries that would fail without naming memory.

This module does not import drjit, mitsuba or NumPy.
"""

from __future__ import annotations

import os

from nerg_mi.errors import NergError

NUMPY_MEGABYTES, SCIPY_MEGABYTES, MITSUBA_MEGABYTES = 140, 160, 400  # address space with two threads, measured


def find_free_address_space() -> int | None:
    """Return how many megabytes of address space this process may still use; None without a limit."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return None
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            used = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:  # other systems than Linux
        used = 0
    return (limit - used) >> 20


def require_address_space(megabytes: int, subject: str) -> None:
    """Raise `NergError` if less than ``megabytes`` of address space are left for ``subject``."""
    free = find_free_address_space()
    if free is not None and free < megabytes:
        raise NergError(
            f"not enough memory: {subject} needs about {megabytes} MB, and the limit of this process leaves {free} MB; "
            'raise it with "ulimit -v" or in the settings of the batch system'
        )
