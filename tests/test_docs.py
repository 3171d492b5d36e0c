"""Options, defaults, names and versions in the pages agree with the code."""

from __future__ import annotations

import functools
import inspect
import re
import shlex
import subprocess
import sys
from dataclasses import fields
from importlib import import_module

import pytest
import typer

import nerg_mi as nerg
import nerg_mi.cli
from nerg_mi.cli.building import find_commands
from nerg_mi.tracking.readers.registry import list_reader_names
from nerg_mi.transport.march_primal import MarchSettings
from tests.conftest import ROOT
from tools import command_pages, generated, reference

PAGES = generated.pages()
OF_DASK = {"--dashboard-address", "--no-dashboard", "--protocol", "--tls-ca-file", "--tls-cert", "--tls-key"}
FOREIGN = {"--tcnn", "--ff", "--hook-type", "--python"} | OF_DASK  # of torch-ngp, pre-commit, Blender and dask
NUMBERS = "zero one two three four five six seven eight nine ten".split()


@functools.cache
def options() -> set[str]:
    """Every option of every command and of every script."""
    spellings = {"--help"}

    root = typer.main.get_command(nerg_mi.cli.build_app())
    for command in (root, *(command for _, command, _ in command_pages.iter_commands())):
        for parameter in command.params:
            spellings.update(parameter.opts + parameter.secondary_opts)
    for folder in ("benchmarks", "examples", "tools", "scenes/store", "scenes/tabletop", "tests/renders"):
        for script in (ROOT / folder).glob("*.py"):
            spellings.update(re.findall(r'"(--[a-z][a-z0-9-]*)"', script.read_text()))
    return spellings


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
    assert named
    missing = [
        f"{file}::{name}"
        for file, name in sorted(named)
        if f"\ndef {name}(" not in (ROOT / file).read_text(encoding="utf-8")
    ]
    assert not missing


def _first_round(line: str) -> str:
    """A line of a shell; for a loop, the commands of its first iteration."""
    loop = re.fullmatch(r"for (\w+) in (\S+).*?; do (.*); done", line)
    return loop[3].replace(f"${loop[1]}", loop[2]) if loop else line


def commands(text: str) -> list[list[str]]:
    """The words of each command of nerg or Python in the code blocks of a page, or in inline code."""
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


def check_command(program: str, *words: str) -> None:
    """Parse a command of nerg; look up the options of a script."""
    if program == "nerg" and words[0].startswith("-"):  # an option such as --version, which is not run here
        assert len(words) == 1 and words[0] in options(), words
        return
    if program == "nerg":
        command = typer.main.get_command(nerg_mi.cli.build_app())
        context = command.make_context("nerg", list(words))
        while hasattr(command, "commands"):
            name, command, words = command.resolve_command(context, list(words))
            context = command.make_context(name, list(words), parent=context)
        return
    module = words[0] == "-m"
    script = words[1].removeprefix("nerg_mi.").replace(".", "/") + ".py" if module else words[0]
    text = (ROOT / script).read_text(encoding="utf-8")
    # Options that several scripts share are defined in a module next to them.
    for sibling in re.findall(r"^from (\w+) import .*_parser\b", text, re.M):
        text += (ROOT / script).with_name(f"{sibling}.py").read_text(encoding="utf-8")
    valid = re.findall(r'"(--[a-z][a-z0-9-]*)"', text)
    flags = [word.strip("[") for word in words if word.strip("[").startswith("--")]
    assert set(flags) <= set(valid), (script, flags)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test08_commands_are_right_as_they_stand(page):
    for words in commands(page.read_text(encoding="utf-8")):
        check_command(*words)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test09_files_that_are_named_exist(page):
    folders = "benchmarks|docs|examples|nerg_mi|plugins|scenes|tests|tools"
    named = set(re.findall(rf"`((?:{folders})/[\w./-]*)", page.read_text(encoding="utf-8")))
    named -= {"scenes/store/example.xml"}  # what a reader is to write
    made = "scenes/store/build/"  # by a command that the pages name
    assert not [path for path in named if not path.startswith(made) and not (ROOT / path).exists()]


def test10_the_architecture_lists_all_packages():
    page = (ROOT / "docs/explanation/architecture.md").read_text(encoding="utf-8")
    table = re.findall(r"^\| (`.*?) +\|", page.partition("## Packages")[2].partition("\n## ")[0], re.M)
    named = {*re.findall(r"`(\w+)`", " ".join(table)), "tasks", "files"}  # the last two in a sentence
    assert named == {path.parent.name for path in (ROOT / "nerg_mi").glob("*/__init__.py")}


