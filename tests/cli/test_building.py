"""Commands built from declarations: names, defaults, flags, help and passed values; a command in a new module."""

from __future__ import annotations

import ast
import inspect
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import pytest
import typer
from typer.testing import CliRunner

import nerg_mi.cli
from nerg_mi.cli import building
from nerg_mi.cli.building import DEBUG, GROUPS, find_commands, make_callback
from nerg_mi.cli.declarations import Command, argument, extra
from nerg_mi.cli.signatures import read_parameter_texts, read_signature
from nerg_mi.cli.table import ROWS, Row
from nerg_mi.errors import NergError
from nerg_mi.files.values import FilePath
from nerg_mi.options import option, parse_numbers
from nerg_mi.progress import Progress, Reporter
from nerg_mi.ranges import KAPPAS, Range, ValidatedDataclass, check_ranges, setting
from nerg_mi.tracking.readers.base import list_options
from nerg_mi.tracking.readers.registry import collect_shared_options, get_reader, list_preset_names
from tools.command_pages import iter_commands


@dataclass(frozen=True, kw_only=True)
class Brew:
    """Options of a job that makes tea."""

    leaves: str = option("green", "Which leaves.")
    kettle_file: Path | None = option(None, "Where the kettle is.")
    sugar: bool = option(False, "With sugar.")
    stir: bool = option(True, "Stirred.")
    minutes: float = option(3.0, "How long.", "-t", "--time", min=0.5)
    guests: tuple[str, ...] = option((), "Who drinks it; may be given several times.")
    origin: tuple[float, ...] | None = option(None, "Where it grew.", "--from", parse=parse_numbers)
    secret: int = option(7, "A secret number.")


@pytest.fixture
def serve():
    """A function that runs a command with the options of `Brew` and returns the values that it receives."""
    handed = []

    def tea(cup, table, options, reporter):
        handed.append((cup, options, table))

    cup, table = argument("What it is poured into.", str), extra(1, "Where it is served.", int, "--table")
    command = Command("tea", tea, "Make tea.", "", Brew, ("secret",), {"cup": cup, "table": table})
    app = typer.Typer(rich_markup_mode=None)
    app.command(help="Make tea.")(make_callback(command))

    def run(*line):
        done = CliRunner().invoke(app, list(line))
        return done, handed[-1] if handed else None

    return run


def test_defaults_are_those_of_the_dataclass(serve):
    assert serve("mug")[1] == ("mug", Brew(), 1)


def test_every_option_arrives(serve):
    line = "mug --leaves black --kettle-file k.txt --sugar --no-stir -t 4.5 --guests a --guests b --table 2"
    expected = Brew(
        leaves="black", kettle_file=Path("k.txt"), sugar=True, stir=False, minutes=4.5, guests=("a", "b"), secret=7
    )
    assert serve(*line.split())[1] == ("mug", expected, 2)


@pytest.mark.parametrize("wrong", [("--secret", "1"), ("--no-sugar",), ("--minutes", "4"), ("--time", "0.1")])
def test_an_unknown_option_is_refused(serve, wrong):
    done, handed = serve("mug", *wrong)
    assert done.exit_code == 2 and handed is None


def test_help_describes_each_field(serve):
    shown = " ".join(serve("--help")[0].stdout.split())
    assert "Make tea." in shown and "Where it is served." in shown
    for f in fields(Brew):
        assert (f.metadata["help"] in shown) == (f.name != "secret")


def test_a_parse_error_names_the_parameter(serve):
    assert serve("mug", "--from", "1,2.5")[1][1].origin == (1.0, 2.5)
    done, _ = serve("mug", "--from", "east")
    assert done.exception.parameters == {"origin": ""}


@dataclass(frozen=True)
class Note(ValidatedDataclass):
    """Settings of a note."""

    volume: int = setting(3, "Loudness.", allowed=Range(0, 11))
    pitch: float = 440.0  # not a setting

    def save(self, path):
        Path(path).write_text(f"{self.volume}")


@check_ranges
def play(
    names: Sequence[FilePath],
    *,
    times: Annotated[int, Range(1, 9)] = 1,
    width: Annotated[float, KAPPAS] | None = None,
    is_quiet: bool = False,
    tone: Literal["high", "low"] = "high",
    note: Note = Note(),
    progress: Progress = None,
):
    """Play a note.

    It is heard at once.

    Parameters
    ----------
    names : sequence of path
        What is played.
    times : int
        How often.
    width : float, optional
        How wide.
    is_quiet : bool
        Whether nothing is heard.
    tone : str
        Which tone: high or low.
    note : Note
        The note.
    progress : bool, Reporter or None
        Progress.
    """
    progress.message(f"{[str(name) for name in names]} {times} {width} {is_quiet} {note.volume}")
    return note


