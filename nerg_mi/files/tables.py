"""Tables and documents of results as files: CSV and JSON, whole or absent."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from .atomic import write_text


def write_csv(path: str | os.PathLike, rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None) -> None:
    """Write ``rows`` as CSV with a line of names first; what a row lacks stays empty.

    ``columns``: default, all keys in the order in which they appear. Raises ``ValueError`` for a row with others.
    """
    rows = list(rows)
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns or list(dict.fromkeys(k for row in rows for k in row)), restval="")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def write_json(path: str | os.PathLike, value: Any, allow_nan: bool = True) -> None:
    """Write ``value`` as JSON, indented, with a line end. ``allow_nan``: whether NaN may be in it, which JSON does not
    know."""
    write_text(path, json.dumps(value, indent=1, allow_nan=allow_nan) + "\n")
