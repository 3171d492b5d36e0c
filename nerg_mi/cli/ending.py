"""How a command ends: done, with an error that is told in one sentence, or by Ctrl-C."""

from __future__ import annotations

import io
import os
import re
import signal
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from nerg_mi.errors import is_user_error, format_error

if TYPE_CHECKING:
    from typing_extensions import Buffer

USER_ERROR = 1
"""Exit code of an error that the user can correct."""

INTERNAL_ERROR = 70
"""Exit code of a mistake in the program (EX_SOFTWARE of sysexits.h)."""

INTERRUPTED = 130
"""Exit code of what was ended by Ctrl-C (128 and the signal's number, as a shell has it)."""


MAX_ECHOED = 300
"""Characters of a value on the command line that a message repeats."""


def shorten_values(text: str, arguments: Iterable[str]) -> str:
    """``text`` with the middle left out of what it repeats of ``arguments``, values and parts of lists, beyond
    `ECHOED` characters."""
    parts = {part for argument in arguments if len(argument) > MAX_ECHOED for part in _SEPARATORS.split(argument)}
    values = {argument.partition("=")[2] for argument in arguments} | set(arguments) | parts
    for value in sorted(values, key=len, reverse=True):
        for spelt in (value, repr(value)[1:-1]):
            if len(spelt) > MAX_ECHOED:
                text = text.replace(spelt, f"{spelt[: MAX_ECHOED // 2]}...{spelt[-MAX_ECHOED // 6 :]}")
    return text


def exit_code(error: Exception) -> tuple[int, str]:
    """Exit code of ``error``, and what is said about it."""
    if is_user_error(error):
        return USER_ERROR, format_error(error)
    text = " ".join(str(error).split())
    return INTERNAL_ERROR, (
        f"internal error ({type(error).__name__}{': ' + text if text else ''}): this is a fault of nerg_mi and not of "
        "your input; run again with --debug and report the traceback"
    )


_SEPARATORS = re.compile(r"[=,;\s]")


def open_streams() -> None:
    """Make the standard streams safe to print to, whatever they lead to.

    One that is closed (``nerg ... >&-``) leads to nothing: else an output file could get its number, and what is
    printed would be written into it. A command goes on, and says nothing, where nobody reads its output any more
    (``nerg ... | head -1``). A disk that is full is an `OSError`, once.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            # The lowest free number, which is that of the stream.
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), "w" if number else "r", encoding="utf-8"))
        elif number and stream is getattr(sys, f"__{name}__"):
            stream.flush()
            raw = io.BufferedWriter(_Output(stream.fileno(), "w", closefd=False))
            like = {key: getattr(stream, key) for key in ("encoding", "errors", "line_buffering")}
            setattr(sys, name, io.TextIOWrapper(raw, **like))


class _Output(io.FileIO):
    def write(self, data: Buffer, /) -> int | None:
        try:
            return super().write(data)
        except OSError as error:
            # Also for what is left in buffers, which the interpreter writes at its end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
            if isinstance(error, BrokenPipeError):
                return memoryview(data).nbytes
            raise


@contextmanager
def quiet_ctrl_c() -> Iterator[None]:
    """A block of imports, before a command runs: Ctrl-C ends the process as it ends a command."""
    try:
        yield
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        sys.exit(INTERRUPTED)


_AGAIN = 0.02  # seconds


class CtrlC:
    """A context in which Ctrl-C raises `KeyboardInterrupt`, and that knows afterwards whether it ended a command.

    Python drops an exception that is raised in a finalizer or in the callback of a weak reference: such a Ctrl-C is
    sent again.
    """

    def __enter__(self) -> CtrlC:
        self._heard = False
        self._report_unraisable, sys.unraisablehook = sys.unraisablehook, self._send_again
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

    def _send_again(self, unraisable: sys.UnraisableHookArgs, /) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            # From another thread and later: here it would be dropped as well.
            threading.Timer(_AGAIN, os.kill, (os.getpid(), signal.SIGINT)).start()
        else:
            self._report_unraisable(unraisable)

    def find_interrupt(self, end: BaseException) -> KeyboardInterrupt | None:
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
        sys.unraisablehook = self._report_unraisable
        if self._mine:
            signal.signal(signal.SIGINT, signal.default_int_handler)
