"""The pictures of docs/architecture.md, drawn from the code.

    python -m tools.architecture [--check]

With `--check` nothing is written: exit code 1 where a picture is not what the code says now.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

from tools import ray_path, rooms
from tools.imports import ROOT

PICTURES: dict[str, Callable[[], str]] = {
    "docs/images/rooms.svg": rooms.draw,
    "docs/images/ray.svg": lambda: ray_path.draw(ray_path.record()),
}
"""File -> what makes its text."""


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, and fail where a picture is out of date")
    options = parser.parse_args(arguments)
    stale = []
    for file, make in PICTURES.items():
        path, text = ROOT / file, make()
        if path.is_file() and path.read_text(encoding="utf-8") == text:
            continue
        stale.append(file)
        if not options.check:
            path.write_text(text, encoding="utf-8")
        print(f"{file} is out of date: run make docs" if options.check else f"wrote {file}")
    return int(options.check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
