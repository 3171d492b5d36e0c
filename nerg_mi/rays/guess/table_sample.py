"""The first rows of a table: which of its columns hold numbers, and these."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.line_blocks import line_blocks
from nerg_mi.rays.readers.parsing.tables import iterate_table

_PEEKED = 40  # lines that tell which columns hold numbers
_WORDS = {"", "nan", "na", "n/a", "null", "none", "-"}
_WIDEST = 400  # columns of which numbers are looked at


class TableSample:
    """At most 65,536 rows of those ``columns`` of a table that hold numbers; ``numbers[name]`` is (n,) float64."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self.path, self.columns = path, list(columns)
        wanted = _numeric(path, self.columns)[:_WIDEST]
        self.numbers: dict[str, np.ndarray] = {}
        # Lines that cannot be read are left to the import.
        for block in iterate_table(path, wanted, on_bad=lambda line, why: None):
            self.numbers = dict(zip(wanted, block.numbers.T))
            break
        self.rows = len(next(iter(self.numbers.values()), ()))

    def vector(self, names: Sequence[str]) -> np.ndarray:
        """Columns as (n, C); NaN for those that hold no numbers."""
        missing = np.full(self.rows, np.nan)
        return np.stack([self.numbers.get(name, missing) for name in names], axis=1)


def _numeric(path: Path, columns: list[str]) -> list[str]:
    """Names, each once, of the columns that hold numbers alone, or nothing."""
    names = list(dict.fromkeys(columns))
    if path.suffix.lower() == ".parquet":
        return [name for name in names if _holds_numbers(path, name)]
    head, *rows = next(iter(line_blocks(path, "table", _PEEKED + 1)), [""])
    separator = max(",;\t", key=head.count)
    good = [True] * len(columns)
    seen = [False] * len(columns)
    for line in rows:
        try:
            cells = next(csv.reader([line], delimiter=separator), [])
        except csv.Error:
            continue
        for k, cell in enumerate(cells[: len(columns)]):
            if cell.strip().lower() not in _WORDS:
                good[k], seen[k] = good[k] and _is_number(cell), True
    known = {name: good[k] and seen[k] for k, name in reversed(list(enumerate(columns)))}
    return [name for name in names if known[name]]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _holds_numbers(path: Path, name: str) -> bool:
    try:
        next(iterate_table(path, [name]), None)
    except NergError:
        return False
    return True
