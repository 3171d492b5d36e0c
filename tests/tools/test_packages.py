"""The rows that packages are tried in, and the interpreters for them."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tools import packages


def test_rows():
    assert [packages.Row.parse(text).python for text in packages.ROWS] == ["3.10", "3.10", "3.11", "3.12", "3.13"]
    with pytest.raises(ValueError, match="write PYTHON/DEPENDENCIES/FROM"):
        packages.Row.parse("3.12/newest")


def test_an_interpreter_is_one_of_that_version():
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    found = packages.interpreters({version, "3.99"})
    assert set(found) == {version}
    answer = subprocess.run([found[version], "--version"], capture_output=True, text=True).stdout
    assert f"Python {version}." in answer
