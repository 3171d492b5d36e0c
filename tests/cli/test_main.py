"""The frame of the command: what it lists, what it imports, and how it fails."""

import re
import subprocess
import sys
from dataclasses import replace

import pytest

import nerg_mi.cli
import nerg_mi.cli.machine
from nerg_mi.cli.building import GROUPS, find_commands
from nerg_mi.errors import MissingFile, NergError, UnusableLLVM, chosen, mitsuba_says, sentence
from nerg_mi.workflows.base import COMMANDS
from tests.conftest import ROOT

HEAVY = {"mitsuba", "drjit", "numpy", "scipy", "matplotlib", "torch", "trimesh", "OpenEXR"}


def nerg(*arguments, after=""):
    code = (
        f"import sys; sys.argv[1:] = {list(arguments)!r}\n"
        f"from nerg_mi.cli import main\ntry: main()\nfinally:\n    {after or 'pass'}"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)


def test01_help_lists_every_command():
    done = nerg("--help")
    assert done.returncode == 0
    for name, entry in find_commands().items():
        name, _, below = name.partition(" ")
        line = GROUPS[name] if below else entry.line
        assert re.search(rf"^\s+{name}\s+{re.escape(line[:30])}", done.stdout, re.M), name


def test02_help_imports_nothing_heavy():
    done = nerg("--help", after="print('loaded:', *sys.modules)")
    loaded = set(done.stdout.partition("loaded:")[2].split())
    assert "nerg_mi.cli" in loaded and not HEAVY & loaded
    assert not {entry.module for entry in find_commands().values()} & loaded


