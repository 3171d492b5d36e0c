"""The set-up script: choice of the package, what it says when it must stop, and that the second run does nothing."""

import importlib.util
import json
import os
import subprocess
import sys

import pytest

from nerg_mi import llvm
from tests.conftest import ROOT


@pytest.fixture
def setup(tmp_path, monkeypatch):
    """The script as a module, with a virtual environment of its own that is a folder only."""
    spec = importlib.util.spec_from_file_location("nerg_setup", ROOT / "tools" / "setup.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(module, "VENV", tmp_path / ".venv")
    monkeypatch.setattr(module, "STAMP", tmp_path / "stamp.json")
    return module


@pytest.fixture
def commands(setup, monkeypatch):
    """The commands that the script runs; they do nothing."""
    ran = []

    def run(command, **options):
        ran.append([str(part) for part in command])
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(setup.subprocess, "run", run)
    return ran


def without_llvm(monkeypatch):
    monkeypatch.setattr(llvm, "has_cuda", lambda: False)
    monkeypatch.setattr(llvm, "problem", lambda: "No libLLVM was found.")
    monkeypatch.delenv(llvm.VARIABLE, raising=False)


@pytest.mark.parametrize(
    "names, chosen",
    [
        (["libllvm14", "libllvm9", "libllvm19", "libllvm16"], "libllvm19"),
        (["libllvm17t64", "libllvm18", "libllvm18-dbg"], "libllvm18"),
        (["libllvm17t64", "libllvm15"], "libllvm17t64"),
        (["libllvm14", "libllvm-ocaml"], None),
        ([], None),
    ],
)
def test01_newest_package(setup, names, chosen):
    assert setup.newest_package(names, llvm.MINIMUM) == chosen


def test02_stops_with_the_command_where_root_is_not_allowed(setup, monkeypatch, capsys):
    without_llvm(monkeypatch)
    monkeypatch.setattr(setup.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(setup, "administrator", lambda: None)
    monkeypatch.setattr(setup, "offered", lambda minimum: "libllvm19")
    assert setup.main([]) == 1
    assert "\n    sudo apt-get install libllvm19\n" in capsys.readouterr().err


def test03_installs_where_it_is(setup, commands, monkeypatch):
    without_llvm(monkeypatch)
    troubles = iter(["No libLLVM was found.", None])
    monkeypatch.setattr(llvm, "problem", lambda: next(troubles))
    monkeypatch.setattr(setup.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(setup, "administrator", list)
    packages = iter([None, "libllvm22"])  # the lists of packages come with the update
    monkeypatch.setattr(setup, "offered", lambda minimum: next(packages))
    setup.provide_llvm()
    assert [command[:2] for command in commands] == [["apt-get", "update"], ["apt-get", "install"]]
    assert commands[-1][-1] == "libllvm22"
    assert "DPkg::Lock::Timeout=600" in commands[-1], "waits where the machine updates itself in the background"


def test04_named_by_the_user_is_not_replaced(setup, commands, monkeypatch):
    without_llvm(monkeypatch)
    monkeypatch.setenv(llvm.VARIABLE, "/nowhere")
    with pytest.raises(setup.Stop, match="No libLLVM"):
        setup.provide_llvm()
    assert not commands


def test05_no_venv_module(setup, monkeypatch):
    monkeypatch.setattr(setup.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(setup.Stop, match="sudo apt-get install python3-venv"):
        setup.provide_venv()


def test06_second_run_installs_nothing(setup, commands):
    python = setup.VENV / "bin" / "python"
    setup.provide_package(python, set())
    assert len(commands) == 1 and commands[0][-1] == str(ROOT)
    setup.provide_package(python, set())
    assert len(commands) == 1
    setup.provide_package(python, {"test"})
    assert len(commands) == 2 and commands[1][-1].endswith("[test]")
    setup.provide_package(python, set())  # what was installed with more serves for less
    assert len(commands) == 2


def test07_new_requirements_are_installed(setup, commands):
    setup.STAMP.write_text(json.dumps({"pyproject": "another", "extras": ["test"]}))
    setup.provide_package(setup.VENV / "bin" / "python", set())
    assert commands[0][-1].endswith("[test]")  # extras stay


def test08_ci_asks_for_torch():
    script = (ROOT / ".ci" / "run").read_text()
    assert "NERG_REQUIRE_TORCH=1" in script and os.access(ROOT / ".ci" / "run", os.X_OK)
