"""The command `nerg`: its list of commands, imports, shell completion, failures, and `nerg doctor`."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from nerg_mi import diagnosis, llvm
from nerg_mi.cli.building import GROUPS, find_commands
from nerg_mi.errors import MissingFile, NergError, UnusableLLVM, blame_options, format_error, translate_mitsuba_errors
from tests.conftest import ROOT
from tools.command_pages import iter_commands

HEAVY = {"mitsuba", "drjit", "numpy", "scipy", "matplotlib", "torch", "trimesh", "OpenEXR"}


def in_a_process(*arguments, after="", **environment):
    code = (
        f"import sys; sys.argv[1:] = {list(arguments)!r}\n"
        f"from nerg_mi.cli import main\ntry: main()\nfinally:\n    {after or 'pass'}"
    )
    environment = {**os.environ, **environment}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)


def test01_help_lists_every_command():
    done = in_a_process("--help")
    assert done.returncode == 0
    for name, entry in find_commands().items():
        name, _, below = name.partition(" ")
        line = GROUPS[name] if below else entry.line
        assert re.search(rf"^\s+{name}\s+{re.escape(line[:30])}", done.stdout, re.M), name


def test02_help_imports_nothing_heavy():
    done = in_a_process("--help", after="print('loaded:', *sys.modules)")
    loaded = set(done.stdout.partition("loaded:")[2].split())
    assert "nerg_mi.cli" in loaded and not HEAVY & loaded
    assert not {row.function.partition(":")[0] for row in find_commands().values()} & loaded


def test03_no_help_of_a_command_imports_anything_heavy():
    """The exception is import, which has the options of the readers of tables."""
    code = (
        "import sys\nfrom nerg_mi.cli import building\n"
        "for name, row in building.ROWS.items():\n"
        "    if name != 'rays import': building.build_command(building.make_command(row))\n"
        f"print(*{HEAVY} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0 and not done.stdout.strip(), (done.stdout, done.stderr)


def test04_wrong_command_line(nerg):
    assert nerg("no-such-command").code == 2
    assert nerg("render", "scene.xml").code == 2  # -o is missing


def test05_mode_is_the_variant_of_commands_that_compute():
    having = set()
    for path, command, _ in iter_commands():
        name = path.removeprefix("nerg ")
        options = {option: p for p in command.params for option in p.opts}
        having |= {name} if "--mode" in options else set()
        assert ("-m" in options) == ("--mode" in options)
        # These commands select the factors of a gaze field.
        assert ("--variant" in options) == (name == "train gaze"), name
    assert having >= {"bake", "demo", "refine", "render", "report", "stats", "study", "view"}
    assert all(any(name.startswith(f"{group} ") for name in having) for group in ("train", "eval", "export"))


# ---- How a command fails ----


def failing(monkeypatch, error):
    def fail(progress):
        raise error

    monkeypatch.setattr(diagnosis, "run_diagnosis", fail)


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
            "nerg: not enough memory: Unable to allocate 9 GiB; reduce the size of the job, or close other programs",
        ),
    ],
)
def test05_user_error_is_one_sentence(monkeypatch, nerg, error, said):
    failing(monkeypatch, error)
    ended = nerg("doctor")
    assert ended.code == 1 and ended.err.strip() == said


@pytest.mark.parametrize("error, code", [(NergError("no."), 1), (TypeError("a bug"), 70)])
@pytest.mark.parametrize("ask", ["--debug", "--traceback", "NERG_TRACEBACK"])
def test06_traceback_on_request(monkeypatch, nerg, error, code, ask):
    failing(monkeypatch, error)
    if ask.isupper():
        monkeypatch.setenv(ask, "1")
    ended = nerg("doctor", *([ask] if ask.startswith("--") else []))
    said = ended.err
    assert ended.code == code and "Traceback (most recent call last)" in said and "in fail" in said
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
def test07_an_internal_error_is_reported_as_one(monkeypatch, nerg, error, said):
    failing(monkeypatch, error)
    ended = nerg("doctor")
    assert ended.code == 70 and not ended.out
    assert ended.err == (
        f"nerg: internal error ({said}): this is a bug in nerg_mi, not in your input; run the command again with "
        "--debug and report the traceback\n"
    )


@pytest.mark.parametrize("lines", [1, 100_000])
def test07b_a_closed_output_stream_is_ignored(lines):
    """No error in the middle of the output, nor at its end, which is written when the interpreter stops."""
    code = (
        "import sys\nfrom nerg_mi import diagnosis\n"
        f"def run(progress):\n    for i in range({lines}): print('a line of output')\n"
        "    return diagnosis.Diagnosis([diagnosis.Finding('all', 'well')], True)\n"
        "diagnosis.run_diagnosis = run\n"
        "from nerg_mi.cli import main\nsys.argv[1:] = ['doctor']\nmain()"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.close()
    said = process.stderr.read()
    process.wait(timeout=60)
    process.stderr.close()
    assert said == "" and process.returncode in (0, 1)


def test07c_a_contract_violation_by_an_option_is_a_user_error():
    with pytest.raises(NergError, match="^the corner is wrong; give other values by --aabb$") as raised:
        with blame_options("--aabb"):
            raise ValueError("the corner is wrong.")
    assert isinstance(raised.value.__cause__, ValueError)
    with pytest.raises(NergError, match="^write y$"):
        with blame_options("--aabb"):
            raise NergError("write y")
    with pytest.raises(TypeError):
        with blame_options("--aabb"):
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
def test07d_a_mitsuba_error_about_a_scene_is_a_user_error(said):
    with pytest.raises(NergError):
        with translate_mitsuba_errors():
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
def test07e_a_bug_in_a_plugin_is_an_internal_error(said):
    with pytest.raises(RuntimeError) as raised:
        with translate_mitsuba_errors():
            raise RuntimeError(said)
    assert not isinstance(raised.value, NergError)


def test07f_an_error_in_a_plugin_constructor_is_internal(rgb, tmp_path, nerg, monkeypatch):
    """An error passes from the constructor through Mitsuba to the command line."""
    scene = tmp_path / "a.xml"
    scene.write_text('<scene version="3.0.0"><integrator type="nerg"/><sensor type="perspective"/></scene>')
    rgb.set_variant("llvm_ad_rgb")
    monkeypatch.setattr("nerg_mi.plugins.nerg.read_choice", lambda *a: 1 / 0)
    ended = nerg("render", scene, "-o", tmp_path / "a.exr", "-m", "llvm_ad_rgb")
    assert ended.code == 70 and "internal error" in ended.err and "ZeroDivisionError: division by zero" in ended.err


def test08_sentence_of_a_mitsuba_error():
    error = RuntimeError(
        '[parser.cpp:1718] At string (line 1, col 49): failed to instantiate volume plugin of type "nerf": '
        'Traceback (most recent call last):\n  File "a.py", line 15, in <module>\n    f()\n'
        'ValueError: "filename" must\n be given.'
    )
    assert format_error(error) == (
        'At string (line 1, col 49): failed to instantiate volume plugin of type "nerf": "filename" must be given.'
    )


# ---- nerg doctor, on this machine and on one whose libLLVM is unusable ----


def test09_doctor_passes_on_this_machine():
    done = in_a_process("doctor")
    assert done.returncode == 0, done.stdout + done.stderr
    for word in ("libLLVM", "CUDA", "llvm_ad_rgb", "threads", *diagnosis.EXTRAS, "ready to render"):
        assert word in done.stdout


def test10_doctor_reports_an_unusable_llvm(tmp_path):
    bad = tmp_path / "libLLVM-15.so.1"
    bad.touch()
    done = in_a_process("doctor", **{llvm.PATH_VARIABLE: str(bad)})
    assert "Traceback" not in done.stderr
    assert f"LLVM 15 ({bad}) cannot run the kernels of Dr.Jit" in done.stdout
    assert "llvm_ad_rgb" not in done.stdout
    if not llvm.has_cuda():
        assert done.returncode == 1 and "cannot render" in done.stdout


# ---- Shells complete sub-commands and options of the installed command ----

NERG = Path(sys.executable).with_name("nerg")
needs_command = pytest.mark.skipif(not NERG.exists(), reason="the command nerg is not installed next to this Python")


def ask(shell: str, line: str) -> subprocess.CompletedProcess[str]:
    """The reply of the installed command to a shell in which `line` was typed, followed by Tab."""
    words = line.split(" ")
    how = {"COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)} if shell == "bash" else {"_TYPER_COMPLETE_ARGS": line}
    how |= {"_NERG_COMPLETE": f"complete_{shell}", "_TYPER_COMPLETE_FISH_ACTION": "get-args"}
    return subprocess.run([NERG], env={**os.environ, **how}, capture_output=True, text=True, timeout=60)


@needs_command
def test_bash_completes_commands_and_subcommands():
    assert set(ask("bash", "nerg ").stdout.split()) == {name.split()[0] for name in find_commands()}
    assert ask("bash", "nerg tr").stdout.split() == ["train"]
    assert set(ask("bash", "nerg train ").stdout.split()) == {"radiance", "gaze", "prior"}
    assert {"import", "guess", "show", "filter"} <= set(ask("bash", "nerg rays ").stdout.split())


@needs_command
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_bash_completes_the_options_of_a_command(shell):
    done = ask(shell, "nerg train gaze --test-z")
    assert done.returncode == 0 and done.stderr == ""
    assert "--test-zones" in done.stdout and "--seed" not in done.stdout
    assert "--overlay" in ask(shell, "nerg render --ov").stdout


@needs_command
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_that_a_shell_reads_is_printed(shell):
    environment = {**os.environ, "_NERG_COMPLETE": f"source_{shell}"}
    done = subprocess.run([NERG], env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and "_NERG_COMPLETE=complete_" in done.stdout and "nerg" in done.stdout


@needs_command
@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_the_printed_script_completes_in_bash(tmp_path):
    """As in a shell: evaluate the script, call its function, and read COMPREPLY."""
    script = "\n".join(
        [
            'eval "$(_NERG_COMPLETE=source_bash nerg)"',
            "COMP_WORDS=(nerg render --over) COMP_CWORD=2",
            '_nerg_completion nerg; printf "%s\\n" "${COMPREPLY[@]}"',
        ]
    )
    environment = {**os.environ, "PATH": f"{NERG.parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(["bash", "--norc", "-c", script], env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["--overlay"], done.stderr


@needs_command
def test_completion_is_installed_in_the_home_folder(tmp_path):
    environment = {**os.environ, "HOME": str(tmp_path), "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    command = [NERG, "--install-completion", "bash"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "_nerg_completion" in (tmp_path / ".bash_completions" / "nerg.sh").read_text()
    assert "nerg.sh" in (tmp_path / ".bashrc").read_text()
