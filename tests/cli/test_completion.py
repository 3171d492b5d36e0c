"""Shells complete sub-commands and options of the installed command."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nerg_mi.cli.building import find_commands

NERG = Path(sys.executable).with_name("nerg")
needs_command = pytest.mark.skipif(not NERG.exists(), reason="the command nerg is not installed beside this Python")


def ask(shell: str, line: str) -> subprocess.CompletedProcess[str]:
    """What the installed command answers a shell in which `line` was typed up to Tab."""
    words = line.split(" ")
    how = {"COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)} if shell == "bash" else {"_TYPER_COMPLETE_ARGS": line}
    how |= {"_NERG_COMPLETE": f"complete_{shell}", "_TYPER_COMPLETE_FISH_ACTION": "get-args"}
    return subprocess.run([NERG], env={**os.environ, **how}, capture_output=True, text=True, timeout=60)


@needs_command
def test_bash_is_given_commands_and_those_below():
    assert set(ask("bash", "nerg ").stdout.split()) == {name.split()[0] for name in find_commands()}
    assert ask("bash", "nerg tr").stdout.split() == ["train"]
    assert set(ask("bash", "nerg train ").stdout.split()) == {"radiance", "gaze", "prior"}
    assert {"import", "guess", "show", "filter"} <= set(ask("bash", "nerg rays ").stdout.split())


@needs_command
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_options_are_those_of_the_command(shell):
    done = ask(shell, "nerg train gaze --fr")
    assert done.returncode == 0 and done.stderr == ""
    assert "--fresh-directions" in done.stdout and "--seed" not in done.stdout
    assert "--overlay" in ask(shell, "nerg render --ov").stdout


@needs_command
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_that_a_shell_reads_is_printed(shell):
    environment = {**os.environ, "_NERG_COMPLETE": f"source_{shell}"}
    done = subprocess.run([NERG], env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and "_NERG_COMPLETE=complete_" in done.stdout and "nerg" in done.stdout


@needs_command
@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_completes_by_that_script(tmp_path):
    """As a shell does it: the script is read, its function called, what it leaves in COMPREPLY looked at."""
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
def test_it_is_installed_into_the_home_it_is_given(tmp_path):
    environment = {**os.environ, "HOME": str(tmp_path), "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    command = [NERG, "--install-completion", "bash"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "_nerg_completion" in (tmp_path / ".bash_completions" / "nerg.sh").read_text()
    assert "nerg.sh" in (tmp_path / ".bashrc").read_text()


@needs_command
def test_help_is_there_at_once():
    """The best of five, so that a busy machine does not decide."""
    took = []
    for _ in range(5):
        start = time.perf_counter()
        subprocess.run([NERG, "--help"], capture_output=True, check=True)
        took.append(time.perf_counter() - start)
    assert min(took) < 0.5
