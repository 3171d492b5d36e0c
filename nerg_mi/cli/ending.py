"""How a command ends: done, with an error that is told in one sentence, or by Ctrl-C."""

from __future__ import annotations

import os
import signal
import sys
import threading

from nerg_mi.errors import expected, sentence

MENDABLE = 1
"""Exit code of what the user can mend."""

FAULT = 70
"""Exit code of a mistake in the program (EX_SOFTWARE of sysexits.h)."""

INTERRUPTED = 130
"""Exit code of what was ended by Ctrl-C (128 and the signal's number, as a shell has it)."""


def end_of(error: Exception) -> tuple[int, str]:
    """Exit code of ``error``, and what is said about it."""
    if expected(error):
        return MENDABLE, sentence(error)
    text = " ".join(str(error).split())
    return FAULT, (
        f"internal error ({type(error).__name__}{': ' + text if text else ''}): this is a fault of nerg_mi and not of "
        "your input; run again with --debug and report the traceback"
    )


def flush_output() -> None:
    """Write what is left for the standard output; where nobody reads it any more, the interpreter must not try
    again."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class CtrlC:
    """A context in which Ctrl-C raises `KeyboardInterrupt`, and that knows afterwards whether it ended a command."""

    def __enter__(self) -> CtrlC:
        self._heard = False
        # Only where Python's own handler is at work: elsewhere Ctrl-C is somebody else's business.
        self._mine = (
            threading.current_thread() is threading.main_thread()
            and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        )
        if self._mine:
            signal.signal(signal.SIGINT, self._hear)
        return self

    def _hear(self, *_) -> None:
        self._heard = True
        raise KeyboardInterrupt

    def behind(self, end: BaseException) -> KeyboardInterrupt | None:
        """The interrupt that led to ``end``; None where it is another error, or the command was done.

        Typer makes an exit with code 130 of it, which has it as its cause. Mitsuba makes an error of its own of it
        where it is raised in a plugin, with nothing but text.
        """
        link: BaseException | None = end
        while link is not None and not isinstance(link, KeyboardInterrupt):
            link = link.__cause__ or link.__context__
        done = isinstance(end, SystemExit) and not end.code
        return link if link is not None or not self._heard or done else KeyboardInterrupt()

    def __exit__(self, *_) -> None:
        if self._mine:
            signal.signal(signal.SIGINT, signal.default_int_handler)
