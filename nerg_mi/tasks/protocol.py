"""Who runs tasks: this process, others of this machine, or a cluster. None of them changes what comes of a task."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from typing import Protocol

from .receipt import Receipt
from .store import Store
from .task import Task

ATTEMPTS = 3
"""So often a task is begun that ends its worker, before the job ends with a sentence that names it."""

Warn = Callable[[str], None]
"""Is told, in a sentence, what goes on differently than it should."""


@dataclass(frozen=True)
class Done:
    """A ``task`` whose output is in the store, whole; ``where``: the worker that made it ("" for this process)."""

    task: Task
    receipt: Receipt
    where: str = ""


class Scheduler(Protocol):
    """Runs tasks and has their outputs in a store.

    ``run`` takes from ``tasks`` only so many at a time as it has begun, so that a long plan takes no memory, and gives
    each as it is done, in any order. Workers that die, are slow or come late cost time and nothing else; a task that
    cannot be done raises a `NergError` that names it. Closing the generator gives up what was begun. ``warn`` is told
    in a sentence where work had to be repeated, or is waited for.
    """

    def run(self, tasks: Iterator[Task], store: Store, warn: Warn) -> Generator[Done]: ...
