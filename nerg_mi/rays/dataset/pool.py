"""Processes that import sources beside each other, and end with the one that has started them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool

from nerg_mi.errors import NergError

from .importing import Outcome, Task, import_source


def run_tasks(tasks: Sequence[Task], workers: int) -> Iterator[Outcome]:
    """The outcomes of tasks as they come, from ``workers`` processes, or from this one where that is one.

    Raises `NergError` where a process was ended from outside.
    """
    workers = min(workers, len(tasks))
    if workers <= 1:
        yield from map(import_source, tasks)
        return
    # Not forked: threads of libraries would be lost, and with them their locks.
    context = multiprocessing.get_context("spawn")
    threads = max(1, (os.cpu_count() or 1) // workers)
    with ProcessPoolExecutor(workers, context, initializer=_begin, initargs=(threads,)) as pool:
        waiting = [pool.submit(import_source, task) for task in tasks]
        try:
            for done in as_completed(waiting):
                yield done.result()
        except BrokenProcessPool as error:
            raise NergError(
                "a process that imported was ended, or could not start: give fewer --workers if memory was short; in a "
                'script, call it below if __name__ == "__main__"; what is finished is kept'
            ) from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _begin(threads: int) -> None:
    """Prepare a process: it ends at once by Ctrl-C, and when its parent is gone, however that ended."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    try:
        import pyarrow
    except ImportError:
        return  # said where it is used
    pyarrow.set_cpu_count(threads)
