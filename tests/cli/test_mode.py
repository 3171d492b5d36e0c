"""The Mitsuba variant is --mode for every command."""

import re

import pytest

import nerg_mi.cli
from tools.command_pages import commands


def test_commands_that_compute_have_it():
    having = set()
    for path, command, _ in commands():
        name = path.removeprefix("nerg ")
        options = {option: p for p in command.params for option in p.opts}
        having |= {name} if "--mode" in options else set()
        assert ("-m" in options) == ("--mode" in options)
        # The former name, or the factors of a gaze field.
        assert ("--variant" in options) == ("--mode" in options), name
        factors = name in ("train gaze", "eval folds", "ablate")
        assert "--variant" not in options or options["--variant"].hidden != factors, name
    groups = ("train", "eval", "export", "draw")
    assert having >= {"align", "bake", "demo", "refine", "render", "report", "scene", "stats", "study", "view"}
    assert all(any(name.startswith(f"{group} ") for name in having) for group in groups)


def test_the_former_name_works(tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(["export", "points", str(tmp_path / "f"), "-o", str(tmp_path / "a.ply"), "--variant", "no"])
    said = capsys.readouterr().err
    assert end.value.code == 1 and re.search(r"note: --variant is now --mode .*\n.*there is no variant \"no\"", said)
