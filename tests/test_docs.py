"""What the pages say of options and defaults is what the code has."""

from __future__ import annotations

import functools
import re
import shlex
from dataclasses import fields
from types import SimpleNamespace

import pytest
import typer

import nerg_mi.cli
from nerg_mi.evaluation import study as study_settings
from nerg_mi.transport.march_primal import MarchSettings
from tests.conftest import ROOT
from tools import command_pages

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
OF_DASK = {"--dashboard-address", "--no-dashboard", "--protocol", "--tls-ca-file", "--tls-cert", "--tls-key"}
FOREIGN = {"--tcnn", "--ff", "--hook-type"} | OF_DASK  # of torch-ngp, pre-commit and dask
NUMBERS = "zero one two three four five six seven eight nine ten".split()


@functools.cache
def options() -> set[str]:
    """Every option of every command and of every script."""
    found = {"--help"}

    root = typer.main.get_command(nerg_mi.cli.build_app())
    for command in (root, *(command for _, command, _ in command_pages.commands())):
        for parameter in command.params:
            found.update(parameter.opts + parameter.secondary_opts)
    for folder in ("benchmarks", "examples", "tools", "scenes/store", "scenes/tabletop", "tests/renders"):
        for script in (ROOT / folder).glob("*.py"):
            found.update(re.findall(r'"(--[a-z][a-z0-9-]*)"', script.read_text()))
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test01_options_that_are_named_exist(page):
    named = set(re.findall(r"(?<![\w-])(--[a-z][a-z0-9-]*)(?!\w)", page.read_text()))
    assert named <= options() | FOREIGN


def test03_defaults_of_the_march_are_the_integrators(rgb):
    made = rgb.load_dict({"type": "nerg", "density": {"type": "constvolume"}}).settings
    for f in fields(MarchSettings):
        if f.name != "step":
            assert getattr(made, f.name) == f.default, f.name


def test06_tests_that_are_named_exist():
    named = {m for page in PAGES for m in re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", page.read_text(encoding="utf-8"))}
    assert len(named) > 20
    missing = [
        f"{file}::{name}"
        for file, name in sorted(named)
        if f"\ndef {name}(" not in (ROOT / file).read_text(encoding="utf-8")
    ]
    assert not missing


def _first_round(line: str) -> str:
    """A line of a shell, where it is a loop what it does first."""
    loop = re.fullmatch(r"for (\w+) in (\S+).*?; do (.*); done", line)
    return loop[3].replace(f"${loop[1]}", loop[2]) if loop else line


def commands(text: str) -> list[list[str]]:
    """The words of each command of nerg and of Python that stands in a block of a page, or in a line as a whole."""
    fenced = re.findall(r"^```sh\n(.*?)^```", text, re.M | re.S)
    prose = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    blocks = "\n".join([*fenced, *re.findall(r"^ {4}(.*)", prose, re.M)])
    lines = [_first_round(line.strip()) for line in re.sub(r"\\\n\s*", " ", blocks).splitlines()]
    lines += [" ".join(line.split()) for line in re.findall(r"`(?:NERG_DATA=DIR )?(python\s[^`]+)`", prose)]
    return [shlex.split(line, comments=True) for line in lines if re.match(r"(nerg|python) ", line)]


def test07_commands_are_found():
    text = "```sh\nnerg a b \\\n  --c 'd e'  # f\nfor x in y; do nerg $x; done\n```\n"
    text += "\n    python g.py\n\nRun `python\nh.py --i`."
    assert commands(text) == [
        ["nerg", "a", "b", "--c", "d e"],
        ["nerg", "y"],
        ["python", "g.py"],
        ["python", "h.py", "--i"],
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test08_commands_are_right_as_they_stand(page):
    for program, *words in commands(page.read_text(encoding="utf-8")):
        if program == "nerg" and words[0].startswith("-"):  # what the program does at once is not done here
            assert len(words) == 1 and words[0] in options(), words
            continue
        if program == "nerg":
            command = typer.main.get_command(nerg_mi.cli.build_app())
            context = command.make_context("nerg", list(words))
            while hasattr(command, "commands"):
                name, command, words = command.resolve_command(context, list(words))
                context = command.make_context(name, list(words), parent=context)
            continue
        module = words[0] == "-m"
        script = words[1].removeprefix("nerg_mi.").replace(".", "/") + ".py" if module else words[0]
        text = (ROOT / script).read_text(encoding="utf-8")
        # Options that several scripts have come from a parser in a module beside them.
        for sibling in re.findall(r"^from (\w+) import .*_parser\b", text, re.M):
            text += (ROOT / script).with_name(f"{sibling}.py").read_text(encoding="utf-8")
        known = re.findall(r'"(--[a-z][a-z0-9-]*)"', text)
        asked = [word.strip("[") for word in words if word.strip("[").startswith("--")]
        assert set(asked) <= set(known), (script, asked)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test09_files_that_are_named_exist(page):
    folders = "benchmarks|docs|examples|nerg_mi|plugins|scenes|tests|tools"
    named = set(re.findall(rf"`((?:{folders})/[\w./-]*)", page.read_text(encoding="utf-8")))
    named -= {"scenes/store/example.xml"}  # what a reader is to write
    made = "scenes/store/build/"  # by a command that the pages name
    assert not [path for path in named if not path.startswith(made) and not (ROOT / path).exists()]


def test10_settings_of_the_study_are_the_studys():
    subject = SimpleNamespace(marched=True, hits=False, extent=1.0, has_gaze=True, normalized=True, resampled=True)
    names = {setting.name for setting in study_settings.settings(subject)}
    told = set()
    for table in re.findall(
        r"^\| setting .*\n\|.*\n((?:\|.*\n)+)", (ROOT / "docs/error-and-time.md").read_text(), re.M
    ):
        told |= {line.split("|")[1].strip() for line in table.splitlines()}
    assert len(told) > 50 and told <= names
