"""Output of results as CSV, JSON and Markdown, written atomically; and CSV files as spreadsheets write them."""

from __future__ import annotations

import csv
import json
import math
import os
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

from .atomic import replace_atomically, write_text
from .safe_read import open_file, read_line_blocks


def write_csv(path: str | os.PathLike, rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None) -> None:
    """Write ``rows`` as CSV with a header line.

    Missing values and NaN become empty cells. Text that a spreadsheet would evaluate as a formula is prefixed with an
    apostrophe (`escape_formula`).

    Parameters
    ----------
    path
        The file.
    rows
        One mapping from column name to value per row.
    columns
        Column names. Default: all keys in order of appearance. With ``columns``, rows are consumed one by one.

    Raises
    ------
    ValueError
        If a row has a key that is not in ``columns``.
    """
    if not columns:
        rows = list(rows)
        columns = list(dict.fromkeys(k for row in rows for k in row))
    with replace_atomically(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, restval="")
        csv.writer(file).writerow(map(escape_formula, columns))
        # Only NaN differs from itself.
        writer.writerows({k: escape_formula(v) for k, v in row.items() if v == v} for row in rows)


def join_reasons(reasons: Mapping[str, Sequence[str]]) -> str:
    """Join the reasons of missing values, with the names of the values; "" is no reason."""
    return "; ".join(f"{', '.join(dict.fromkeys(names))}: {reason}" for reason, names in reasons.items() if reason)


def add_notes(
    rows: Sequence[dict[str, Any]],
    explain: Callable[[Mapping[str, Any], str], tuple[str, str]],
    columns: Sequence[str] = (),
) -> None:
    """Set the ``note`` of each of ``rows``, which says why values of the table are missing (None, NaN or absent).

    Parameters
    ----------
    rows
        Rows of one table; an earlier ``note`` is replaced.
    explain
        Returns the name of a missing value in the note and the reason, from the row and the column.
    columns
        Columns of the table in addition to the keys of its rows.
    """
    names = dict.fromkeys((*columns, *(key for row in rows for key in row if key != "note")))
    for row in rows:
        reasons: dict[str, list[str]] = {}
        for column in names:
            value = row.get(column)
            # Only NaN differs from itself.
            if value is None or value != value:
                name, reason = explain(row, column)
                reasons.setdefault(reason, []).append(name)
        row.pop("note", None)
        row["note"] = join_reasons(reasons)


# Includes the full-width forms, which spreadsheets treat alike in some languages.
_FORMULA = re.compile(r"'*[=+\-@\t\r\uff1d\uff0b\uff0d\uff20].", re.DOTALL)


def escape_formula(value: Any) -> Any:
    """Return ``value`` as a CSV cell that a spreadsheet does not evaluate.

    Text that begins with ``=``, ``+``, ``-``, ``@``, a tab or a carriage return gets an apostrophe as a prefix, which
    marks text in spreadsheets. Numbers and lists of numbers ("-1, 2, 3") are unchanged. `unescape_formula` is the
    inverse.
    """
    return f"'{value}" if isinstance(value, str) and _FORMULA.match(value) and not _is_number_list(value) else value


def unescape_formula(cell: str) -> str:
    """Return the text from which `escape_formula` made the ``cell``."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def _is_number_list(text: str) -> bool:
    try:
        return bool([float(part) for part in text.split(",")])
    except ValueError:
        return False


def format_markdown_table(
    header: Sequence[str], rows: Iterable[Sequence[Any]], right_aligned: Collection[str] = ()
) -> str:
    """Format a Markdown table, without a line end.

    Vertical bars, line breaks, HTML and images in cells are escaped, except in code spans.

    Parameters
    ----------
    header
        Names of the columns.
    rows
        Cells, formatted by ``str``.
    right_aligned
        Names of the columns that are aligned to the right.
    """
    cells = [[_escape_markdown_cell(str(cell)) for cell in row] for row in (header, *rows)]
    rule = ["---:" if name in right_aligned else "---" for name in header]
    return "\n".join("| " + " | ".join(line) + " |" for line in (cells[0], rule, *cells[1:]))


# Matches code spans, whose content is not interpreted, and the start of a tag or an image that is not yet escaped.
_MARKUP = re.compile(r"(?<![\\`])(`+)(?!`).+?(?<!`)\1(?!`)|(?<!\\)((?:\\\\)*)(<(?=[A-Za-z/!?])|!(?=\[))")


def _escape_markdown_cell(text: str) -> str:
    text = re.sub(r"[\r\n]+", " ", text.replace("|", "\\|"))
    return _MARKUP.sub(lambda match: match[0] if match[1] else f"{match[2]}\\{match[3]}", text)


def write_json(path: str | os.PathLike, value: Any, allow_nan: bool | None = None) -> None:
    """Write ``value`` as indented JSON with a line end.

    Parameters
    ----------
    path
        The file.
    value
        The document.
    allow_nan
        None: NaN and infinities, which JSON lacks, become null. True: they are written as Python writes them, for files
        that only this package reads. False: they raise ``ValueError``.
    """
    value = _replace_non_finite(value) if allow_nan is None else value
    write_text(path, json.dumps(value, indent=1, allow_nan=bool(allow_nan)) + "\n")


def _replace_non_finite(value: Any) -> Any:
    """Return ``value`` with None in place of each number that is not finite."""
    if isinstance(value, Mapping):
        return {key: _replace_non_finite(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_non_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# ---- CSV of any spelling ----

SEPARATOR_LINE = re.compile(r'"?sep=(\\t|[^"])"?(?:[,;\t ]|\1)*', re.IGNORECASE)
"""A first line such as ``sep=;``, as Excel writes and reads it."""


def find_separator(line: str) -> str:
    """The most frequent separator of a header, outside of quotes and brackets if there is one."""
    outside = re.sub(r'"[^"]*"|\([^)]*\)|\[[^\]]*\]', "", line)
    return max(",;\t", key=lambda sign: (outside.count(sign), line.count(sign)))


def open_csv(path: str | os.PathLike, file_kind: str, max_bytes: int) -> Any:
    """Open a small CSV as a ``csv.reader``: UTF-8, or UTF-16 with a byte order mark; separated by what a first line
    such as ``sep=;`` states, else by the most frequent of comma, semicolon and tab in the header.

    Lines without a row are empty lists. Raises `NergError` for text of another encoding and more than ``max_bytes``.
    """
    with open_file(path, file_kind, max_bytes=max_bytes):
        lines = [line for block in read_line_blocks(path, file_kind, 1 << 16) for line in block]
    first = next((k for k, line in enumerate(lines) if not line.isspace()), None)
    if first is None:
        return csv.reader(())
    match = SEPARATOR_LINE.fullmatch(lines[first].rstrip("\r\n"))
    if not match:
        return csv.reader(lines, delimiter=find_separator(lines[first]), strict=True)
    lines[first] = "\n"
    return csv.reader(lines, delimiter=match[1].replace("\\t", "\t"), strict=True)
