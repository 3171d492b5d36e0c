"""Messages, warnings and progress of a workflow: on the terminal, as lines in a log, in a notebook, or as warnings."""

from __future__ import annotations

import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, runtime_checkable

from nerg_mi.errors import NergError, Spelling, clean_text, parameter, spell_python
from nerg_mi.files.html import element, markup

if TYPE_CHECKING:
    import rich.progress

# ---- Reporters ----


@runtime_checkable
class Reporter(Protocol):
    """Receives messages and progress of a workflow.

    Texts may mention parameters, which `nerg_mi.errors.clean_text` spells.

    Methods return immediately and do not raise, except that `progress` may raise `KeyboardInterrupt` to stop the
    workflow like Ctrl-C.
    """

    def message(self, text: str) -> None:
        """Report a result or a written file, in one line."""

    def warn(self, text: str) -> None:
        """Report a possible problem with the result, in one line."""

    def progress(self, fraction: float, text: str = "") -> None:
        """Report the completed fraction of the work, from 0 to 1, and the current step.

        A phase whose duration does not depend on the one before, such as scoring after training, begins at 0 again.
        """


class SilentReporter:
    """A reporter that ignores everything."""

    def message(self, text: str) -> None:
        pass

    def warn(self, text: str) -> None:
        pass

    def progress(self, fraction: float, text: str = "") -> None:
        pass


SILENT = SilentReporter()
"""The default reporter."""


LOG_INTERVAL = 10.0
"""Seconds between two lines of progress if there is no progress bar."""

ESTIMATE_AFTER = 2.0
"""Seconds after which the remaining time is estimated."""


class TerminalReporter:
    """A `Reporter` for the terminal, used as a context.

    Messages go to the standard output, and warnings to the standard error. The progress bar is on the standard error,
    if that is a terminal; pipes and files never contain it. Otherwise the standard error gets a line every ten seconds,
    also during a long step. The remaining time is added, extrapolated from the progress so far, or the elapsed time if
    that is not possible: before any progress, and in a step that has reported none for ten seconds, since an estimate
    would grow with the time that it takes. ``spelling`` spells the parameters that a text mentions.
    """

    def __init__(self, spelling: Spelling = spell_python) -> None:
        self._spelling = spelling

    def __enter__(self) -> TerminalReporter:
        self._bar: Any = None
        self._lock = threading.Lock()
        self._printed = time.monotonic()
        self._begun: float | None = None
        self._counted = self._advanced = self._printed
        self._now = (0.0, "")
        self._ended = threading.Event()
        self._pulse: threading.Thread | None = None
        return self

    def message(self, text: str) -> None:
        self._print(text, sys.stdout)

    def warn(self, text: str) -> None:
        self._print(f"warning: {text}", sys.stderr)

    def progress(self, fraction: float, text: str = "") -> None:
        if self._begun is None:
            self._begun = time.monotonic()
            self._bar = self._start()
            if self._bar is None:
                # Also reports during long steps without progress.
                self._pulse = threading.Thread(target=self._beat, name="progress", daemon=True)
                self._pulse.start()
        if fraction <= 0:
            # Preparation and earlier phases do not count for the extrapolation.
            self._counted = time.monotonic()
        if fraction != self._now[0]:
            self._advanced = time.monotonic()
        self._now = (fraction, text)
        if self._bar is not None:
            self._show(fraction)
        else:
            self.log_when_due()

    def _show(self, fraction: float) -> None:
        """Update the progress bar."""
        (task,) = self._bar.task_ids
        self._bar.update(task, completed=fraction, description=self.line())

    def line(self) -> str:
        """Return the current step with the remaining or elapsed time."""
        share, text = self._now[0], clean_text(self._now[1], self._spelling)
        elapsed = 0.0 if self._begun is None else time.monotonic() - self._begun
        if text.endswith(" left") or " left, " in text:
            return text
        counted, waiting = self._advanced - self._counted, time.monotonic() - self._advanced
        # At 1 the last step still runs, for a time that the fraction does not tell.
        if 0.01 < share < 1 and counted + waiting >= ESTIMATE_AFTER and waiting < LOG_INTERVAL:
            rest = f"{duration(max(0.0, counted * (1 - share) / share - waiting))} left"
        elif elapsed >= LOG_INTERVAL and self._bar is None:
            rest = f"{duration(elapsed)} so far"
        else:
            return text
        return f"{text}, {rest}" if text else rest

    def log_when_due(self) -> None:
        """Print a line to a log if the last one is `LOG_INTERVAL` seconds old."""
        with self._lock:
            if time.monotonic() - self._printed < LOG_INTERVAL:
                return
            self._printed = time.monotonic()
            print(f"{self._now[0]:4.0%} {self.line()}".rstrip(), file=sys.stderr, flush=True)

    def _beat(self) -> None:
        while not self._ended.wait(1.0):
            self.log_when_due()

    def _start(self) -> rich.progress.Progress | None:
        """Return the progress bar, with one task; None without a terminal."""
        if not sys.stderr.isatty():
            return None
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

        columns = BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), TextColumn("{task.description}", markup=False)
        # Otherwise the bar would also capture the standard output, which may be a file.
        bar = Progress(
            *columns, console=Console(stderr=True), transient=True, redirect_stdout=False, redirect_stderr=False
        )
        bar.add_task("", total=1.0)
        bar.start()
        return bar

    def _print(self, text: str, stream) -> None:
        text = clean_text(text, self._spelling)
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


