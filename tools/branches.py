"""Which branches of the package the tests reach: `make coverage`.

    python -m tools.branches [--update docs/trust.md] [-- ARGUMENTS OF PYTEST]

Runs the tests under coverage.py, those that start processes of their own included, and prints lines and branches of
each part, and the files that are reached least. What Dr.Jit traces counts as reached when Python has recorded it,
whatever its kernels did.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

from tools.page import table, update

ROOT = Path(__file__).resolve().parents[1]
HEAD = ("Part", "Statements", "reached", "Branches", "reached", "Together")
_LEAST = 6
"""So many files are named that are reached least."""


def part_of(path: str) -> str:
    """The part of the package that a file belongs to: ``nerg_mi/field``, or ``nerg_mi`` for a module of its own."""
    return path.rsplit("/", 1)[0] if "/" in path else path


def summarise(report: dict) -> list[list[str]]:
    """Rows of the table from coverage.py's JSON ``report``: a part each, and all together."""
    sums: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    for path, entry in report["files"].items():
        for name in (part_of(path), "all"):
            for key in ("num_statements", "covered_lines", "num_branches", "covered_branches"):
                sums[name][key] += entry["summary"][key]
    return [_row(name, sums[name]) for name in [*sorted(n for n in sums if n != "all"), "all"]]


def _row(name: str, s: dict[str, int]) -> list[str]:
    both, reached = s["num_statements"] + s["num_branches"], s["covered_lines"] + s["covered_branches"]
    share = lambda part, whole: f"{100 * part / whole:.1f} %" if whole else "-"
    return [
        name,
        f"{s['num_statements']:,}",
        share(s["covered_lines"], s["num_statements"]),
        f"{s['num_branches']:,}",
        share(s["covered_branches"], s["num_branches"]),
        share(reached, both),
    ]


def least(report: dict) -> list[str]:
    """The files that are reached least, each with its share and the first lines that nothing reaches."""
    files = sorted(report["files"].items(), key=lambda item: item[1]["summary"]["percent_covered"])
    return [
        f"{path}: {entry['summary']['percent_covered']:.1f} %, lines {', '.join(map(str, entry['missing_lines'][:12]))}"
        for path, entry in files[:_LEAST]
        if entry["missing_lines"]
    ]


def measure(arguments: list[str]) -> tuple[int, dict]:
    """Exit code of pytest with ``arguments``, and coverage.py's report as JSON."""
    with tempfile.TemporaryDirectory(prefix="nerg-coverage-") as folder:
        env = {**os.environ, "COVERAGE_FILE": str(Path(folder) / "data")}
        coverage = [sys.executable, "-m", "coverage"]
        tests = subprocess.run([*coverage, "run", "-m", "pytest", "-q", *arguments], cwd=ROOT, env=env)
        subprocess.run([*coverage, "combine", "-q"], cwd=ROOT, env=env, check=True)
        subprocess.run(
            [*coverage, "json", "-q", "-o", str(Path(folder) / "report.json")], cwd=ROOT, env=env, check=True
        )
        return tests.returncode, json.loads((Path(folder) / "report.json").read_text())


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--update", type=Path, help="page whose table is exchanged")
    parser.add_argument("tests", nargs="*", help="arguments of pytest, behind --")
    options = parser.parse_args(arguments)
    code, report = measure(options.tests)
    update(options.update, "Coverage", table(HEAD, summarise(report)))
    print("\nReached least:", *least(report), sep="\n  ")
    return code


if __name__ == "__main__":
    sys.exit(main())
