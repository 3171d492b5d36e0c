"""The packages as others meet them: built, installed where nothing else is, and tried from outside of the checkout.

    python -m tools.packages [--row PYTHON/DEPENDENCIES/FROM ...] [--work FOLDER] [--update docs/trust.md]

Each row is one empty environment: PYTHON such as 3.12, DEPENDENCIES `oldest` (the floors that the package names) or
`newest`, FROM `wheel` or `sdist`. Tried in it from `/`: the version, the demo, a render of the installed scene, the
sentence of each extra that is missing, and then, with the test extra, the quick tests as the source archive holds them.
Interpreters are those of PATH and of pyenv; a row whose interpreter is missing says so. Exit code 1 where a row fails.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from tools.package_build import Failure, build, floors, metadata_of
from tools.package_trials import Environment, try_commands, try_missing_extras, try_tests
from tools.page import table, update

ROWS = ("3.10/oldest/wheel", "3.10/newest/sdist", "3.11/newest/wheel", "3.12/newest/wheel", "3.13/newest/sdist")


@dataclass
class Row:
    """One line of the table: what was asked for, and what became of each trial."""

    python: str
    dependencies: str
    source: str
    demo: str = "-"
    extras: str = "-"
    tests: str = "-"
    result: str = "works"
    versions: dict[str, str] = field(default_factory=dict)

    @staticmethod
    def parse(text: str) -> Row:
        """The row that `PYTHON/DEPENDENCIES/FROM` asks for. Raises `ValueError` for another text."""
        match = re.fullmatch(r"(3\.\d+)/(oldest|newest)/(wheel|sdist)", text)
        if match is None:
            raise ValueError(f'"{text}" is no row: write PYTHON/DEPENDENCIES/FROM, such as 3.12/newest/wheel')
        return Row(*match.groups())

    def cells(self) -> list[str]:
        shown = ", ".join(
            f"{name} {self.versions[name]}" for name in ("mitsuba", "numpy", "scipy") if name in self.versions
        )
        given = f"{self.dependencies}: {shown}" if shown else self.dependencies
        return [
            self.versions.get("python", self.python),
            given,
            self.source,
            self.demo,
            self.extras,
            self.tests,
            self.result,
        ]


HEAD = ("Python", "Dependencies", "Built from", "Demo and render", "Missing extras told", "Tests", "Result")


def interpreters(wanted: set[str]) -> dict[str, Path]:
    """The interpreters found for the versions ``wanted`` ("3.12"): of PATH, else of pyenv."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = {}
    for version in wanted:
        here = [shutil.which(f"python{version}"), sys.executable, *sorted(pyenv.glob(f"{version}.*/bin/python"))]
        for python in filter(None, here):
            # A name on PATH may be pyenv's, which only says that this version is not switched on.
            probe = "import sys, venv; print('%d.%d' % sys.version_info[:2])"
            answer = subprocess.run([python, "-c", probe], capture_output=True, text=True)
            if answer.returncode == 0 and answer.stdout.strip() == version:
                found[version] = Path(python)
                break
    return found


def try_row(row: Row, interpreter: Path | None, wheel: Path, sdist: Path, unpacked: Path, work: Path) -> None:
    """Fill in what became of ``row``."""
    if interpreter is None:
        row.result = f"not tried: no Python {row.python} here"
        return
    folder = work / f"{row.python}-{row.dependencies}-{row.source}"
    folder.mkdir()
    (work / "home").mkdir(exist_ok=True)
    pinned = floors(metadata_of(wheel)) if row.dependencies == "oldest" else []
    try:
        there = Environment(
            folder / "env", interpreter, wheel if row.source == "wheel" else sdist, pinned, work / "home"
        )
        row.versions = there.versions()
        row.versions["python"] = there.python("import platform; print(platform.python_version())")
        row.extras = try_missing_extras(there, folder)
        row.demo = try_commands(there, folder)
        row.tests = try_tests(there, unpacked, folder)
    except Failure as failure:
        row.result = f"fails: {failure}"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--row", action="append", type=Row.parse, metavar="PYTHON/DEPENDENCIES/FROM")
    parser.add_argument("--work", type=Path, help="empty folder to work in, which is kept")
    parser.add_argument("--update", type=Path, help="page whose table is exchanged")
    options = parser.parse_args(arguments)
    rows = options.row or [Row.parse(text) for text in ROWS]
    found = interpreters({row.python for row in rows})
    with tempfile.TemporaryDirectory(prefix="nerg-packages-") as made:
        work = (options.work or Path(made)).resolve()
        work.mkdir(parents=True, exist_ok=True)
        sdist, wheel = build(work)
        (unpacked,) = (work / "unpacked").iterdir()
        for row in rows:
            begun = f"{row.python}, {row.dependencies} dependencies, from the {row.source} ..."
            print(begun, file=sys.stderr, flush=True)
            try_row(row, found.get(row.python), wheel, sdist, unpacked, work)
            print(" | ".join(row.cells()), file=sys.stderr, flush=True)
    update(options.update, "Versions", table(HEAD, [row.cells() for row in rows]))
    return int(any(row.result.startswith("fails") for row in rows))


if __name__ == "__main__":
    sys.exit(main())
