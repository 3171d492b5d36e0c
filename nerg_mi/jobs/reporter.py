"""Whom a job tells how it goes: a command's terminal, a notebook, or nobody."""

from __future__ import annotations

from typing import Protocol


class Reporter(Protocol):
    """Listens to a job. Each method returns at once and raises nothing, but for `KeyboardInterrupt` in `progress`,
    which ends the job as Ctrl-C does."""

    def message(self, text: str) -> None:
        """A line about what was found or written."""

    def warn(self, text: str) -> None:
        """A line about what may be wrong with the result."""

    def progress(self, share: float, text: str = "") -> None:
        """How much of the work is done, from 0 to 1, and what is being done."""


class Silent:
    """Listens to nothing."""

    def message(self, text: str) -> None:
        pass

    def warn(self, text: str) -> None:
        pass

    def progress(self, share: float, text: str = "") -> None:
        pass


SILENT = Silent()
"""The reporter of jobs that were given none."""
