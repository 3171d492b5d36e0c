"""The end of a command, including Ctrl-C, and its messages."""

import io
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nerg_mi import progress
from nerg_mi.cli import main
from nerg_mi.cli.ending import INTERNAL_ERROR, INTERRUPTED, USER_ERROR, CtrlC, exit_code, open_streams, shorten_values
from nerg_mi.errors import NergError
from nerg_mi.formats.checkpoint import read_checkpoint
from nerg_mi.progress import TerminalReporter
from tools.faults import is_partial, read_whole


def test_user_errors_and_internal_errors_have_exit_codes():
    assert exit_code(NergError("write y")) == (USER_ERROR, "write y")
    code, text = exit_code(KeyError("x"))
    assert code == INTERNAL_ERROR and text.startswith("internal error (KeyError: 'x')")


def test_ctrl_c_is_detected_behind_another_exception():
    with CtrlC() as ctrl_c:
        assert ctrl_c.find_interrupt(ValueError("x")) is None
        with pytest.raises(RuntimeError) as raised:
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt as error:
                raise RuntimeError("of Mitsuba") from error
        assert isinstance(ctrl_c.find_interrupt(raised.value), KeyboardInterrupt)
        # The same holds if only its text remains; a command that has finished stays finished.
        assert isinstance(ctrl_c.find_interrupt(RuntimeError("of Mitsuba")), KeyboardInterrupt)
        assert ctrl_c.find_interrupt(SystemExit(0)) is None
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_within_a_finalizer_is_not_lost(monkeypatch):
    """Python ignores exceptions that are raised there."""

    class Interrupted:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    unraisable = []
    monkeypatch.setattr(sys, "unraisablehook", unraisable.append)
    instance = Interrupted()
    with CtrlC() as ctrl_c:
        with pytest.raises(KeyboardInterrupt):
            del instance
            time.sleep(10)
        assert not unraisable
    assert ctrl_c.find_interrupt(RuntimeError()) is not None and sys.unraisablehook == unraisable.append


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_a_closed_pipe_ends_the_output(monkeypatch, name):
    read, write = os.pipe()
    os.close(read)
    stream = io.TextIOWrapper(os.fdopen(write, "wb"), encoding="utf-8")
    monkeypatch.setattr(sys, name, stream)
    monkeypatch.setattr(sys, f"__{name}__", stream)
    open_streams()
    for _ in range(2):
        print("a line", file=getattr(sys, name), flush=True)


def test_a_full_disk_is_reported_once(monkeypatch):
    stream = open("/dev/full", "w", encoding="utf-8")
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(sys, "__stdout__", stream)
    open_streams()
    with pytest.raises(OSError, match="No space left"):
        print("a line", flush=True)
    sys.stdout.flush()


