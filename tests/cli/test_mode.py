"""The Mitsuba variant is --mode for every command."""

import re

import pytest
import typer.main

import nerg_mi.cli
from nerg_mi.cli.mode import mode_of

FORMERLY = {"train radiance", "eval radiance", "import", "export mesh", "export points", "export volume"} | {
    "export torch-ngp"
}
"""Commands that called it --variant."""


def leaves(command, name=()):
    if hasattr(command, "commands"):
        for sub, found in command.commands.items():
            yield from leaves(found, (*name, sub))
    else:
        yield " ".join(name), command


def commands():
    out = {}
    for name in nerg_mi.cli.COMMANDS:
        found = typer.main.get_command(nerg_mi.cli.build_app(name)).commands[name]
        out |= dict(leaves(found, (name,)))
    return out


def test_every_command_that_computes_has_it():
    without = {"doctor", "jobs", "poses", "worker", "draw sheet", "draw difference"} | {
        name for name in commands() if name.startswith("rays ")
    }
    for name, command in commands().items():
        options = {option: p for p in command.params for option in p.opts}
        assert ("--mode" in options) == (name not in without), name
        assert name in without or "-m" in options
        if "--variant" in options:
            assert options["--variant"].hidden == (name in FORMERLY), name
        assert name not in FORMERLY or "--variant" in options


def test_the_former_name_is_told(capsys):
    assert mode_of("llvm_ad_rgb", None) == "llvm_ad_rgb" and not capsys.readouterr().err
    assert mode_of("llvm_ad_rgb", "cuda_ad_rgb") == "cuda_ad_rgb"
    assert "write --mode cuda_ad_rgb" in capsys.readouterr().err


def test_the_former_name_works(tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(["export", "points", str(tmp_path / "f"), "-o", str(tmp_path / "a.ply"), "--variant", "no"])
    said = capsys.readouterr().err
    assert end.value.code == 1 and re.search(r"note: --variant is now --mode .*\n.*there is no variant \"no\"", said)
