"""What a job tells, on a terminal and elsewhere."""

import io
import sys

from nerg_mi.cli import progress
from nerg_mi.cli.progress import TerminalReporter


class Terminal(io.StringIO):
    def isatty(self):
        return True


def replace_streams(monkeypatch):
    """Another standard output and error, of which only the latter is a terminal."""
    out, err = io.StringIO(), Terminal()
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", err)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    return out, err


def test_the_bar_is_on_the_terminal_and_messages_are_where_they_are_piped(monkeypatch):
    out, err = replace_streams(monkeypatch)
    with TerminalReporter() as reporter:
        reporter.message("[before]")
        assert err.getvalue() == ""
        reporter.progress(0.25, "3 s left")
        reporter.message("a line with [brackets] of " + 40 * "words ")
        reporter.warn("thin")
        reporter.progress(0.5, "2 s left [x]")
    shown = err.getvalue()
    assert out.getvalue() == "[before]\na line with [brackets] of " + 40 * "words " + "\n"
    assert "50%" in shown and "2 s left [x]" in shown and "warning: thin" in shown
    # The bar is taken away again: its line is erased.
    assert "\x1b[2K" in shown


def test_nothing_but_messages_where_there_is_no_terminal(capsys):
    with TerminalReporter() as reporter:
        reporter.progress(0.5, "half")
        reporter.message("done")
        reporter.warn("thin")
    assert capsys.readouterr() == ("done\n", "warning: thin\n")


def test_a_log_gets_a_line_every_half_minute(capsys, monkeypatch):
    now = 1000.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    with TerminalReporter() as reporter:
        for second in range(95):
            now = 1000.0 + second
            reporter.progress(second / 100, f"{100 - second} s left, held out 21.30 dB")
    lines = [f"{k:4.0%} {100 - int(100 * k)} s left, held out 21.30 dB" for k in (0.3, 0.6, 0.9)]
    assert capsys.readouterr() == ("", "\n".join(lines) + "\n")
