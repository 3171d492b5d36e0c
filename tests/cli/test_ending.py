"""How a command ends: its exit code, and what is said. `test_main` tries the same through the command."""

import io
import os
import signal
import subprocess
import sys
import time

import pytest

from nerg_mi.cli import main
from nerg_mi.cli.ending import FAULT, INTERRUPTED, USER_ERROR, CtrlC, end_of, open_streams, shorten_values
from nerg_mi.errors import NergError


def test_what_the_user_can_mend_and_what_not():
    assert end_of(NergError("write y")) == (USER_ERROR, "write y")
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


def test_ctrl_c_within_a_finalizer_is_not_lost(monkeypatch):
    """Python drops what is raised there."""

    class Interrupted:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    others = []
    monkeypatch.setattr(sys, "unraisablehook", others.append)
    thing = Interrupted()
    with CtrlC() as ctrl_c:
        with pytest.raises(KeyboardInterrupt):
            del thing
            time.sleep(10)
        assert not others
    assert ctrl_c.behind(RuntimeError()) is not None and sys.unraisablehook == others.append


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_output_that_nobody_reads_is_given_up(monkeypatch, name):
    read, write = os.pipe()
    os.close(read)
    stream = io.TextIOWrapper(os.fdopen(write, "wb"), encoding="utf-8")
    monkeypatch.setattr(sys, name, stream)
    monkeypatch.setattr(sys, f"__{name}__", stream)
    open_streams()
    for _ in range(2):
        print("a line", file=getattr(sys, name), flush=True)


def test_a_disk_that_is_full_is_told_once(monkeypatch):
    stream = open("/dev/full", "w", encoding="utf-8")
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(sys, "__stdout__", stream)
    open_streams()
    with pytest.raises(OSError, match="No space left"):
        print("a line", flush=True)
    sys.stdout.flush()


@pytest.mark.parametrize("closed", [">&-", ">&- 2>&-", "<&- >&- 2>&-", "| true"])
def test_a_command_without_standard_streams(closed):
    line = f'"{sys.executable}" -c "from nerg_mi.cli import main; main([\'--version\'])" {closed}'
    done = subprocess.run(["bash", "-o", "pipefail", "-c", line], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_ctrl_c_while_the_command_line_is_imported():
    child = """
import sys

class Interrupting:
    def find_spec(self, name, *_):
        if name == "typer":
            raise KeyboardInterrupt

sys.meta_path.insert(0, Interrupting())
import nerg_mi.cli
"""
    done = subprocess.run([sys.executable, "-c", child], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (INTERRUPTED, "Interrupted.\n")


@pytest.mark.parametrize("long", ["x" * 1500, "1 " * 750, "a" * 700 + "=" + "b" * 800, "it's " * 300, "z,9" * 500])
def test_messages_repeat_the_ends_of_long_values(capsys, long):
    with pytest.raises(SystemExit):
        main(["bake", "a.ply", "-o", "b.ply", "--observer", f"x{long}"])
    with pytest.raises(SystemExit):
        main(["bake", "a.ply", "-o", "b.ply", f"--{long}"])
    with pytest.raises(SystemExit):
        main([f"--{long}", "bake"])
    said = capsys.readouterr().err
    assert said.count("...") >= 3 and max(map(len, said.splitlines())) < 800
    assert shorten_values(f"got {long!r}; correct it", ["--up", long]).endswith("; correct it")
    assert shorten_values("got red", ["--up=red"]) == "got red"
