"""The Mitsuba variant is --mode for every command."""

import re

import pytest

import nerg_mi.cli
from tools.command_pages import commands


def test_every_command_that_computes_has_it():
    without = {"doctor", "jobs", "poses", "worker", "draw sheet", "draw difference"}
    for path, command, _ in commands():
        name = path.removeprefix("nerg ")
        options = {option: p for p in command.params for option in p.opts}
        assert ("--mode" in options) == (name not in without and not name.startswith("rays ")), name
        assert ("-m" in options) == ("--mode" in options)
        # The former name, or the factors of a gaze field.
        assert ("--variant" in options) == ("--mode" in options), name
        factors = name in ("train gaze", "eval folds", "ablate")
        assert "--variant" not in options or options["--variant"].hidden != factors, name


def test_the_former_name_works(tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(["export", "points", str(tmp_path / "f"), "-o", str(tmp_path / "a.ply"), "--variant", "no"])
    said = capsys.readouterr().err
    assert end.value.code == 1 and re.search(r"note: --variant is now --mode .*\n.*there is no variant \"no\"", said)
