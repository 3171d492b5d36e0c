"""What a job tells, on the terminal: its messages, its warnings, and one bar for its progress, or lines in a log."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress

EVERY = 30.0
"""Seconds between two lines of progress where no terminal shows a bar."""


class TerminalReporter:
    """A `nerg_mi.jobs.reporter.Reporter`, and a context that takes the bar away again.

    Messages go to the standard output and warnings to the standard error. The bar is on the standard error, from the
    first ``progress`` on and only where that is a terminal, so that neither a pipe nor a file ever holds it. Where it
    is none, as in the log of a job that runs for hours, the standard error gets a line every half minute.
    """

    def __enter__(self) -> TerminalReporter:
        self._bar: Progress | None = None
        self._told = time.monotonic()
        return self

    def message(self, text: str) -> None:
        self._print(text, sys.stdout)

    def warn(self, text: str) -> None:
        self._print(f"warning: {text}", sys.stderr)

    def progress(self, share: float, text: str = "") -> None:
        if self._bar is None:
            self._bar = self._start()
        if self._bar is not None:
            (task,) = self._bar.task_ids
            self._bar.update(task, completed=share, description=text)
        elif time.monotonic() - self._told >= EVERY:
            self._told = time.monotonic()
            print(f"{share:4.0%} {text}".rstrip(), file=sys.stderr, flush=True)

    def _start(self) -> Progress | None:
        """The bar, with its one task; None where it would not be seen."""
        if not sys.stderr.isatty():
            return None
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

        columns = BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), TextColumn("{task.description}", markup=False)
        # The bar would else take what is printed to the standard output with it, which may be a file.
        bar = Progress(
            *columns, console=Console(stderr=True), transient=True, redirect_stdout=False, redirect_stderr=False
        )
        bar.add_task("", total=1.0)
        bar.start()
        return bar

    def _print(self, text: str, stream) -> None:
        if self._bar is not None and stream.isatty():
            # Above the bar, on the same terminal.
            self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            print(text, file=stream, flush=True)

    def __exit__(self, *error) -> None:
        if self._bar is not None:
            self._bar.stop()
