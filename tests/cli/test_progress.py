"""What a job tells, on a terminal and elsewhere."""

import io
import sys

import pytest

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


class Clock:
    """A clock that moves when it is told to."""

    def __init__(self, monkeypatch):
        self.now = 1000.0
        monkeypatch.setattr(progress.time, "monotonic", lambda: self.now)
        # The beat of a real second would read this clock at any moment; the tests beat themselves.
        monkeypatch.setattr(TerminalReporter, "_beat", lambda self: None)


def test_a_log_gets_a_line_every_ten_seconds(capsys, monkeypatch):
    clock = Clock(monkeypatch)
    with TerminalReporter() as reporter:
        for second in range(35):
            clock.now = 1000.0 + second
            reporter.progress(second / 100, f"{100 - second} s left, held out 21.30 dB")
    lines = [f"{k:4.0%} {100 - int(100 * k)} s left, held out 21.30 dB" for k in (0.1, 0.2, 0.3)]
    assert capsys.readouterr() == ("", "\n".join(lines) + "\n")


def test_what_a_job_does_not_say_is_added(capsys, monkeypatch):
    clock = Clock(monkeypatch)
    with TerminalReporter() as reporter:
        reporter.progress(0.0, "reading")
        clock.now += 20
        reporter.tell_when_due()
        clock.now += 20
        reporter.progress(0.25, "scores")
        clock.now += 200
        reporter.progress(0.25, "scores")
    # A quarter took 40 s, so that the rest takes 120; then 240 s, so that it takes twelve minutes.
    said = ["  0% reading, 20 s so far", " 25% scores, 2 min left", " 25% scores, 12 min left"]
    assert capsys.readouterr().err.splitlines() == said


def test_what_is_prepared_is_no_measure_of_the_rest(capsys, monkeypatch):
    clock = Clock(monkeypatch)
    with TerminalReporter() as reporter:
        reporter.progress(0.0, "reading")
        clock.now += 9
        reporter.progress(0.0, "preparing")
        clock.now += 9
        reporter.progress(0.1, "steps")
    assert capsys.readouterr().err.splitlines() == [" 10% steps, 81 s left"]


def test_a_long_step_that_tells_nothing_is_spoken_for(capsys, monkeypatch):
    monkeypatch.setattr(progress, "EVERY", 0.2)
    with TerminalReporter() as reporter:
        reporter.progress(0.5, "integrating")
        assert reporter._pulse is not None
        reporter._ended.wait(2.5)
    said = capsys.readouterr().err
    assert " 50% integrating" in said
    assert not reporter._pulse.is_alive()


def test_the_bar_says_how_long_the_rest_takes(monkeypatch):
    clock = Clock(monkeypatch)
    _, err = replace_streams(monkeypatch)
    with TerminalReporter() as reporter:
        reporter.progress(0.1, "views")
        clock.now += 10
        reporter.progress(0.5, "views")
        assert reporter.line() == "views, 10 s left" and reporter._pulse is None
    assert "views, 10 s left" in err.getvalue()


@pytest.mark.parametrize(
    "seconds, said", [(0.4, "0 s"), (119, "119 s"), (120, "2 min"), (7199, "120 min"), (9000, "2.5 h")]
)
def test_durations(seconds, said):
    assert progress.duration(seconds) == said
