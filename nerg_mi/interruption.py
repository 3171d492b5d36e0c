"""Ctrl-C between the steps of long work, so that what is being computed stays consistent."""

from __future__ import annotations

import signal
import threading


class Interruption:
    """A context in which Ctrl-C is noted, and raised by ``check``.

    In the middle of a step it would leave weights and random numbers of different steps, and Mitsuba and Dr.Jit would
    carry on with what they have begun. Whoever works inside calls ``check`` after every step. The second Ctrl-C is
    raised at once.
    """

    def __enter__(self) -> Interruption:
        self.is_requested = False
        # Signals can only be dealt with in the main thread; a handler that is not Python's could not be put back; and
        # where the signal is ignored, as for what a script runs in the background, it is meant for somebody else.
        main = threading.current_thread() is threading.main_thread()
        self._mine = main and signal.getsignal(signal.SIGINT) not in (None, signal.SIG_IGN)
        if self._mine:
            self._before = signal.signal(signal.SIGINT, self._note)
        return self

    def _note(self, *_) -> None:
        if self.is_requested:
            raise KeyboardInterrupt
        self.is_requested = True

    def check(self) -> None:
        """Raise ``KeyboardInterrupt`` if there was one."""
        if self.is_requested:
            raise KeyboardInterrupt

    def __exit__(self, *error) -> None:
        if self._mine:
            signal.signal(signal.SIGINT, self._before)


def restore_interrupt_handler() -> None:
    """Let Python hear Ctrl-C again, where Mitsuba has taken it.

    Mitsuba takes the signal while a picture is rendered and remembers one handler to put back. An integrator in Python
    that calls the render of its base class makes it do so twice, and the second time it remembers its own: from the
    first picture on nobody would hear Ctrl-C. Called between the two, this makes the second one remember Python's.
    """
    handler = signal.getsignal(signal.SIGINT)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, handler)
