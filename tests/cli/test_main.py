"""The frame of the command: what it lists, what it imports, and how it fails."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import nerg_mi.cli
from nerg_mi.errors import NergError, sentence

HEAVY = {"mitsuba", "drjit", "numpy", "scipy", "matplotlib", "torch", "trimesh", "OpenEXR"}


def nerg(*arguments, after=""):
    code = f"import sys; sys.argv[1:] = {list(arguments)!r}\nfrom nerg_command import main\ntry: main()\nfinally:\n    {after or 'pass'}"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)


def test01_help_lists_every_command():
    done = nerg("--help")
    assert done.returncode == 0
    for name, line in nerg_mi.cli.COMMANDS.items():
        assert re.search(rf"^\s+{name}\s+{re.escape(line[:30])}", done.stdout, re.M), name


def test02_help_imports_nothing_heavy():
    done = nerg("--help", after="print('loaded:', *sys.modules)")
    loaded = set(done.stdout.partition("loaded:")[2].split())
    assert "nerg_mi.cli" in loaded and not HEAVY & loaded
    assert not {f"nerg_mi.cli.{name}" for name in nerg_mi.cli.COMMANDS} & loaded


@pytest.mark.parametrize("name", nerg_mi.cli.COMMANDS)
def test03_each_command_has_a_file_and_help(name):
    assert (Path(nerg_mi.cli.__file__).parent / f"{name}.py").is_file()
    done = nerg(name, "--help", after="print('loaded:', *sys.modules)")
    assert done.returncode == 0, done.stderr
    assert not {"mitsuba", "torch"} & set(done.stdout.partition("loaded:")[2].split())


def test04_wrong_command_line():
    assert nerg("no-such-command").returncode == 2
    assert nerg("render", "scene.xml").returncode == 2  # -o is missing


def failing(monkeypatch, error):
    def command():
        raise error

    module = type(sys)("nerg_mi.cli.doctor")
    module.command = command
    monkeypatch.setitem(sys.modules, "nerg_mi.cli.doctor", module)


@pytest.mark.parametrize(
    "error, said",
    [
        (NergError('there is no "x": write "y".'), 'nerg: there is no "x": write "y".'),
        (FileNotFoundError(2, "No such file", "a.xml"), 'nerg: there is no file "a.xml".'),
        (ImportError("LLVM 15 cannot run."), "nerg: LLVM 15 cannot run."),
    ],
)
def test05_expected_error_is_one_sentence(monkeypatch, capsys, error, said):
    failing(monkeypatch, error)
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(["doctor"])
    assert end.value.code == 1
    assert capsys.readouterr().err.strip() == said


def test06_traceback_on_request(monkeypatch):
    failing(monkeypatch, NergError("no."))
    with pytest.raises(NergError):
        nerg_mi.cli.main(["doctor", "--traceback"])
    monkeypatch.setenv("NERG_TRACEBACK", "1")
    with pytest.raises(NergError):
        nerg_mi.cli.main(["doctor"])


def test07_a_bug_is_not_dressed_up(monkeypatch):
    failing(monkeypatch, TypeError("a bug"))
    with pytest.raises(TypeError):
        nerg_mi.cli.main(["doctor"])


def test08_sentence_of_a_mitsuba_error():
    error = RuntimeError(
        '[parser.cpp:1718] At string (line 1, col 49): failed to instantiate volume plugin of type "nerf": '
        'Traceback (most recent call last):\n  File "a.py", line 15, in <module>\n    f()\nValueError: "filename" must\n be given.'
    )
    assert sentence(error) == (
        'At string (line 1, col 49): failed to instantiate volume plugin of type "nerf": "filename" must be given.'
    )