def record(names: Sequence[FilePath], output: FilePath, *, room: FilePath | None = None, progress: Progress = None):
    """Record notes.

    Parameters
    ----------
    names : sequence of path
        What is recorded.
    output : path
        Folder to write.
    room : path, optional
        Where it is played.
    progress : bool, Reporter or None
        Progress.
    """
    Path(output).mkdir()
    progress.message(f"recorded in {room}")


def test_a_command_is_one_row(monkeypatch, tmp_path, capsys):
    """Arguments, options, ranges and texts are those of the function, and its result is saved."""
    row = Row("play", f"{__name__}:play", "Play.", ("names",), "File to write (.txt).", (".txt",), computes=False)
    monkeypatch.setitem(ROWS, "play", row)
    monkeypatch.setattr(building, "TABLE", (row,))

    def nerg(*line):
        with pytest.raises(SystemExit) as end:
            nerg_mi.cli.main(["play", *line])
        said = capsys.readouterr()
        return end.value.code, said.out + said.err

    assert "play" in find_commands()
    output = ["-o", str(tmp_path / "a.txt")]
    code, said = nerg("--help")
    assert code == 0 and "Play a note.\n\n  It is heard at once." in said
    assert all(text in said for text in ("What is played.", "How often.", "Loudness.", "1<=x<=9", "0<=x<=11"))
    assert "pitch" not in said and "--mode" not in said
    code, said = nerg("a", "b", *output)
    assert code == 0 and said.startswith("['a', 'b'] 1 None False 3\nwrote ")
    code, said = nerg("a", *output, "--times", "2", "--width", "90deg", "--is-quiet", "--volume", "11")
    assert code == 0 and said.startswith(f"['a'] 2 {math.degrees(1 / 90) ** 2} True 11")
    assert (tmp_path / "a.txt").read_text() == "11"
    assert nerg("a", *output, "--times", "10")[0] == 2 and nerg("a", *output, "--volume", "12")[0] == 2
    assert nerg("a", "-o", str(tmp_path / "a.png"))[0] == 1
    code, said = nerg("a", *output, "--tone", "middle")
    assert code == 1 and all(text in said for text in ("--tone", '"high"', '"low"', "middle"))
    with pytest.raises(NergError) as error:
        play(["a"], times=2.5)
    assert error.value.parameters == {"times": ""}
    with pytest.raises(NergError):
        play(["a"], times=None)


def test_a_function_with_an_output_writes_during_its_work(monkeypatch, tmp_path, capsys):
    row = Row("record", f"{__name__}:record", "Record.", ("names",), computes=False)
    monkeypatch.setitem(ROWS, "record", row)
    monkeypatch.setattr(building, "TABLE", (row,))
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(["record", "a", "-o", str(tmp_path / "notes")])
    assert not end.value.code and (tmp_path / "notes").is_dir()
    assert capsys.readouterr().out == "recorded in None\n"
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(["record", "a", "-o", str(tmp_path / "more"), "--room", "b"])
    assert not end.value.code and capsys.readouterr().out == "recorded in b\n"
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(["record", "a"])
    assert end.value.code == 2


class Sheets:
    def save(self, path=None, parts=None):
        for file in filter(None, (path, parts)):
            Path(file).touch()


def write_down(*, parts: bool = False, progress: Progress = None):
    """Write music down.

    Parameters
    ----------
    parts : bool
        Whether each instrument has a sheet.
    """
    assert isinstance(progress, Reporter)
    progress.message(f"parts: {parts}")
    return Sheets()


def test_a_command_writes_further_files(monkeypatch, tmp_path, capsys):
    """An output that is not given is not written, and the function is told so."""
    row = Row("score", f"{__name__}:write_down", "", output="Score (.txt).", suffixes=(".txt",), computes=False)
    parts = {"parts": ("Parts (.txt).",)}

    def nerg(row, *line):
        monkeypatch.setitem(ROWS, "score", row)
        monkeypatch.setattr(building, "TABLE", (row,))
        with pytest.raises(SystemExit) as end:
            nerg_mi.cli.main(["score", *map(str, line)])
        files = {path.name for path in tmp_path.iterdir()}
        for path in tmp_path.iterdir():
            path.unlink()
        return end.value.code, files, capsys.readouterr().out.split("\n")[0]

    output, more = ("-o", tmp_path / "a.txt"), ("--parts", tmp_path / "b.txt")
    row = replace(row, more_outputs=parts)
    assert nerg(row, *output) == (0, {"a.txt"}, "parts: False")
    assert nerg(row, *output, *more) == (0, {"a.txt", "b.txt"}, "parts: True")
    assert nerg(row, *more) == (2, set(), "")
    assert nerg(row, *output, "--parts", tmp_path / "b.png")[:2] == (1, set())
    row = replace(row, suffices=True)
    assert nerg(row, *more)[:2] == (0, {"b.txt"})
    assert nerg(row)[:2] == (1, set())


