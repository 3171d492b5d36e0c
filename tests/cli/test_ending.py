"""How a command ends: its exit code, and what is said. `test_main` tries the same through the command."""

import io
import os
import signal
import sys

import pytest

from nerg_mi.cli.ending import FAULT, MENDABLE, CtrlC, end_of, flush_output
from nerg_mi.errors import NergError


def test_what_the_user_can_mend_and_what_not():
    assert end_of(NergError("write y")) == (MENDABLE, "write y")
    code, text = end_of(KeyError("x"))
    assert code == FAULT and text.startswith("internal error (KeyError: 'x')")


def test_ctrl_c_is_found_behind_what_others_made_of_it():
    with CtrlC() as ctrl_c:
        assert ctrl_c.behind(ValueError("x")) is None
        with pytest.raises(RuntimeError) as raised:
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt as error:
                raise RuntimeError("of Mitsuba") from error
        assert isinstance(ctrl_c.behind(raised.value), KeyboardInterrupt)
        # Also where only the text is left of it; but a command that was done is done.
        assert isinstance(ctrl_c.behind(RuntimeError("of Mitsuba")), KeyboardInterrupt)
        assert ctrl_c.behind(SystemExit(0)) is None
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_output_that_nobody_reads_is_given_up(monkeypatch):
    read, write = os.pipe()
    os.close(read)
    stream = io.TextIOWrapper(os.fdopen(write, "wb"), write_through=False)
    monkeypatch.setattr(sys, "stdout", stream)
    stream.write("a line\n")
    flush_output()
    stream.flush()
    stream.close()
