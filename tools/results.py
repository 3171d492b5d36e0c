"""Results of benchmarks: one JSON file each in benchmarks/results, with provenance, and their tables in the manual.

    python -m tools.results NAME [NAME ...]

runs the commands of these results again and replaces their files. Without this, a benchmark writes its results into
out/benchmarks/results only. On a page, a line ``<!-- result: NAME -->`` stands for a table; the build of the manual
inserts it.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from nerg_mi.files.atomic import make_folder, write_text
from nerg_mi.files.tables import format_markdown_table
from nerg_mi.tasks.task import read_processor_name

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "benchmarks" / "results"
LATEST = ROOT / "out" / "benchmarks" / "results"
"""Where benchmarks write."""
FIELDS = ("command", "seeds", "machine", "load", "versions", "commit", "date", "columns", "rows")
UNKNOWN = "not recorded"

_LOAD = os.getloadavg()[0]
_MARKER = re.compile(r"^<!-- result: ([\w-]+) -->$", re.M)


def save(name: str, columns: Sequence[str], rows: Sequence[Sequence[object]], seeds: str = "none") -> None:
    """Print a table, and write it with its provenance as the latest result ``name``.

    Parameters
    ----------
    name
        Name of the result and its file.
    columns, rows
        Titles and cells; numbers are rounded by the caller, to the digits that are significant.
    seeds
        Seeds of random numbers that determine the result.
    """
    print(f"### {name}\n\n{format_markdown_table(columns, rows)}\n", flush=True)
    cells = [list(map(str, row)) for row in rows]
    result = {"command": [_command()], "seeds": seeds, **describe_run(), "columns": list(columns), "rows": cells}
    make_folder(LATEST)
    write(LATEST / f"{name}.json", result)


def _command() -> str:
    """The command line of this process, relative to the checkout."""
    script = Path(sys.argv[0]).resolve()
    path = script.relative_to(ROOT) if script.is_relative_to(ROOT) else script
    program = f"-m tools.{path.stem}" if path.parent.name == "tools" else str(path)
    return shlex.join(["python", *program.split(), *sys.argv[1:]])


def describe_run() -> dict[str, str]:
    """The machine, its load when this module was imported, the versions, the commit and the date."""
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    packages = [f"{name} {version(name)}" for name in ("mitsuba", "drjit", "numpy")]
    return {
        "machine": f"{read_processor_name()}, {os.cpu_count()} cores",
        "load": f"{_LOAD:.1f}",
        "versions": ", ".join([f"Python {sys.version.split()[0]}", *packages]),
        "commit": commit.stdout.strip(),
        "date": datetime.date.today().isoformat(),
    }


def write(path: Path, result: dict) -> None:
    """Write ``result`` as JSON with one line per row."""
    head = [f"{json.dumps(key)}: {json.dumps(result[key], ensure_ascii=False)}" for key in FIELDS[:-1]]
    rows = ",\n  ".join(json.dumps(row, ensure_ascii=False) for row in result["rows"])
    text = ",\n ".join([*head, f'"rows": [\n  {rows}\n ]'])
    write_text(path, f"{{\n {text}\n}}\n")


def read(name: str, folder: Path | None = None) -> dict:
    """The result ``name``, by default the published one. Raises ``FileNotFoundError`` if there is none."""
    return json.loads(((folder or FOLDER) / f"{name}.json").read_text(encoding="utf-8"))


def format_result(name: str) -> str:
    """The table of a result, and a paragraph with its provenance."""
    result = read(name)
    numeric = [
        title
        for k, title in enumerate(result["columns"])
        if all(re.match(r"[-+.\d(<>]|$", row[k]) for row in result["rows"])
    ]
    table = format_markdown_table(result["columns"], result["rows"], numeric)
    parts = [result["date"], result["machine"], f"load {result['load']}", result["versions"]]
    parts += [f"commit {result['commit']}", f"seeds: {result['seeds']}"]
    recorded = "; ".join(part for part in parts if UNKNOWN not in part)
    missing = [key for key in ("date", "machine", "load", "versions", "commit", "seeds") if result[key] == UNKNOWN]
    provenance = f"{recorded}. Not recorded: {', '.join(missing)}." if missing else f"{recorded}."
    commands = "\n".join(result["command"])
    return f"{table}\n\n```sh\n{commands}\n```\n\n{provenance}\n"


def insert(page: str) -> str:
    """``page`` with the tables of its markers."""
    return _MARKER.sub(lambda match: format_result(match[1]), page)


def list_markers(page: str) -> list[str]:
    """The names of the results that ``page`` shows."""
    return _MARKER.findall(page)


def regenerate(names: Sequence[str]) -> None:
    """Run the commands of the results ``names``, each once, and replace the files.

    The commands of a file stay, because those before the last one prepare its inputs.
    """
    before = {name: read(name) for name in names}
    for commands in dict.fromkeys(tuple(result["command"]) for result in before.values()):
        for line in commands:
            print(line, flush=True)
            subprocess.run(_with_this_python(line), shell=True, cwd=ROOT, check=True)
    for name, result in before.items():
        write(FOLDER / f"{name}.json", read(name, LATEST) | {"command": result["command"]})


def _with_this_python(line: str) -> str:
    """``line`` with the Python and the `nerg` of this environment."""
    folder = Path(sys.executable).parent
    return re.sub(r"^(python|nerg) ", lambda match: f"{folder / match[1]} ", line)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", choices=sorted(path.stem for path in FOLDER.glob("*.json")), metavar="NAME")
    regenerate(parser.parse_args(arguments).names)
    return 0


if __name__ == "__main__":
    sys.exit(main())
