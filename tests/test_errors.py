"""Tests of messages that mention parameters."""

from __future__ import annotations

import ast
import pickle
import re
from pathlib import Path

import pytest

import nerg_mi as nerg
from nerg_mi.cli import main
from nerg_mi.cli.building import choose_spelling
from nerg_mi.errors import MissingFile, NergError, clean_text, parameter, sanitize, spell_command_line, spell_parameters


def test_parameters_are_spelled_where_a_message_is_shown():
    options = parameter("recipe", "small"), parameter("resume", True), parameter("seed")
    error = NergError(f"{parameter('test_share', 0.2)} needs {', '.join(options)}", kind="missing")
    assert str(error) == 'test_share=0.2 needs recipe="small", resume=True, seed'
    on_command_line = "--test-share 0.2 needs --recipe small, --resume, --seed"
    assert spell_parameters(error.message, spell_command_line) == on_command_line
    assert error.parameters == {"test_share": "0.2", "recipe": "small", "resume": "True", "seed": ""}
    copy = pickle.loads(pickle.dumps(error))
    assert (str(copy), copy.kind, copy.parameters) == (str(error), "missing", error.parameters)


def test_a_missing_file_mentions_parameters():
    assert str(MissingFile(f"correct {parameter('field', 'FILE')}")) == "correct field=FILE"


def test_texts_are_spelled_for_python_unless_told_otherwise():
    text = parameter("depth", False)
    assert clean_text(text) == "depth=False" and clean_text(text, spell_command_line) == "--no-depth"
    assert clean_text(sanitize(text)) == "depth=False"
    assert spell_command_line("unbounded", "False", "--unbounded/--bounded") == "--bounded"
    assert spell_command_line("unbounded", "True", "--unbounded/--bounded") == "--unbounded"
    scene_type = parameter("unbounded", False)
    assert clean_text(scene_type, choose_spelling(["train", "radiance"])) == "--bounded"
    # Limits that a command has no options for are set in Python.
    limit = parameter("max_step", 0.3)
    assert clean_text(limit, choose_spelling(["draw", "scanpath"])) == "max_step=0.3"
    assert clean_text(parameter("columns", "t=time")) == 'columns="t=time"'


# ---- Messages of the package ----

DECLARING = {"option", "argument", "extra", "out", "setting", "command", "check", "HelpView"}
"""Functions whose texts are help of the command line, or of its manual."""

COMMAND = re.compile(r"`[^`]*`|\b(nerg [a-z]|python3? -m |pip install )[^;()\"]*")
OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")


def list_texts(tree):
    """Yield the strings of a module that are neither docstrings nor help, with {} for each expression in them."""
    if isinstance(tree, ast.Expr) and isinstance(tree.value, ast.Constant):
        return
    if isinstance(tree, ast.Call) and getattr(tree.func, "id", getattr(tree.func, "attr", "")) in DECLARING:
        return
    if isinstance(tree, ast.JoinedStr):
        yield tree.lineno, "".join(v.value if isinstance(v, ast.Constant) else "{}" for v in tree.values)
    elif isinstance(tree, ast.Constant) and isinstance(tree.value, str):
        yield tree.lineno, tree.value
    for child in ast.iter_child_nodes(tree):
        if not isinstance(tree, ast.JoinedStr) or isinstance(child, ast.FormattedValue):
            yield from list_texts(child)


def test_messages_mention_parameters_and_no_options():
    assert OPTION.findall(COMMAND.sub("", 'add --steps 3 to "nerg train gaze --seed 1"; or --no-depth')) == [
        "--steps",
        "--no-depth",
    ]
    package = Path(nerg.__file__).parent
    wrong = []
    for path in sorted(package.rglob("*.py")):
        if path.relative_to(package).parts[0] in ("cli", "scenes"):
            continue
        for line, text in list_texts(ast.parse(path.read_text(encoding="utf-8"))):
            # A text without a space before the option is a part of a command.
            if re.search("[ (]--", text) and (options := OPTION.findall(COMMAND.sub("", text))):
                wrong.append(f"{path.relative_to(package)}:{line}: {', '.join(options)}")
    assert not wrong, "\n".join(wrong)


# ---- The same refusals on the command line and in Python ----


def spelled(command, text):
    """Return ``text`` as the command line shows it."""
    return clean_text(text, choose_spelling([*command.split(), "a", "-o", "b"]))


@pytest.mark.parametrize(
    "command, name, value, expected",
    [
        ("train gaze", "test_zones", 3, "--test-zones 3"),
        ("train gaze", "resume", True, "--resume"),
        ("train gaze", "rays", "", "RAYS"),
        ("train radiance", "depth", False, "--no-depth"),
        ("rays import", "handedness", "", "--hand"),
        ("rays import", "place", "FIELD", "--field FIELD"),
        ("rays filter", "persons", "NAME", "--person NAME"),
        ("eval gaze", "test_zones", 3, "--test-zones 3"),
        ("rays show", "columns", "t=time", "--map t=time"),
        ("render", "defaults", "", "--define"),
    ],
)
def test_the_command_line_spells_its_own_options(command, name, value, expected):
    assert spelled(command, parameter(name, value)) == expected


def test_refusals_are_spelled_where_they_are_shown(tmp_path, capsys):
    rays, output = tmp_path / "a.npz", tmp_path / "b.npz"
    rays.touch()
    with pytest.raises(NergError) as error:
        nerg.filter_rays(rays, merge_fixations=True)
    assert {"merge_fixations", "fixations"} <= set(error.value.parameters)
    assert "merge_fixations=True" in str(error.value) and "--" not in str(error.value)
    with pytest.raises(SystemExit):
        main(["rays", "filter", str(rays), "-o", str(output), "--merge-fixations"])
    shown = capsys.readouterr().err
    assert "--merge-fixations" in shown and "--fixations ivt" in shown and "=" not in shown
