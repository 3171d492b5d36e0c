"""What every benchmark writes beside the table that it prints."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from nerg_mi.files.tables import markdown_table, write_csv

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools.page import update


def write_rows(path: Path, rows: list[dict]) -> None:
    """Write ``rows`` as CSV, and say where."""
    write_csv(path, rows)
    print(f"wrote {path}")


def print_table(title: str, head: Sequence[str], rows: Sequence[Sequence], page: Path | None = None) -> None:
    """Print a table below its heading, and put it into the ``page`` of the documentation that has this heading."""
    print(f"### {title}\n")
    update(page, title, markdown_table(head, rows))
    print(flush=True)
