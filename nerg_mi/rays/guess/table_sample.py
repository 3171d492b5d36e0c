"""The first rows of a table: which of its columns hold numbers or times, and these."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.line_blocks import line_blocks
from nerg_mi.rays.readers.builder import BAD_LINES
from nerg_mi.rays.readers.parsing.clock_times import clock_seconds
from nerg_mi.rays.readers.parsing.tables import iterate_table

_PEEKED = 40  # lines that tell which columns hold numbers
_WORDS = {"", "nan", "na", "n/a", "null", "none", "-"}
_WIDEST = 400  # columns of which numbers are looked at


class TableSample:
    """At most 65,536 rows of those ``columns`` of a table that hold numbers; ``numbers[name]`` is (n,) float64.

    Times as text are seconds, and named in ``clocks``. A name that several columns have is none. Raises `NergError`
    where more than 1 % of the rows have more or fewer cells than the header.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self.path = path
        self.columns = [name for name in columns if list(columns).count(name) == 1]
        self.repeated = sorted(set(columns) - set(self.columns))
        kinds = _numeric(path, list(columns))
        wanted = [name for name in self.columns if name in kinds][:_WIDEST]
        for name in (wanted or self.columns)[:1]:
            self.texts(name)
        self.clocks = {name for name in wanted if kinds[name]}
        self.numbers: dict[str, np.ndarray] = {}
        # Cells that are no numbers are left to the import.
        clocks = dict.fromkeys(self.clocks, 1.0)
        for block in iterate_table(path, wanted, on_bad=lambda line, why: None, clocks=clocks):
            self.numbers = dict(zip(wanted, block.numbers.T))
            break
        self.rows = len(next(iter(self.numbers.values()), ()))

    def vector(self, names: Sequence[str]) -> np.ndarray:
        """Columns as (n, C); NaN for those that hold no numbers."""
        missing = np.full(self.rows, np.nan)
        return np.stack([self.numbers.get(name, missing) for name in names], axis=1)

    def texts(self, name: str) -> np.ndarray:
        """The cells of a column as they stand (n,)."""
        bad: list[tuple[int, str]] = []
        for block in iterate_table(self.path, (), [name], on_bad=lambda line, why: bad.append((line, why))):
            if len(bad) > max(1, BAD_LINES * len(block.lines)):
                break
            return block.texts[:, 0]
        if len(bad) > 1:
            raise NergError(f"{self.path}, line {bad[0][0]}{bad[0][1]}")
        return np.empty(0, str)


def _numeric(path: Path, columns: list[str]) -> dict[str, bool]:
    """Names of the columns that hold numbers or times alone, or nothing, and whether they hold times as text."""
    if path.suffix.lower() == ".parquet":
        return {name: kind for name in dict.fromkeys(columns) if (kind := _parquet_kind(path, name)) is not None}
    head, *rows = next(iter(line_blocks(path, "table", _PEEKED + 1)), [""])
    separator = max(",;\t", key=head.count)
    kinds: list[set[bool | None]] = [set() for _ in columns]
    for line in rows:
        try:
            cells = next(csv.reader([line], delimiter=separator), [])
        except csv.Error:
            continue
        for k, cell in enumerate(cells[: len(columns)]):
            if cell.strip().lower() not in _WORDS:
                kinds[k].add(_kind(cell))
    return {name: True in kind for name, kind in zip(columns, kinds) if kind in ({True}, {False})}


def _kind(cell: str) -> bool | None:
    """False of a number, True of a time, None of another text."""
    try:
        # Whether a comma is the decimal sign is left to the reader of the table.
        float(cell.replace(",", ".", 1))
    except ValueError:
        return True if clock_seconds(cell) else None
    return False


def _parquet_kind(path: Path, name: str) -> bool | None:
    for is_clock, clocks in ((False, None), (True, {name: 1.0})):
        try:
            next(iterate_table(path, [name], clocks=clocks), None)
        except NergError:
            continue
        return is_clock
    return None
