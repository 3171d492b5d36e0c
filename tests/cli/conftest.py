"""Fixtures that run `nerg` in this process, and the inputs of several test files."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from nerg_mi.cli import main
from tests.cli.outputs import list_trainings, make_inputs


class Ended(NamedTuple):
    """The exit code of a command, and its output."""

    code: int
    out: str
    err: str


@pytest.fixture
def nerg(capsys):
    """A function that runs a command."""

    def run(*arguments) -> Ended:
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            main([str(a) for a in arguments])
        return Ended(end.value.code or 0, *capsys.readouterr())

    return run


@pytest.fixture(scope="session")
def inputs(tmp_path_factory):
    """The inputs of the commands of `outputs.CASES`."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    folder = make_inputs(tmp_path_factory.mktemp("inputs"))
    for line in list_trainings(folder):
        with pytest.raises(SystemExit) as end:
            main(line)
        assert not end.value.code
    return folder