def test03_no_help_loads_mitsuba():
    code = (
        "import sys\nfrom tools.command_pages import commands\n"
        "for path, command, _ in commands(): assert command.help, path\n"
        "print(*{'mitsuba', 'torch'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0 and not done.stdout.strip(), done.stderr


def test04_wrong_command_line():
    assert nerg("no-such-command").returncode == 2
    assert nerg("render", "scene.xml").returncode == 2  # -o is missing


def failing(monkeypatch, error):
    def command(reporter):
        raise error

    monkeypatch.setitem(COMMANDS, "doctor", replace(COMMANDS["doctor"], run=command))


@pytest.mark.parametrize(
    "error, said",
    [
        (NergError('there is no "x": write "y".'), 'nerg: there is no "x": write "y".'),
        (MissingFile('there is no file "a".'), 'nerg: there is no file "a".'),
        (FileNotFoundError(2, "No such file or directory", "a.xml"), 'nerg: there is no file "a.xml"'),
        (PermissionError(13, "Permission denied", "a.exr"), 'nerg: "a.exr": permission denied'),
        (OSError(28, "No space left on device"), "nerg: no space left on device"),
        (UnusableLLVM("LLVM 15 cannot run."), "nerg: LLVM 15 cannot run."),
        (ModuleNotFoundError("No module named 'torch'", name="torch"), "nerg: No module named 'torch'"),
        (
            MemoryError("Unable to allocate 9 GiB"),
            "nerg: there is not enough memory: Unable to allocate 9 GiB; ask for less, or close other programs",
        ),
    ],
)
def test05_expected_error_is_one_sentence(monkeypatch, capsys, error, said):
    failing(monkeypatch, error)
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(["doctor"])
    assert end.value.code == 1
    assert capsys.readouterr().err.strip() == said


@pytest.mark.parametrize("error, code", [(NergError("no."), 1), (TypeError("a bug"), 70)])
@pytest.mark.parametrize("ask", ["--debug", "--traceback", "NERG_TRACEBACK"])
def test06_traceback_on_request(monkeypatch, capsys, error, code, ask):
    failing(monkeypatch, error)
    if ask.isupper():
        monkeypatch.setenv(ask, "1")
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(["doctor"] + [ask] * ask.startswith("--"))
    said = capsys.readouterr().err
    assert end.value.code == code and "Traceback (most recent call last)" in said and "in command" in said
    assert said.strip().splitlines()[-1].startswith("nerg: ")


@pytest.mark.parametrize(
    "error, said",
    [
        (TypeError("a\n  bug"), "TypeError: a bug"),
        (ValueError("of one function by another"), "ValueError: of one function by another"),
        (KeyError("x"), "KeyError: 'x'"),
        (RuntimeError(), "RuntimeError"),
        (ZeroDivisionError("division by zero"), "ZeroDivisionError: division by zero"),
        (OSError("of nothing"), "OSError: of nothing"),
        (
            ImportError("cannot import name 'x' from 'nerg_mi.fields'", name="nerg_mi.fields"),
            "ImportError: cannot import name 'x' from 'nerg_mi.fields'",
        ),
    ],
)
def test07_a_mistake_in_the_program_is_shown_as_one(monkeypatch, capsys, error, said):
    failing(monkeypatch, error)
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(["doctor"])
    out = capsys.readouterr()
    assert end.value.code == 70 and not out.out
    assert out.err == (
        f"nerg: internal error ({said}): this is a fault of nerg_mi and not of your input; run again with --debug and "
        "report the traceback\n"
    )


@pytest.mark.parametrize("lines", [1, 100_000])
def test07b_nothing_is_said_where_nobody_reads(lines):
    """Neither in the middle of the output nor at its end, which is written when the interpreter stops."""
    code = (
        "import sys, dataclasses\nimport nerg_mi.cli.machine\nfrom nerg_mi.workflows.base import COMMANDS\n"
        f"def run(reporter):\n    for i in range({lines}): print('a line of output')\n"
        "COMMANDS['doctor'] = dataclasses.replace(COMMANDS['doctor'], run=run)\n"
        "from nerg_mi.cli import main\nsys.argv[1:] = ['doctor']\nmain()"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.close()
    said = process.stderr.read()
    process.wait(timeout=60)
    process.stderr.close()
    assert said == "" and process.returncode in (0, 1)


def test07c_what_a_contract_refuses_is_the_users_where_they_chose_it():
    with pytest.raises(NergError, match="^the corner is wrong; give other values by --aabb$") as raised:
        with chosen("--aabb"):
            raise ValueError("the corner is wrong.")
    assert isinstance(raised.value.__cause__, ValueError)
    with pytest.raises(NergError, match="^write y$"):
        with chosen("--aabb"):
            raise NergError("write y")
    with pytest.raises(TypeError):
        with chosen("--aabb"):
            raise TypeError("a bug")


QUOTED = (
    "[parser.cpp:1718] At string: failed to instantiate: "
    'Traceback (most recent call last):\n  File "a.py", line 15, in f\n    g()\n'
)


@pytest.mark.parametrize(
    "said",
    [
        "[scene.cpp:3] no plugin of that name",
        QUOTED + "nerg_mi.errors.NergError: write y",
        QUOTED + 'ValueError: "x" must\n be 3',
    ],
)
def test07d_what_mitsuba_says_of_a_scene_is_the_users(said):
    with pytest.raises(NergError):
        with mitsuba_says():
            raise RuntimeError(said)


@pytest.mark.parametrize(
    "said",
    [
        QUOTED + "TypeError: f() takes no arguments",
        QUOTED + "KeyError: 'x'",
        QUOTED + "AssertionError",
        QUOTED + "a.b.Odd: x",
    ],
)
def test07e_a_mistake_in_a_plugin_is_not(said):
    with pytest.raises(RuntimeError) as raised:
        with mitsuba_says():
            raise RuntimeError(said)
    assert not isinstance(raised.value, NergError)


def test07f_a_plugin_with_a_mistake(rgb, tmp_path, capsys, monkeypatch):
    """From its constructor through Mitsuba to the command line."""
    scene = tmp_path / "a.xml"
    scene.write_text('<scene version="3.0.0"><integrator type="nerg"/><sensor type="perspective"/></scene>')
    rgb.set_variant("llvm_ad_rgb")
    monkeypatch.setattr("nerg_mi.plugins.nerg.choice", lambda *a: 1 / 0)
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(["render", str(scene), "-o", str(tmp_path / "a.exr"), "-m", "llvm_ad_rgb"])
    said = capsys.readouterr().err
    assert end.value.code == 70 and "internal error" in said and "ZeroDivisionError: division by zero" in said


def test08_sentence_of_a_mitsuba_error():
    error = RuntimeError(
        '[parser.cpp:1718] At string (line 1, col 49): failed to instantiate volume plugin of type "nerf": '
        'Traceback (most recent call last):\n  File "a.py", line 15, in <module>\n    f()\n'
        'ValueError: "filename" must\n be given.'
    )
    assert sentence(error) == (
        'At string (line 1, col 49): failed to instantiate volume plugin of type "nerf": "filename" must be given.'
    )
