"""Old names of options: accepted on the command line and as keywords, and shown nowhere."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import pytest

import nerg_mi as nerg
from nerg_mi.cli.building import DEBUG, build_command
from nerg_mi.errors import NergError
from nerg_mi.old_names import _KEYWORDS, ALL, OLD_NAMES, renamed_options
from nerg_mi.workflows.base import COMMANDS, Command
from nerg_mi.workflows.gaze_commands import FoldOptions, GazeOptions
from tools.command_pages import iter_commands

# Options of colmap, pip, Python's server and torch-ngp, and the prefix of negated flags.
FOREIGN = set("--output_type --force-reinstall --bind --directory --tcnn --ff --color_space --bg_radius --no-".split())
PARSERS = {path.removeprefix("nerg "): command for path, command, _ in iter_commands()}


def spellings(command):
    return {name for p in PARSERS[command].params for name in (*p.opts, *p.secondary_opts)}


def test_each_row_names_an_option_of_its_command():
    assert {name for name in OLD_NAMES if name != ALL} <= PARSERS.keys()
    for command, old, new in renamed_options(PARSERS):
        where = PARSERS if command == ALL else (command,)
        if new.startswith("--"):
            assert any(new in spellings(name) for name in where), (command, new)
            assert command == ALL or old not in spellings(command), (command, old)
        else:
            assert new in {f.name for f in fields(COMMANDS[command].options)}, (command, new)


def test_texts_name_current_options():
    current = {"--help", "--version", *DEBUG, *FOREIGN}.union(*map(spellings, PARSERS))
    package = Path(nerg.__file__).parent
    unknown = []
    for path in sorted(package.rglob("*.py")):
        if path.name == "old_names.py" or path.relative_to(package).parts[0] == "scenes":  # scripts with own options
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                named = re.findall(r"(?<![\w-])--[a-z][\w-]*", node.value)
                unknown += [(str(path.relative_to(package)), name) for name in named if name not in current]
    assert not unknown


def run(kind, name, *line):
    made = []
    command = Command(name, lambda options, reporter: made.append(options), "", "", kind, (), None, {})
    build_command(command).main(list(line), standalone_mode=False)
    return made[0]


def test_old_spellings_are_accepted_on_the_command_line():
    line = "--voxel 0.5 --test-people=0.25 --normalized --zones 2 --variant emit --resume"
    made = run(GazeOptions, "train gaze", *line.split())
    assert (made.voxel_size, made.test_participants, made.normalize) == (0.5, 0.25, True)
    assert (made.validation_zones, made.variant, made.resume) == (2, "emit", True)


def test_a_value_equal_to_an_old_spelling_is_unchanged():
    assert run(FoldOptions, "eval folds", "--splits", "--cap").splits == "--cap"


def test_old_names_are_not_shown():
    for name, parser in PARSERS.items():
        with parser.make_context(name, [], resilient_parsing=True) as context:
            words = parser.get_help(context).replace(",", " ").split()
        assert not {old for _, old, _ in renamed_options([name]) if old.startswith("--")} & set(words) - spellings(
            name
        ), name


def test_old_keywords_are_accepted_in_python():
    made = GazeOptions(cap=7, mix_folds=2, fresh=True)
    assert (made.max_rays, made.prior_folds, made.resample_directions) == (7, 2, True)
    assert replace(made, cap=8).max_rays == 8
    assert FoldOptions(cap=3).max_rays == 3
    with pytest.raises(TypeError):
        GazeOptions(size_of_cap=1)


def test_functions_of_the_library_accept_old_keywords(rgb, tmp_path):
    with pytest.raises(NergError, match='no option "caps"'):
        nerg.train_gaze(tmp_path / "none.npz", caps=1)
    with pytest.raises(NergError, match="none.npz"):
        nerg.train_gaze(tmp_path / "none.npz", cap=1, weights="person", geometry="none")


ALONE = """
import importlib, json, sys
module = importlib.import_module(sys.argv[1])
print(json.dumps({name: getattr(getattr(module, name), "%s", {}) for name in sys.argv[2:]}))
"""


def test_old_keywords_do_not_depend_on_other_imports():
    expected: dict[str, dict[str, dict[str, str]]] = {}
    for command in COMMANDS.values():
        for kind in command.options.__mro__ if command.options else ():
            if _KEYWORDS in vars(kind):
                expected.setdefault(kind.__module__, {})[kind.__name__] = vars(kind)[_KEYWORDS]
    assert "StatisticsOptions" in expected["nerg_mi.aoi.options"]
    for module, keywords in expected.items():
        line = [sys.executable, "-c", ALONE % _KEYWORDS, module, *keywords]
        done = subprocess.run(line, capture_output=True, text=True, check=True)
        assert json.loads(done.stdout) == keywords, module