class NotebookReporter(TerminalReporter):
    """A `TerminalReporter` that uses one output of the notebook cell: a progress bar, and then the messages, folded.

    A call of less than `SHORTEST` seconds without messages has no output. Warnings go to the standard error.
    """

    SHORTEST = 0.5

    def __enter__(self) -> NotebookReporter:
        super().__enter__()
        self._messages: list[str] = []
        self._shown = 0.0
        return self

    def progress(self, fraction: float, text: str = "") -> None:
        if self._bar is not None or time.monotonic() - self._counted >= self.SHORTEST or self._begun is not None:
            super().progress(fraction, text)

    def message(self, text: str) -> None:
        self._messages.append(clean_text(text, self._spelling))

    def _start(self) -> Any:
        module: Any = import_module("IPython.display")  # exists where there is a notebook
        self._make_html = module.HTML
        return module.display(self._make_html(""), display_id=True)

    def _show(self, fraction: float) -> None:
        now = time.monotonic()
        # Every update is a message to the browser.
        if now - self._shown < 0.2 and fraction < 1:
            return
        self._shown = now
        bar = element("progress", max=1, value=f"{fraction:.4f}")
        self._bar.update(self._make_html(markup([bar, f" {fraction:.0%} {self.line()}"])))

    def _print(self, text: str, stream) -> None:
        print(clean_text(text, self._spelling), file=stream, flush=True)

    def __exit__(self, *error) -> None:
        self._ended.set()
        lines = [[text, element("br")] for text in self._messages]
        content = element("details", element("summary", "Messages"), lines) if lines else ""
        if self._bar is None and content:
            self._bar = self._start()
        if self._bar is not None:
            self._bar.update(self._make_html(content))


class WarningReporter(SilentReporter):
    """A reporter that is silent except for warnings, which become those of Python (`warnings`)."""

    def __enter__(self) -> WarningReporter:
        return self

    def __exit__(self, *error) -> None:
        pass

    def warn(self, text: str) -> None:
        # Attributed to the code that called the library.
        level, frame = 1, sys._getframe()
        while frame.f_back is not None and str(frame.f_globals.get("__name__")).startswith("nerg_mi"):
            level, frame = level + 1, frame.f_back
        warnings.warn(clean_text(text), UserWarning, stacklevel=level)


def is_notebook() -> bool:
    """Return whether the code runs in a notebook, which shows HTML."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return shell is not None and hasattr(shell, "kernel")


def duration(seconds: float) -> str:
    """Format a duration: 40 s, 12 min, 3.5 h."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


# ---- Progress of a call ----


class SpellingReporter:
    """Passes on to a ``reporter`` of the caller what is reported, with parameters spelled as in Python."""

    def __init__(self, reporter: Reporter) -> None:
        self._reporter = reporter

    def message(self, text: str) -> None:
        self._reporter.message(clean_text(text))

    def warn(self, text: str) -> None:
        self._reporter.warn(clean_text(text))

    def progress(self, fraction: float, text: str = "") -> None:
        self._reporter.progress(fraction, clean_text(text))


Progress: TypeAlias = bool | Reporter | None
"""Argument of functions. None shows a progress bar in notebooks, True shows one anywhere, and False none. Warnings
become those of Python where there is no bar. A `Reporter` receives everything."""


@contextmanager
def open_reporter(progress: Progress) -> Iterator[Reporter]:
    """Yield the reporter of a call. Raises `NergError` for anything but a `Progress`."""
    # Reporters of this package spell what they show, that of a command as options.
    if isinstance(progress, (SilentReporter, TerminalReporter)):
        yield progress
        return
    # Protocols last: Python takes longer to compare with one than an image takes to render.
    if not (progress is None or isinstance(progress, bool)):
        if not isinstance(progress, Reporter):
            raise NergError(f"{parameter('progress')} must be True, False or a Reporter, got {type(progress).__name__}")
        yield SpellingReporter(progress)
        return
    shows = is_notebook() if progress is None else progress
    with WarningReporter() if not shows else NotebookReporter() if is_notebook() else TerminalReporter() as reporter:
        yield reporter