@pytest.mark.parametrize("closed", [">&-", ">&- 2>&-", "<&- >&- 2>&-", "| true"])
def test_a_command_runs_without_standard_streams(closed):
    line = f'"{sys.executable}" -c "from nerg_mi.cli import main; main([\'--version\'])" {closed}'
    done = subprocess.run(["bash", "-o", "pipefail", "-c", line], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_ctrl_c_during_the_import_is_handled():
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


@pytest.mark.parametrize("spelt", [["--thin", "1,5"], ["--thin=1,5"]])
def test_invalid_values_are_named(capsys, spelt):
    with pytest.raises(SystemExit):
        main(["rays", "filter", "a.npz", "-o", "b.npz", *spelt])
    assert "--thin" in (said := capsys.readouterr().err) and 'got "1,5"' in said


@pytest.mark.parametrize("long", ["x" * 1500, "1 " * 750, "a" * 700 + "=" + "b" * 800, "it's " * 300, "z,9" * 500])
def test_messages_abbreviate_long_values(capsys, long):
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


# ---- Messages of a job, on a terminal and elsewhere ----


class Terminal(io.StringIO):
    def isatty(self):
        return True


def replace_streams(monkeypatch):
    """Replace standard output and error; only standard error is a terminal."""
    out, err = io.StringIO(), Terminal()
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", err)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    return out, err


def test_the_bar_is_on_the_terminal_and_messages_are_in_the_pipe(monkeypatch):
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
    # The line of the progress bar is erased at the end.
    assert "\x1b[2K" in shown


def test_without_a_terminal_only_messages_are_printed(capsys):
    with TerminalReporter() as reporter:
        reporter.progress(0.5, "half")
        reporter.message("done")
        reporter.warn("thin")
    assert capsys.readouterr() == ("done\n", "warning: thin\n")


class Clock:
    """A clock that the test advances."""

    def __init__(self, monkeypatch):
        self.now = 1000.0
        monkeypatch.setattr(progress.time, "monotonic", lambda: self.now)
        # A real timer would read this clock at any moment, so the tests trigger updates themselves.
        monkeypatch.setattr(TerminalReporter, "_beat", lambda self: None)


def test_a_log_gets_a_line_every_ten_seconds(capsys, monkeypatch):
    clock = Clock(monkeypatch)
    with TerminalReporter() as reporter:
        for second in range(35):
            clock.now = 1000.0 + second
            reporter.progress(second / 100, f"{100 - second} s left, held out 21.30 dB")
    lines = [f"{k:4.0%} {100 - int(100 * k)} s left, held out 21.30 dB" for k in (0.1, 0.2, 0.3)]
    assert capsys.readouterr() == ("", "\n".join(lines) + "\n")


def test_progress_adds_elapsed_and_remaining_time(capsys, monkeypatch):
    clock = Clock(monkeypatch)
    with TerminalReporter() as reporter:
        reporter.progress(0.0, "reading")
        clock.now += 20
        reporter.log_when_due()
        clock.now += 20
        reporter.progress(0.25, "scores")
    # A quarter took 40 s, so the rest takes 120 s.
    said = ["  0% reading, 20 s so far", " 25% scores, 2 min left"]
    assert capsys.readouterr().err.splitlines() == said


def test_the_remaining_time_never_grows_within_a_step(capsys, monkeypatch):
    clock = Clock(monkeypatch)
    with TerminalReporter() as reporter:
        reporter.progress(0.0, "reading")
        clock.now += 40
        reporter.progress(0.25, "scores")
        remaining = [reporter.line()]
        for _ in range(3):
            clock.now += 3
            remaining.append(reporter.line())
        clock.now += 200
        reporter.progress(0.25, "scores")
    assert remaining == ["scores, 2 min left", "scores, 117 s left", "scores, 114 s left", "scores, 111 s left"]
    assert capsys.readouterr().err.splitlines()[-1] == " 25% scores, 4 min so far"


def test_preparation_does_not_affect_the_time_estimate(capsys, monkeypatch):
    clock = Clock(monkeypatch)
    with TerminalReporter() as reporter:
        reporter.progress(0.0, "reading")
        clock.now += 9
        reporter.progress(0.0, "preparing")
        clock.now += 9
        reporter.progress(0.1, "steps")
    assert capsys.readouterr().err.splitlines() == [" 10% steps, 81 s left"]


def test_a_phase_has_an_estimate_of_its_own(capsys, monkeypatch):
    """A finished phase that still works has no remaining time, and the next phase begins at 0."""
    clock = Clock(monkeypatch)
    with TerminalReporter() as reporter:
        reporter.progress(0.0, "training")
        clock.now += 20
        reporter.progress(1.0, "training")
        reporter.progress(0.0, "scoring")
        clock.now += 30
        reporter.progress(0.5, "scoring")
    first, last = capsys.readouterr().err.splitlines()
    assert "left" not in first and last.endswith("scoring, 30 s left")


def test_a_long_silent_step_is_reported(capsys, monkeypatch):
    monkeypatch.setattr(progress, "LOG_INTERVAL", 0.2)
    with TerminalReporter() as reporter:
        reporter.progress(0.5, "integrating")
        assert reporter._pulse is not None
        reporter._ended.wait(2.5)
    said = capsys.readouterr().err
    assert " 50% integrating" in said
    assert not reporter._pulse.is_alive()


def test_the_bar_shows_the_remaining_time(monkeypatch):
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


# ---- Ctrl-C in a process of its own: exit code 130, outputs complete or absent, trainings resumable ----

_CHILD = """
import os, pkgutil, signal, sys
import nerg_mi.cli
name, calls, *arguments = sys.argv[1:]
owner, _, function = name.rpartition(".")
owner = pkgutil.resolve_name(owner)
original, left = getattr(owner, function), int(calls)

def interrupted(*args, **kwargs):
    global left
    left -= 1
    if left == 0:
        os.kill(os.getpid(), getattr(signal, os.environ.get("SENT_SIGNAL", "SIGINT")))
    return original(*args, **kwargs)

setattr(owner, function, interrupted)
nerg_mi.cli.main(arguments)
"""


def interrupted(name: str, calls: int, *arguments, sent: str = "SIGINT") -> subprocess.CompletedProcess:
    """`nerg` in a process that gets a signal at a given call of a function."""
    command = [sys.executable, "-c", _CHILD, f"nerg_mi.{name}", str(calls), *map(str, arguments)]
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONPATH": os.getcwd(), "SENT_SIGNAL": sent},
    )


ENDLESS = "--steps 1000000"
GAZE = "--environment none --radius 0.6 --min-rays 8"


# A radiance training makes and discards these steps before its first one.
WARM_UP = 5


def test_an_interrupted_gaze_training_saves_state_and_result(inputs, tmp_path):
    line = f"train gaze {inputs}/rays.npz -o {tmp_path}/a.safetensors {GAZE} --variant capture {ENDLESS}"
    done = interrupted("train.gaze_log_density.LikelihoodTrainer.step", 4, *line.split())
    assert done.returncode == 130 and "--resume" in done.stderr, done.stderr
    assert sorted(os.listdir(tmp_path)) == ["a.run", "a.safetensors"]
    # The step in which the signal arrived is completed.
    assert read_checkpoint(tmp_path / "a.run", "gaze run")[1]["steps"] == 4
    assert read_checkpoint(tmp_path / "a.safetensors", "gaze")[1]["provenance"]["interrupted"]


