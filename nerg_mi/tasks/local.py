"""The scheduler that is this process: one task after the other, with all cores that a task takes."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from pathlib import Path

from .inputs import Checksums
from .making import make_output
from .protocol import Done, Warn
from .store import Store
from .task import Task


class Local:
    """Runs each task when it is its turn, in the thread that asks for it. An error of a task comes out as it is."""

    def run(self, tasks: Iterator[Task], store: Store, warn: Warn) -> Generator[Done]:
        checksums = Checksums()
        for task in tasks:
            paths = {file.name: Path(file.path) for file in task.inputs}
            yield Done(task, make_output(task, paths, store, checksums))
