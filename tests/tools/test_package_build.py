"""What the packages hold: every file that is to be installed, and floors as they are written."""

from __future__ import annotations

import sys

import pytest

from tests.conftest import ROOT
from tools import package_build


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
    assert package_build.missing_from_wheel(tracked, wheel) == []
    assert package_build.missing_from_wheel(tracked, wheel[:1]) == ["plugins/p.py", "scenes/store/x.npz"]
    sdist = [f"nerg_mi-1/{path}" for path in tracked if path != ".ci/run"]
    assert package_build.missing_from_sdist(tracked, sdist) == []
    assert package_build.missing_from_sdist(tracked, sdist[:-1]) == ["tests/test_a.py"]


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
    assert package_build.floors(metadata) == ["mitsuba==3.9.0", "trimesh==4", "pyarrow==15"]


def test_a_command_that_fails_is_told_with_what_it_said(tmp_path):
    with pytest.raises(package_build.Failure, match="exit code 3.*something is wrong"):
        package_build.run([sys.executable, "-c", "print('something is wrong'); raise SystemExit(3)"], tmp_path)
