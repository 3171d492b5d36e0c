"""Check of the notes on missing values in tables of results."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def is_missing(value: Any) -> bool:
    """Whether a value is None, NaN, or an empty cell of a CSV file."""
    return value is None or value != value or value == ""


def find_wrong_notes(rows: Iterable[Mapping[str, Any]], columns: Sequence[str] = ()) -> list[Mapping[str, Any]]:
    """Return the rows without a note although a value of the table is missing, and those with a note without need."""
    rows = list(rows)
    names = dict.fromkeys((*columns, *(key for row in rows for key in row if key != "note")))
    return [row for row in rows if bool(row["note"]) != any(is_missing(row.get(name)) for name in names)]
