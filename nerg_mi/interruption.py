"""Deferred handling of Ctrl-C, so that long computations stop in a consistent state."""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from typing import Any

from nerg_mi.errors import clean_text, parameter


class Interrupted(KeyboardInterrupt):
    """Ctrl-C ended a computation; the message says how to continue, and may mention parameters."""

    def __str__(self) -> str:
        return clean_text(super().__str__())


class TrainingInterrupted(Interrupted):
    """Ctrl-C ended a training before its last step.

    Attributes
    ----------
    field
        Field of the state so far.
    provenance : dict
        Its provenance.

    Parameters
    ----------
    state : Path, optional
        File from which the training can be resumed.
    """

    def __init__(self, field: Any, provenance: dict[str, Any], state: Path | None = None):
        message = f"interrupted; continue with {parameter('resume', True)} (state in {state})"
        if state is None:
            steps = provenance["steps"]
            message = f'interrupted after {steps} steps; the attribute "field" of this exception has the result so far'
        super().__init__(message)
        self.field, self.provenance = field, provenance


class Interruption:
    """A context that records Ctrl-C; ``check`` raises `KeyboardInterrupt`.

    An interrupt in the middle of a step would mix weights and random states of different steps, and kernels of Mitsuba
    and Dr.Jit would keep running. Code inside the context calls ``check`` after each step. A second Ctrl-C raises
    immediately.
    """

    def __enter__(self) -> Interruption:
        self.is_requested = False
        # Python handles signals in the main thread only. A handler that was not installed by Python cannot be restored.
        # An ignored signal, as in a background job of a shell, must stay ignored.
        is_main_thread = threading.current_thread() is threading.main_thread()
        self._is_installed = is_main_thread and signal.getsignal(signal.SIGINT) not in (None, signal.SIG_IGN)
        if self._is_installed:
            self._previous = signal.signal(signal.SIGINT, self._on_signal)
        return self

    def _on_signal(self, *_) -> None:
        if self.is_requested:
            raise KeyboardInterrupt
        self.is_requested = True

    def check(self) -> None:
        """Raise ``KeyboardInterrupt`` if Ctrl-C was pressed."""
        if self.is_requested:
            raise KeyboardInterrupt

    def __exit__(self, *error) -> None:
        if self._is_installed:
            signal.signal(signal.SIGINT, self._previous)


def restore_interrupt_handler() -> None:
    """Reinstall Python's handler of Ctrl-C after Mitsuba has replaced it.

    Mitsuba replaces the handler while it renders, and restores one saved handler afterwards. A Python integrator that
    calls ``render`` of its base class makes Mitsuba do this twice. The second call then saves Mitsuba's own handler,
    and Ctrl-C has no effect after the first image. A call of this function between the two makes the second one save
    Python's handler.
    """
    handler = signal.getsignal(signal.SIGINT)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, handler)
