"""Tables and documents of results: CSV and JSON files, whole or absent, and Markdown."""

from __future__ import annotations

import csv
import json
import math
import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from .atomic import replace_atomically, write_text


def write_csv(path: str | os.PathLike, rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None) -> None:
    """Write ``rows`` as CSV with a line of names first; what a row lacks, and NaN, stays empty, and text that a
    spreadsheet would run as a formula gets an apostrophe before it (`without_formula`).

    ``columns``: default, all keys in the order in which they appear; where they are given, rows are taken one by one.
    Raises ``ValueError`` for a row with others.
    """
    if not columns:
        rows = list(rows)
        columns = list(dict.fromkeys(k for row in rows for k in row))
    with replace_atomically(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, restval="")
        csv.writer(file).writerow(map(escape_formula, columns))
        # NaN alone is no equal of itself.
        writer.writerows({k: escape_formula(v) for k, v in row.items() if v == v} for row in rows)


# Also the wide forms that spreadsheets take for the same in some languages.
_FORMULA = re.compile(r"'*[=+\-@\t\r\uff1d\uff0b\uff0d\uff20].", re.DOTALL)


def escape_formula(value: Any) -> Any:
    """``value`` as a cell of CSV: text that begins with ``=``, ``+``, ``-``, ``@``, a tab or a carriage return has an
    apostrophe before it, by which spreadsheets know text. Numbers, and several of them ("-1, 2, 3"), stay as they are.
    `with_formula` gives the text back."""
    return f"'{value}" if isinstance(value, str) and _FORMULA.match(value) and not _is_numbers(value) else value


def unescape_formula(cell: str) -> str:
    """The text that `without_formula` made the ``cell`` of."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def _is_numbers(text: str) -> bool:
    try:
        return bool([float(part) for part in text.split(",")])
    except ValueError:
        return False


def format_markdown_table(header: Sequence[str], rows: Iterable[Sequence[Any]], right_aligned: Collection[str] = ()) -> str:
    """A Markdown table of cells as ``str`` shows them, without a line end; bars, line breaks, HTML and images in
    cells are escaped, but for code spans.

    ``right``: those columns of ``head`` that are aligned to the right.
    """
    cells = [[_markdown_cell(str(cell)) for cell in row] for row in (header, *rows)]
    rule = ["---:" if name in right_aligned else "---" for name in header]
    return "\n".join("| " + " | ".join(line) + " |" for line in (cells[0], rule, *cells[1:]))


# Code spans, in which nothing runs; else the start of a tag or an image, unless it is escaped already.
_MARKUP = re.compile(r"(?<![\\`])(`+)(?!`).+?(?<!`)\1(?!`)|(?<!\\)((?:\\\\)*)(<(?=[A-Za-z/!?])|!(?=\[))")


def _markdown_cell(text: str) -> str:
    text = re.sub(r"[\r\n]+", " ", text.replace("|", "\\|"))
    return _MARKUP.sub(lambda match: match[0] if match[1] else f"{match[2]}\\{match[3]}", text)


def write_json(path: str | os.PathLike, value: Any, allow_nan: bool | None = None) -> None:
    """Write ``value`` as JSON, indented, with a line end.

    NaN and infinities, which JSON does not know, become null. ``allow_nan``: True leaves them as they are, for files
    that only this program reads; with False they are a ``ValueError``.
    """
    value = _with_null(value) if allow_nan is None else value
    write_text(path, json.dumps(value, indent=1, allow_nan=bool(allow_nan)) + "\n")


def _with_null(value: Any) -> Any:
    """``value`` with None in place of each number that is not finite."""
    if isinstance(value, Mapping):
        return {key: _with_null(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_with_null(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
