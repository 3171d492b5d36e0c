"""What a job tells, on the terminal: its messages, its warnings, and one bar for its progress, or lines in a log."""

from __future__ import annotations

import sys
import threading
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress

LOG_INTERVAL = 10.0
"""Seconds between two lines of progress where no terminal shows a bar."""

ESTIMATE_AFTER = 2.0
"""Seconds after which it is guessed how long the rest takes."""


class TerminalReporter:
    """A `nerg_mi.workflows.base.Reporter`, and a context that takes the bar away again.

    Messages go to the standard output and warnings to the standard error. The bar is on the standard error, from the
    first ``progress`` on and only where that is a terminal, so that neither a pipe nor a file ever holds it. Where it
    is none, as in the log of a job that runs for hours, the standard error gets a line every ten seconds, also while a
    long step tells nothing. What a job does not say itself is added: how many seconds are left, if the rest goes as
    fast as what is done; how long it has taken, where that cannot be guessed.
    """

    def __enter__(self) -> TerminalReporter:
        self._bar: Progress | None = None
        self._lock = threading.Lock()
        self._told = time.monotonic()
        self._begun: float | None = None
        self._counted = self._told
        self._now = (0.0, "")
        self._ended = threading.Event()
        self._pulse: threading.Thread | None = None
        return self

    def message(self, text: str) -> None:
        self._print(text, sys.stdout)

    def warn(self, text: str) -> None:
        self._print(f"warning: {text}", sys.stderr)

    def progress(self, share: float, text: str = "") -> None:
        if self._begun is None:
            self._begun = time.monotonic()
            self._bar = self._start()
            if self._bar is None:
                # What computes for minutes without a word is spoken for.
                self._pulse = threading.Thread(target=self._beat, name="progress", daemon=True)
                self._pulse.start()
        if share <= 0:
            # What is prepared is no measure of how fast the rest goes.
            self._counted = time.monotonic()
        self._now = (share, text)
        if self._bar is not None:
            (task,) = self._bar.task_ids
            self._bar.update(task, completed=share, description=self.line())
        else:
            self.log_when_due()

    def line(self) -> str:
        """What is being done, and how long the rest takes, or how long it has taken."""
        share, text = self._now
        elapsed = 0.0 if self._begun is None else time.monotonic() - self._begun
        if text.endswith(" left") or " left, " in text:
            return text
        counted = time.monotonic() - self._counted
        if share > 0.01 and counted >= ESTIMATE_AFTER:
            rest = f"{duration(counted * (1 - share) / share)} left"
        elif elapsed >= LOG_INTERVAL and self._bar is None:
            rest = f"{duration(elapsed)} so far"
        else:
            return text
        return f"{text}, {rest}" if text else rest

    def log_when_due(self) -> None:
        """A line of a log, if the last one is `EVERY` seconds ago."""
        with self._lock:
            if time.monotonic() - self._told < LOG_INTERVAL:
                return
            self._told = time.monotonic()
            print(f"{self._now[0]:4.0%} {self.line()}".rstrip(), file=sys.stderr, flush=True)

    def _beat(self) -> None:
        while not self._ended.wait(1.0):
            self.log_when_due()

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
        self._ended.set()
        if self._bar is not None:
            self._bar.stop()
        if self._pulse is not None:
            self._pulse.join()


def duration(seconds: float) -> str:
    """A time as one says it: 40 s, 12 min, 3.5 h."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
