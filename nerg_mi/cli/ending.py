"""The end of a command: success, an error that is reported in one sentence, or Ctrl-C."""

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

from nerg_mi.errors import format_error, is_user_error

if TYPE_CHECKING:
    from typing_extensions import Buffer

USER_ERROR = 1
"""Exit code of an error that the user can correct."""

INTERNAL_ERROR = 70
"""Exit code of a bug in the program (EX_SOFTWARE of sysexits.h)."""

INTERRUPTED = 130
"""Exit code after Ctrl-C (128 plus the number of the signal, as in a shell)."""


MAX_ECHOED = 300
"""Maximum number of characters of a command-line value in a message."""


def shorten_values(text: str, arguments: Iterable[str]) -> str:
    """Shorten values of ``arguments``, and parts of lists, in ``text`` to `MAX_ECHOED` characters."""
    parts = {part for argument in arguments if len(argument) > MAX_ECHOED for part in _SEPARATORS.split(argument)}
    values = {argument.partition("=")[2] for argument in arguments} | set(arguments) | parts
    for value in sorted(values, key=len, reverse=True):
        for spelt in (value, repr(value)[1:-1]):
            if len(spelt) > MAX_ECHOED:
                text = text.replace(spelt, f"{spelt[: MAX_ECHOED // 2]}...{spelt[-MAX_ECHOED // 6 :]}")
    return text


def exit_code(error: Exception) -> tuple[int, str]:
    """Return the exit code of ``error`` and the message about it."""
    if is_user_error(error):
        return USER_ERROR, format_error(error)
    text = " ".join(str(error).split())
    return INTERNAL_ERROR, (
        f"internal error ({type(error).__name__}{': ' + text if text else ''}): this is a bug in nerg_mi, not in "
        "your input; run the command again with --debug and report the traceback"
    )


_SEPARATORS = re.compile(r"[=,;\s]")


def open_streams() -> None:
    """Make the standard streams safe to use in all cases.

    A closed stream (``nerg ... >&-``) is replaced by the null device; otherwise an output file could get its file
    descriptor and receive the messages. If the reader closes a pipe (``nerg ... | head -1``), the command continues
    silently. A full disk raises `OSError` once.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            # The lowest free descriptor, which is that of the stream.
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
            # Also for buffered data, which the interpreter writes at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
            if isinstance(error, BrokenPipeError):
                return memoryview(data).nbytes
            raise


@contextmanager
def quiet_ctrl_c() -> Iterator[None]:
    """Within this block of imports, Ctrl-C ends the process as it ends a command."""
    try:
        yield
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        sys.exit(INTERRUPTED)


_AGAIN = 0.02  # seconds


class CtrlC:
    """Context in which Ctrl-C raises `KeyboardInterrupt`, and that finds out afterwards whether it ended a command.

    Python discards exceptions in finalizers and callbacks of weak references; such a Ctrl-C is sent again.
    """

    def __enter__(self) -> CtrlC:
        self._heard = False
        self._report_unraisable, sys.unraisablehook = sys.unraisablehook, self._send_again
        # Only if Python's default handler is active: others handle Ctrl-C themselves.
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
            # From another thread and later, because here it would be discarded again.
            threading.Timer(_AGAIN, os.kill, (os.getpid(), signal.SIGINT)).start()
        else:
            self._report_unraisable(unraisable)

    def find_interrupt(self, end: BaseException) -> KeyboardInterrupt | None:
        """Return the interrupt that caused ``end``; None if it was another error, or if the command finished.

        Typer converts it to an exit with code 130, with the interrupt as its cause. Mitsuba converts it to an error
        with text only, if it is raised in a plugin.
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
