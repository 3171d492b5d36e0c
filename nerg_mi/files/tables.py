"""Tables and documents of results: CSV and JSON files, whole or absent, and Markdown."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from .atomic import replacing, write_text


def write_csv(path: str | os.PathLike, rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None) -> None:
    """Write ``rows`` as CSV with a line of names first; what a row lacks stays empty.

    ``columns``: default, all keys in the order in which they appear; where they are given, rows are taken one by one.
    Raises ``ValueError`` for a row with others.
    """
    if not columns:
        rows = list(rows)
        columns = list(dict.fromkeys(k for row in rows for k in row))
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[Any]], right: Collection[str] = ()) -> str:
    """A Markdown table of cells as ``str`` shows them, without a line end; bars and line breaks in cells are escaped.

    ``right``: those columns of ``head`` that are aligned to the right.
    """
    cells = [[str(c).replace("|", "\\|").replace("\n", " ") for c in row] for row in (head, *rows)]
    rule = ["---:" if name in right else "---" for name in head]
    return "\n".join("| " + " | ".join(line) + " |" for line in (cells[0], rule, *cells[1:]))


def write_json(path: str | os.PathLike, value: Any, allow_nan: bool = True) -> None:
    """Write ``value`` as JSON, indented, with a line end. ``allow_nan``: whether NaN may be in it, which JSON does not
    know."""
    write_text(path, json.dumps(value, indent=1, allow_nan=allow_nan) + "\n")
