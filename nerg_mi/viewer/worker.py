"""One thread that does all rendering, in small steps, the most urgent first.

Dr.Jit is used from one thread at a time. A task is a generator: each of its steps is short, between two of them another
task may be more urgent, and whoever submits one under a name that is taken replaces the other, whose further steps are
then never made. That is how a picture is cancelled when the view moves.
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
    """A thread that runs tasks; ``on_error(error)`` is told of exceptions that tasks raise, which end them alone."""

    def __init__(self, on_error: Callable[[BaseException], None]):
        self._on_error = on_error
        self._tasks: dict[Hashable, tuple[int, int, Task]] = {}
        self._changed = threading.Condition()
        self._turn = itertools.count()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="nerg-view-render", daemon=True)
        self._thread.start()

    def submit(self, name: Hashable, urgency: int, task: Task) -> None:
        """Run ``task`` from now on, in place of one of the same ``name``; smaller ``urgency`` first, tasks of one
        urgency in turns."""
        with self._changed:
            if not self._stopped:
                self._tasks[name] = urgency, next(self._turn), task
                self._changed.notify_all()

    def cancel(self, name: Hashable) -> None:
        """Make no further step of the task ``name``, if there is one."""
        with self._changed:
            self._tasks.pop(name, None)
            self._changed.notify_all()

    def call(self, function: Callable[[], Result]) -> Future[Result]:
        """Call ``function`` on the thread, before any task; its result or its exception is the future's."""
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
    def names(self) -> list[Hashable]:
        """The tasks that are not done yet."""
        with self._changed:
            return list(self._tasks)

    @property
    def idle(self) -> bool:
        """Whether nothing is left to do."""
        with self._changed:
            return not self._tasks

    def wait_idle(self, timeout: float) -> bool:
        """Wait until nothing is left to do, ``timeout`` seconds at most; whether it is so."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._tasks, timeout)

    def stop(self, timeout: float = 30.0) -> None:
        """End the thread after the step that it is in."""
        with self._changed:
            self._stopped = True
            self._tasks.clear()
            self._changed.notify_all()
        self._thread.join(timeout)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopped or self._tasks)
                if self._stopped:
                    return
                name = min(self._tasks, key=lambda n: self._tasks[n][:2])
                entry = self._tasks[name]
            over = self._step(entry[2])
            with self._changed:
                # It may have been replaced in the meantime.
                if self._tasks.get(name) is entry:
                    if over:
                        del self._tasks[name]
                    else:
                        self._tasks[name] = entry[0], next(self._turn), entry[2]
                self._changed.notify_all()

    def _step(self, task: Task) -> bool:
        """Make a step of ``task``: whether it was the last."""
        try:
            next(task)
        except StopIteration:
            return True
        except BaseException as error:
            self._on_error(error)
            return True
        return False
