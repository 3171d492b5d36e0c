"""The scheduler that is some processes of this machine, each of which runs one task at a time."""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Generator, Iterator

from nerg_mi.errors import NergError

from .children import Child, ChildDied, TaskFailed, failure
from .protocol import ATTEMPTS, Done, Warn
from .store import Store
from .task import Task


class Processes:
    """Runs tasks in ``count`` processes, each with so many ``threads``; 0: the cores are shared out among them.

    One process takes all cores for a picture or a training; more are for tasks that do not, and for memory that a task
    must give back.
    """

    def __init__(self, count: int, threads: int = 0):
        if not 1 <= count <= 1024:
            raise NergError(f"{count} worker processes were asked for; choose 1 to 1024")
        self.count = count
        self.threads = threads or max((os.cpu_count() or 1) // count, 1)

    def run(self, tasks: Iterator[Task], store: Store, warn: Warn) -> Generator[Done]:
        children = [Child(self.threads) for _ in range(self.count)]
        asked: queue.Queue[tuple[Task, int] | None] = queue.Queue()
        found: queue.Queue[tuple[Task, int, Done | Exception]] = queue.Queue()

        def serve(child: Child) -> None:
            while (request := asked.get()) is not None:
                task, attempt = request
                try:
                    paths = {file.name: file.path for file in task.inputs}
                    came: Done | Exception = Done(
                        task, child.make(task, paths, store.folder), f"process {children.index(child)}"
                    )
                except Exception as error:
                    came = error
                found.put((task, attempt, came))

        workers = [threading.Thread(target=serve, args=(child,), daemon=True) for child in children]
        for worker in workers:
            worker.start()
        running = 0
        try:
            for task in (next(tasks, None) for _ in range(self.count)):
                if task is not None:
                    asked.put((task, 1))
                    running += 1
            while running:
                task, attempt, came = found.get()
                running -= 1
                again = _again(task, attempt, came, warn)
                following = next(tasks, None) if again is None else again
                if following is not None:
                    asked.put((following, attempt + 1 if again is not None else 1))
                    running += 1
                if isinstance(came, Done):
                    yield came
        finally:
            for _ in children:
                asked.put(None)
            for child in children:
                child.close()


def _again(task: Task, attempt: int, came: Done | Exception, warn: Warn) -> Task | None:
    """``task`` if it has to be run once more; None where it is done. Raises what ends the job."""
    if isinstance(came, Done):
        return None
    if isinstance(came, TaskFailed):
        raise failure(task, came) from None
    if not isinstance(came, ChildDied):
        raise came
    if attempt >= ATTEMPTS:
        raise NergError(
            f"{task.label} ended its worker {attempt} times, the last time because {came}; run it alone to see why, or "
            "with fewer workers at once"
        )
    warn(f"a worker died at {task.label} ({came}); it is run again")
    return task