# ---- The README and the pages at the root ----


def test11_commands_of_the_readme_exist():
    said = set(re.findall(r"^\| `nerg (\w+)", (ROOT / "README.md").read_text("utf-8"), re.M))
    assert said and said <= {name.split()[0] for name in find_commands()}


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"])
def test12_links_lead_somewhere(page):
    for target in re.findall(r"\]\((?!http)([^)#]+)", (ROOT / page).read_text("utf-8")):
        assert (ROOT / target).exists(), target


@pytest.mark.parametrize(
    "page", ["README.md", "docs/how-to/recordings.md", "docs/how-to/cluster.md", "docs/explanation/robustness.md"]
)
def test13_every_network_connection_is_named(page):
    """A page that says what leaves the machine names the commands that connect (`tests/cli/test_outputs.py` has the
    others open none)."""
    text = (ROOT / page).read_text(encoding="utf-8")
    for name in ("--scheduler tcp://", "nerg worker", "nerg view"):
        assert name in text, name


def said(file: str, pattern: str) -> str:
    """The first match of ``pattern`` in ``file``."""
    match = re.search(pattern, (ROOT / file).read_text(encoding="utf-8"), re.M)
    assert match, f"{file} has no line {pattern}"
    return match[1]


def test_one_version():
    assert said("pyproject.toml", r'^version = "(.+)"$') == nerg.__version__
    assert said("CITATION.cff", r"^version: (\S+)$") == nerg.__version__
    assert said("CHANGELOG.md", r"^## (\d\S*)") == nerg.__version__


def test_types_come_with_the_package():
    assert (ROOT / "nerg_mi" / "py.typed").is_file()
    assert '"nerg_mi" = ["py.typed"]' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


# ---- Public names ----


PUBLIC = [getattr(nerg, name) for name in nerg.__all__]
LISTED = re.findall(r"^\.\. auto(?:function|class|exception):: (\S+)", reference.python(), re.M)


def test_names_of_the_page_on_python_are_those_of_the_package():
    page = (ROOT / "docs" / "how-to" / "python.md").read_text(encoding="utf-8")
    assert set(re.findall(r"\bnerg\.(?!py\b)(\w+)", page)) <= set(nerg.__all__)


def named(path: str) -> object:
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name)


@pytest.mark.parametrize("path", LISTED)
def test22_what_is_public_is_documented(path):
    value = named(path)
    assert inspect.getdoc(value), path
    if inspect.isclass(value):
        for name, member in vars(value).items():
            if not name.startswith("_") and (inspect.isroutine(member) or isinstance(member, (property, classmethod))):
                assert inspect.getdoc(member), f"{path}.{name} has no docstring"


def test_what_functions_take_and_return_is_listed():
    assert len(set(LISTED)) == len(LISTED) and {f"nerg_mi.{name}" for name in nerg.__all__} <= set(LISTED)
    others = {"figures.pictures.Pictures", "tracking.splits.RaysSplit", "transport.quadrature.QuadratureRule"}
    assert {f"nerg_mi.{name}" for name in others} <= set(LISTED)


# ---- The reference ----


def test_the_reference_has_every_command_plugin_and_reader(tmp_path):
    reference.write_pages(tmp_path)
    pages = {page.stem: page.read_text(encoding="utf-8") for page in tmp_path.iterdir()}
    assert set(pages) == set(reference.PAGES)
    titles = {name: re.findall(r"^## (.+)", text, re.M) for name, text in pages.items()}
    assert {f"nerg {name}" for name in find_commands()} <= set(titles["commands"])
    assert len(titles["plugins"]) == len(reference.PLUGINS)
    assert set(re.findall(r"^- `(\w+)`: .*", pages["recordings"], re.M)) >= set(list_reader_names())
    for target in reference.find_sections().values():
        page, _, anchor = target.partition("#")
        assert not anchor or anchor in map(reference.anchor, titles[page.removesuffix(".md")]), target


# ---- Generated parts of pages ----


def test_every_page_is_up_to_date():
    # In a separate process, because other tests register fictitious entries.
    done = subprocess.run(
        [sys.executable, "-m", "tools.generated", "--check"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]


def test_every_part_stands_on_a_page():
    text = "".join(page.read_text(encoding="utf-8") for page in generated.pages())
    for name in generated.PARTS:
        assert text.count(f"<!-- made by make docs: {name} -->") == 1, name
