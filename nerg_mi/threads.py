"""Number of CPU threads that Dr.Jit uses."""

from __future__ import annotations

import os
from pathlib import Path

THREADS_VARIABLE = "NERG_THREADS"
"""Environment variable that passes the number of threads from `nerg worker` to the process that computes."""


def set_thread_count(count: int) -> None:
    """Use ``count`` threads from now on.

    Finishes the queued kernels of all threads and the pending scatters of this one first. If Dr.Jit's thread pool is
    resized in between, they can remain unfinished, so that arrays contain uninitialized memory; and a scatter that was
    recorded for fewer threads writes outside its buffer, which can end the process.
    """
    import drjit as dr

    if dr.thread_count() != count:
        dr.eval()
        # It waits for the kernels of all threads; `dr.sync_thread` would wait for those of this thread only.
        dr.flush_malloc_cache()
        dr.set_thread_count(count)


def lower_priority() -> None:
    """Lower the priority of this thread and its children, where the operating system supports it.

    A browser that draws on this machine, without a graphics card, would freeze while pictures are refined.
    """
    if hasattr(os, "nice"):
        os.nice(10)


def count_cpus() -> int:
    """Return the number of CPUs that this process may use, as ``taskset`` and batch systems limit them."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def measure_processor_time() -> tuple[float, float] | None:
    """Return the seconds that all threads of this process ran, and that they were ready but waited for a processor.

    None where the system does not tell (it is Linux that does).
    """
    total = [0, 0]
    for path in Path("/proc/self/task").glob("*/schedstat"):
        try:
            running, waiting = path.read_text().split()[:2]
        except OSError:  # The thread has ended
            continue
        total[0] += int(running)
        total[1] += int(waiting)
    return (total[0] * 1e-9, total[1] * 1e-9) if total[0] else None


def get_worker_threads() -> int:
    """Return the number of threads that `nerg worker` assigned to this process; 0 for all."""
    text = os.environ.get(THREADS_VARIABLE, "")
    return int(text) if text.isdigit() else 0


def limit_threads(available: int, requested: int) -> int:
    """Return the number of threads for a job on a worker.

    Parameters
    ----------
    available
        Threads of the worker; 0 for all cores.
    requested
        Threads that the job requests; 0 for all.
    """
    limits = [count for count in (available, requested) if count]
    return min(limits) if limits else os.cpu_count() or 1
