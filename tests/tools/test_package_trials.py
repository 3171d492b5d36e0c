"""The tests that an installed package is tried with, and what a trial says of one that lacks an extra."""

from __future__ import annotations

import pytest

from tests.conftest import ROOT
from tools import package_trials
from tools.package_build import Failure


def test_tests_to_run_are_there():
    for path in package_trials.TESTS:
        assert (ROOT / "tests" / path).exists(), path


class Answering:
    """An environment whose commands all print the same."""

    def __init__(self, text: str):
        self.text = text

    def python(self, program):
        return "/store/scene.xml"

    def run(self, command, *arguments, code=0):
        return self.text


def test_an_extra_has_to_be_named_in_one_line(tmp_path):
    extras = ("bake", "cluster", "mesh", "parquet", "poses", "torch", "video")
    every = " ".join(f"nerg-mi[{extra}]" for extra in extras)
    assert package_trials.try_missing_extras(Answering(every), tmp_path) == "7 of 7"
    with pytest.raises(Failure, match=r"without nerg-mi\[mesh\]"):
        package_trials.try_missing_extras(Answering("something else"), tmp_path)
    with pytest.raises(Failure, match=r"without nerg-mi\[mesh\]"):
        package_trials.try_missing_extras(Answering(f"Traceback\n{every}"), tmp_path)