def test_a_gaze_training_interrupted_before_variant_selection_saves_nothing(inputs, tmp_path):
    line = f"train gaze {inputs}/rays.npz -o {tmp_path}/a.safetensors {GAZE} {ENDLESS}"
    done = interrupted("train.gaze_log_density.LikelihoodTrainer.step", 4, *line.split())
    assert done.returncode == 130 and "no state was saved" in done.stderr and "--resume" not in done.stderr, done.stderr
    assert not os.listdir(tmp_path)


def test_an_interrupted_radiance_training_saves_state_and_result(inputs, tmp_path):
    line = f"train radiance {inputs}/photos -o {tmp_path}/a.safetensors {ENDLESS}"
    done = interrupted("train.radiance_trainer.RadianceTrainer.step", WARM_UP + 4, *line.split())
    assert done.returncode == 130 and "--resume" in done.stderr, done.stderr
    curves = ["a.curves.csv", "a.curves.png"]
    assert sorted(os.listdir(tmp_path)) == [*curves, "a.preview.png", "a.run", "a.safetensors"]
    assert read_checkpoint(tmp_path / "a.run", "radiance run")[1]["steps"] == 4
    assert read_checkpoint(tmp_path / "a.safetensors", "radiance")[1]["provenance"]["interrupted"]


def test_an_interrupted_ensemble_saves_members_and_state(inputs, tmp_path):
    some = "--variant capture --steps 3 --ensemble 2"
    line = f"train gaze {inputs}/rays.npz -o {tmp_path}/a.safetensors {GAZE} {some}"
    done = interrupted("train.gaze_log_density.LikelihoodTrainer.step", 5, *line.split())
    assert done.returncode == 130 and "member 2 of 2; resume with --resume" in done.stderr, done.stderr
    assert sorted(os.listdir(tmp_path)) == ["a.member0.safetensors", "a.run"]


ENDS = {
    "eval": (
        "evaluation.metrics.FieldRenderer.__call__",
        2,
        "eval radiance {i}/field.safetensors {i}/photos --holdout 2 -o {o}",
    ),
    "study": (
        "evaluation.study.measure_rows",
        1,
        "study slab -o {o} --quick --width 12 --height 8 --only jitter -m llvm_ad_rgb",
    ),
    "rays import": (
        "tracking.readers.table.add_tables",
        1,
        "rays import {i}/day.csv -o {o}/a.npz --map 'origin=x,y,z direction=a,b,c t=t person=p'",
    ),
    "export": (
        "fields.extraction.FieldSampler.density_on",
        1,
        "export points {i}/field.safetensors -o {o}/a.ply --resolution 16",
    ),
}
"""Function during whose so-many-th call Ctrl-C comes, and the command line with its folders of inputs and outputs."""


@pytest.mark.parametrize("name", ENDS)
def test_an_interrupted_command_exits_immediately(name, inputs, tmp_path):
    function, calls, line = ENDS[name]
    done = interrupted(function, calls, *shlex.split(line.format(i=inputs, o=tmp_path / "out")))
    assert done.returncode == 130 and "Interrupted." in done.stderr and "Traceback" not in done.stderr, done.stderr
    written_files = sorted(p.name for p in tmp_path.rglob("*") if p.is_file())
    assert written_files == (["0.png"] if name == "eval" else [])


KILLED = {
    "bake": "bake {i}/room.ply --rays {i}/rays.npz --max-edge 2 -m llvm_ad_rgb -o {o}/a.ply -o {o}/a.csv -o {o}/a.json",
    "report": "report {i}/gaze.safetensors {i}/rays.npz -o {o}/a.html --width 24 -m llvm_ad_rgb",
}
"""Command lines. Each output is synchronised by `os.fsync`, and then moved to its place by `os.replace`."""


@pytest.mark.nightly
@pytest.mark.parametrize("function", ["files.atomic.os.fsync", "files.atomic.os.replace"])
@pytest.mark.parametrize("name, call", [("bake", 1), ("bake", 2), ("bake", 3), ("report", 1)])
def test_a_killed_command_leaves_outputs_complete_or_as_they_were(name, call, function, inputs, tmp_path):
    line = KILLED[name].format(i=inputs, o=tmp_path)
    outputs = [Path(word) for word in line.split() if word.startswith(str(tmp_path))]
    for path in outputs:
        path.write_text("earlier")
    done = interrupted(function, call, *shlex.split(line), sent="SIGKILL")
    assert done.returncode == -signal.SIGKILL, done.stderr
    changed = [path for path in outputs if path.read_bytes() != b"earlier"]
    assert len(changed) < len(outputs)
    for path in changed:
        read_whole(path)
    others = set(tmp_path.iterdir()) - set(outputs)
    assert all(is_partial(path) or path.suffix == ".lock" for path in others), others
    # The next start is not disturbed by what is left.
    done = subprocess.run(
        [sys.executable, "-c", "from nerg_mi.cli import main; main()", *shlex.split(line)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    for path in outputs:
        assert path.read_bytes() != b"earlier"
        read_whole(path)
