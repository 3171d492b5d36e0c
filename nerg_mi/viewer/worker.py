"""The thread that renders.

Dr.Jit is used from one thread at a time. A task is a generator with short steps. Between two steps, a task of higher
priority can run. A new task replaces a task of the same name, which then does not continue: this cancels a picture
when the view moves.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Generator, Hashable, Iterator
from concurrent.futures import Future
from typing import Any, TypeVar

Result = TypeVar("Result")
Task = Generator[Any, None, None] | Iterator[Any]


class Worker:
    """A thread that runs tasks. An exception ends its task only and is passed to ``on_error(error)``."""

    def __init__(self, on_error: Callable[[BaseException], None]):
        self._on_error = on_error
        self._tasks: dict[Hashable, tuple[int, int, Task]] = {}
        self._changed = threading.Condition()
        self._counter = itertools.count()
        self._is_stopped = False
        self._thread = threading.Thread(target=self._run, name="nerg-view-render", daemon=True)
        self._thread.start()

    def submit(self, name: Hashable, priority: int, task: Task) -> None:
        """Run ``task``, replacing a task of the same ``name``.

        Tasks with a smaller ``priority`` value run first; tasks of equal priority take turns.
        """
        with self._changed:
            if not self._is_stopped:
                self._tasks[name] = priority, next(self._counter), task
                self._changed.notify_all()

    def cancel(self, name: Hashable) -> None:
        """Cancel the task ``name`` if it exists."""
        with self._changed:
            self._tasks.pop(name, None)
            self._changed.notify_all()

    def call(self, function: Callable[[], Result]) -> Future[Result]:
        """Call ``function`` on the thread before the next step of any task, and return a future of its result."""
        future: Future[Result] = Future()

        def steps() -> Iterator[None]:
            try:
                future.set_result(function())
            except BaseException as error:
                future.set_exception(error)
            yield

        self.submit(object(), -1, steps())
        return future

    @property
    def task_names(self) -> list[Hashable]:
        """Names of the unfinished tasks."""
        with self._changed:
            return list(self._tasks)

    @property
    def is_idle(self) -> bool:
        """Whether there are no unfinished tasks."""
        with self._changed:
            return not self._tasks

    def wait_idle(self, timeout: float) -> bool:
        """Wait at most ``timeout`` seconds until all tasks are finished; return whether they are."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._tasks, timeout)

    def stop(self, timeout: float = 30.0) -> None:
        """Stop the thread after its current step."""
        with self._changed:
            self._is_stopped = True
            self._tasks.clear()
            self._changed.notify_all()
        self._thread.join(timeout)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_stopped or self._tasks)
                if self._is_stopped:
                    return
                name = min(self._tasks, key=lambda n: self._tasks[n][:2])
                entry = self._tasks[name]
            is_done = self._step(entry[2])
            with self._changed:
                # Another task may have replaced it during the step.
                if self._tasks.get(name) is entry:
                    if is_done:
                        del self._tasks[name]
                    else:
                        self._tasks[name] = entry[0], next(self._counter), entry[2]
                self._changed.notify_all()

    def _step(self, task: Task) -> bool:
        """Run one step of ``task`` and return whether the task is finished."""
        try:
            next(task)
        except StopIteration:
            return True
        except BaseException as error:
            self._on_error(error)
            return True
        return False
