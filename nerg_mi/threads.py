"""How many threads Dr.Jit computes with on the CPU."""

from __future__ import annotations

import os

THREADS_VARIABLE = "NERG_THREADS"
"""Environment variable by which `nerg worker` hands its share of the cores to the process that computes."""


def set_thread_count(count: int) -> None:
    """Compute with ``count`` threads from now on.

    Waits for what is being computed: Dr.Jit queues its kernels, and a pool of threads that changes its size while some
    are in it can leave them undone, so that arrays hold what memory happened to hold.
    """
    import drjit as dr

    if dr.thread_count() != count:
        dr.sync_thread()
        dr.set_thread_count(count)


def get_worker_threads() -> int:
    """The threads that this process was given by whoever started it as a worker; 0 for all."""
    text = os.environ.get(THREADS_VARIABLE, "")
    return int(text) if text.isdigit() else 0


def limit_threads(available: int, requested: int) -> int:
    """Threads of a worker for a job that has ``asked`` for so many, of which it may use its ``own``; 0 for all."""
    wanted = [count for count in (available, requested) if count]
    return min(wanted) if wanted else os.cpu_count() or 1
