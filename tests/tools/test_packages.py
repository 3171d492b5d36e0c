"""What the packages are held to: every file that is to be installed is, and floors are read as they are written."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tools import packages


def test_every_folder_with_modules_is_installed():
    """The list of packages is written out by hand, so that a new folder is easily forgotten."""
    text = (ROOT / "pyproject.toml").read_text()
    for name, installed in (("nerg_mi", "nerg_mi"), ("plugins", "nerg_mi.plugins"), ("scenes", "nerg_mi.scenes")):
        for path in (ROOT / name).rglob("__init__.py"):
            inner = path.parent.relative_to(ROOT / name).parts
            assert f'"{".".join([installed, *inner])}"' in text, path
        for path in (ROOT / name).rglob("*.py"):
            assert (path.parent / "__init__.py").is_file(), f"{path.parent} is no package"


def test_a_file_that_is_missing_is_named():
    tracked = ["README.md", ".ci/run", "nerg_mi/a/b.py", "plugins/p.py", "scenes/store/x.npz", "tests/test_a.py"]
    wheel = ["nerg_mi/a/b.py", "nerg_mi/plugins/p.py", "nerg_mi/scenes/store/x.npz"]
    assert packages.missing_from_wheel(tracked, wheel) == []
    assert packages.missing_from_wheel(tracked, wheel[:1]) == ["plugins/p.py", "scenes/store/x.npz"]
    sdist = [f"nerg_mi-1/{path}" for path in tracked if path != ".ci/run"]
    assert packages.missing_from_sdist(tracked, sdist) == []
    assert packages.missing_from_sdist(tracked, sdist[:-1]) == ["tests/test_a.py"]


def test_floors():
    metadata = "\n".join(
        [
            "Metadata-Version: 2.4",
            "Name: x",
            "Requires-Dist: mitsuba==3.9.*",
            "Requires-Dist: drjit",
            "Requires-Dist: trimesh<6,>=4",
            'Requires-Dist: torch>=2.2; extra == "torch"',
            'Requires-Dist: pyarrow>=15; extra == "parquet"',
            'Requires-Dist: pytest>=8; extra == "test"',
            "",
            "text >= 3",
        ]
    )
    assert packages.floors(metadata) == ["mitsuba==3.9.0", "trimesh==4", "pyarrow==15"]


def test_rows():
    assert [packages.Row.of(text).python for text in packages.ROWS] == ["3.10", "3.10", "3.11", "3.12", "3.13"]
    with pytest.raises(ValueError, match="write PYTHON/DEPENDENCIES/FROM"):
        packages.Row.of("3.12/newest")


def test_a_command_that_fails_is_told_with_what_it_said(tmp_path):
    with pytest.raises(packages.Failure, match="exit code 3.*something is wrong"):
        packages.run([sys.executable, "-c", "print('something is wrong'); raise SystemExit(3)"], tmp_path)


def test_an_interpreter_is_one_of_that_version():
    version = "%d.%d" % sys.version_info[:2]
    found = packages.interpreters({version, "3.99"})
    assert set(found) == {version}
    answer = subprocess.run([found[version], "--version"], capture_output=True, text=True).stdout
    assert f"Python {version}." in answer


def test_tests_to_run_are_there():
    for path in packages.TESTS:
        assert (Path(ROOT) / "tests" / path).exists(), path
