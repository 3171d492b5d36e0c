"""Operations in parts: the store and the engine of one job."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from nerg_mi.errors import NergError, parameter
from nerg_mi.progress import Reporter

from .engines import PlanProgress, TaskOutput, open_engine, run_plan
from .settings import Parallel
from .store import Store
from .task import Plan

SUFFIX = ".tasks"
"""Suffix of the default store next to an output."""


class PartRunner:
    """The store and the engine of one job, which writes ``output`` if that is a file or folder.

    Raises `NergError` for a folder that is not writable, for no folder at all, and for an unknown scheduler.
    """

    def __init__(self, parallel: Parallel, output: Path | None, reporter: Reporter):
        folder = parallel.store
        if folder is None:
            if output is None:
                raise NergError(
                    f"parts need a folder; name one with {parameter('store')}, or give an output next to which it is "
                    "created"
                )
            folder = output.with_suffix(SUFFIX)
        self.store = Store(folder)
        self.engine = open_engine(parallel.scheduler, parallel.threads or 0, parallel.worker_wait)
        self._reporter = reporter

    def run(self, plan: Plan, since: float = 0.0, until: float = 1.0) -> Iterator[TaskOutput]:
        """Yield the outputs of ``plan`` in order, see `run_plan`.

        This stage covers the progress from ``since`` to ``until``. Ctrl-C raises ``KeyboardInterrupt`` with a message
        on how to resume.
        """

        def show(progress: PlanProgress) -> None:
            self._reporter.progress(since + (until - since) * progress.fraction, progress.format_line(until == 1.0))

        try:
            yield from run_plan(plan, self.store, self.engine, show, self._reporter.warn)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"Interrupted; finished parts are stored in {self.store.folder}: run the same command again to resume."
            ) from None