def test_a_docstring_refers_to_the_texts_of_another_function():
    module = "nerg_mi.environment.conversion"
    mesh, points = (read_parameter_texts(read_signature(f"{module}:export_{name}")) for name in ("mesh", "points"))
    assert set(points) - set(mesh) == {"max_points"} and "grid cells" in points["resolution"]
    assert {name: points[name] for name in set(points) & set(mesh)} == {k: v for k, v in mesh.items() if k in points}


def show_help(*line):
    done = CliRunner().invoke(nerg_mi.cli.build_app(), [*line, "--help"])
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.parametrize("group", [(), ("rays",), ("train",)])
def test_descriptions_of_commands_are_complete(group):
    """No description ends in dots, at the width of 80 characters."""
    text = show_help(*group)
    assert "..." not in text.partition("Commands:")[2] and max(map(len, text.splitlines())) <= 80
    prefix = "".join(f"{word} " for word in group)
    listed = {name: entry.line for name, entry in find_commands().items() if name.startswith(prefix)}
    lines = [GROUPS.get(prefix + name.removeprefix(prefix).split()[0], line) for name, line in listed.items()]
    shown = "".join(text.split())
    assert lines and all("".join(line.split()) in shown for line in lines)


def test_help_of_an_import_shows_the_options_of_its_preset():
    shared = {o.flag: o for o in collect_shared_options()}
    shows = lambda text, flag: f"\n  {flag} " in text or f"\n  {flag}\n" in text
    plain = show_help("rays", "import")
    assert all(f"\n  {name} " in plain for name in list_preset_names())
    assert [flag for flag in shared if shows(plain, flag)] == ["--map"] and shows(plain, "--pseudonyms")
    for name in list_preset_names():
        text = show_help("rays", "import", f"--preset={name}")
        options = {o.flag for o in list_options(get_reader(name).Options) if o.flag}
        assert {flag for flag in shared if shows(text, flag)} == options
        assert "".join(get_reader(name).files.replace("`", "").split()) in "".join(text.split())
        assert shows(text, "--skip-bad-lines")
    assert show_help("rays", "import", "--preset", name) == text
    table = show_help("rays", "import", "--map", "origin=x,y,z")
    assert {flag for flag in shared if shows(table, flag)} == {
        o.flag for o in list_options(get_reader("table").Options)
    }


def test_help_of_an_unknown_preset_names_the_presets():
    done = CliRunner().invoke(nerg_mi.cli.build_app(), ["rays", "import", "--preset", "nothing", "--help"])
    assert "varjo" in str(done.exception)


# Options of colmap, pip, Python's server and torch-ngp, and the prefix of negated flags.
FOREIGN = set("--output_type --force-reinstall --bind --directory --tcnn --ff --color_space --bg_radius --no-".split())


@pytest.mark.parametrize("name", ROWS)
def test_rows_leave_out_existing_parameters(name):
    row = ROWS[name]
    parameters = inspect.signature(read_signature(row.function)).parameters
    settings = [p.default for p in parameters.values() if is_dataclass(p.default)]
    names = {*parameters, "mode", *(f.name for default in settings for f in fields(default))}
    assert set(row.without) <= names


def test_texts_name_existing_options():
    existing = {"--help", "--version", "--install-completion", "--show-completion", *DEBUG, *FOREIGN}
    for _, command, _ in iter_commands():
        existing.update(*((*p.opts, *p.secondary_opts) for p in command.params))
    package = Path(nerg_mi.cli.__file__).parent.parent
    unknown = []
    for path in sorted(package.rglob("*.py")):
        if path.relative_to(package).parts[0] == "scenes":  # scripts with own options
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                named = re.findall(r"(?<![\w-])--[a-z][\w-]*", node.value)
                unknown += [f"{path.relative_to(package)}: {name}" for name in named if name not in existing]
    assert not unknown
