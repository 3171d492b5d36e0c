"""Tables of rays: CSV (also ``.gz``) and Parquet, read by named columns."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain, reading, size_of
from nerg_mi.files.inflating import inflated_limit
from nerg_mi.files.line_blocks import OnBadLine, line_blocks
from nerg_mi.rays.io import pyarrow_modules

BLOCK = 1 << 16  # rows converted at a time: memory stays bounded

COLUMNS = 1 << 14
"""A table may have so many columns."""

TEXT_CHARACTERS = 1000
"""So many characters may a cell have that is read as text."""

# Cells of an array of text all take the space of the longest: rows times its characters, at four bytes each.
_TEXT_BLOCK = 1 << 26

# Memory of a row that is read, at least.
_ROW_BYTES = 32

_MISSING = {"", "nan", "na", "n/a", "null", "none", "-"}


class TableBlock(NamedTuple):
    """A run of n rows of a table."""

    numbers: np.ndarray  # (n, C) float64 in the order asked, NaN where a cell is empty
    texts: np.ndarray  # (n, T) str
    lines: np.ndarray  # (n,) 1-based lines of the file; rows for Parquet


def table_columns(path: str | os.PathLike) -> list[str]:
    """Names of a table's columns; of a CSV those of its first line. Raises `NergError` for a damaged file."""
    if str(path).lower().endswith(".parquet"):
        with _parquet(path) as table:
            return list(table.schema_arrow.names)
    with closing(line_blocks(path, "table", 1)) as blocks:
        return _header(path, next(blocks, [""])[0])[0]


def iterate_table(
    path: str | os.PathLike,
    numbers: Sequence[str],
    texts: Sequence[str] = (),
    header: Sequence[str] | None = None,
    on_bad: OnBadLine | None = None,
) -> Iterator[TableBlock]:
    """Yield named columns of a table in blocks of at most ``BLOCK`` rows.

    The separator (comma, semicolon or tab) is taken from the header. Cells
    that are empty or say nan, na, null or none are NaN. ``header``: the names
    of the columns of a CSV whose first line is none. Raises `NergError`
    for a damaged file, a missing column (naming those there are), and, unless ``on_bad`` is given, a row with too few
    cells or a cell that is no number (naming its line); ``on_bad`` is told of such lines, which are left out. Where
    pyarrow is installed it converts the cells, to the same numbers.
    """
    if str(path).lower().endswith(".parquet"):
        yield from _iterate_parquet(path, numbers, texts)
        return
    count, layout, convert = 0, None, None
    for raw in line_blocks(path, "table", BLOCK):
        if layout is None:
            columns, separator = (list(header), ",") if header is not None else _header(path, raw[0])
            if header is None:
                raw, count = raw[1:], 1
            layout = _layout(path, separator, columns, numbers, texts)
            convert = _fast_reader(layout)
        blank = [line.isspace() for line in raw]
        lines = count + 1 + np.flatnonzero(~np.array(blank, dtype=bool))
        kept = raw if len(lines) == len(raw) else [line for line, gone in zip(raw, blank) if not gone]
        count += len(raw)
        if kept:
            found = convert(kept) if convert else None
            block = TableBlock(*found, lines) if found else _convert(path, kept, lines, layout, on_bad)
            if len(block.lines):
                yield block
    if layout is None and header is None:
        _require(path, [*numbers, *texts], [])


class _Layout(NamedTuple):
    """Where in the lines of a CSV the wanted cells stand."""

    separator: str
    columns: list[str]  # of the file
    number_at: list[int]  # places among them of the columns of numbers
    text_at: list[int]  # and of texts


def _layout(
    path: str | os.PathLike, separator: str, columns: list[str], numbers: Sequence[str], texts: Sequence[str]
) -> _Layout:
    """Of columns with the same name the first is meant. Raises `NergError` where one is missing."""
    _require(path, [*numbers, *texts], columns)
    where = {c: i for i, c in reversed(list(enumerate(columns)))}
    return _Layout(separator, columns, [where[c] for c in numbers], [where[c] for c in texts])


def _header(path: str | os.PathLike, line: str) -> tuple[list[str], str]:
    """Column names and the separator between them."""
    line = line.rstrip("\r\n").lstrip("\ufeff")
    separator = max(",;\t", key=line.count)
    if line.count(separator) >= COLUMNS:
        raise NergError(f'the table "{path}" has more than the {COLUMNS:,} columns that are read; give one with fewer')
    try:
        return [c.strip() for c in next(csv.reader([line], delimiter=separator))] if line else [], separator
    except csv.Error as error:
        raise NergError(f'the first line of the table "{path}" is no header ({error}); is it a table?') from error


def _fast_reader(layout: _Layout) -> Callable[[list[str]], tuple[np.ndarray, np.ndarray] | None] | None:
    """A function of lines that converts them with pyarrow, on all cores; ``None`` without pyarrow.

    It gives ``None`` for lines that are in any way unusual (missing cells, words among numbers), which the slower
    reader converts, or refuses by line and column.
    """
    try:
        import pyarrow as pa
        from pyarrow import csv as pc
    except ImportError:
        return None
    separator, columns, number_at, text_at = layout
    if set(number_at) & set(text_at):  # one column, wanted as both
        return None
    # By place, not by name: names may be given twice.
    names = [str(i) for i in range(len(columns))]
    options = dict(
        read_options=pc.ReadOptions(column_names=names),
        parse_options=pc.ParseOptions(delimiter=separator, ignore_empty_lines=False),
        convert_options=pc.ConvertOptions(
            include_columns=list(dict.fromkeys(names[i] for i in (*number_at, *text_at))),
            column_types={**{names[i]: pa.string() for i in text_at}, **{names[i]: pa.float64() for i in number_at}},
            null_values=["", *(spelt for word in _MISSING if word for spelt in (word, word.upper(), word.title()))],
            strings_can_be_null=False,
        ),
    )

    def convert(rows: list[str]) -> tuple[np.ndarray, np.ndarray] | None:
        try:
            table = pc.read_csv(pa.BufferReader("".join(rows).encode()), **options)
        except pa.ArrowException:
            return None
        if table.num_rows != len(rows):  # a quoted cell with a line break
            return None
        values = (
            np.stack([table.column(names[i]).to_numpy() for i in number_at], axis=1)
            if number_at
            else np.empty((len(rows), 0))
        )
        cells = [table.column(names[i]).to_numpy() for i in text_at]
        if any(len(rows) * max(map(len, column)) > _TEXT_BLOCK for column in cells):
            return None
        words = [np.char.strip(column.astype(str)) for column in cells]
        return values, np.stack(words, axis=1) if words else np.empty((len(rows), 0), dtype=str)

    return convert


def _convert(
    path: str | os.PathLike, rows: list[str], lines: np.ndarray, layout: _Layout, on_bad: OnBadLine | None
) -> TableBlock:
    if layout.text_at and len(rows) * max(map(len, rows)) > _TEXT_BLOCK:
        return _convert_slowly(path, rows, lines, layout, on_bad)
    # Empty cells are common (a gaze ray that hits nothing) and NumPy's fast reader refuses them, so they are spelt out
    # first.
    gap = layout.separator * 2
    filled = rows
    if any(gap in row for row in rows):
        spelt = f"{layout.separator}nan{layout.separator}"
        filled = [r.replace(gap, spelt).replace(gap, spelt) if gap in r else r for r in rows]
    load = lambda lines, places, kind: np.loadtxt(
        lines, usecols=places, dtype=kind, delimiter=layout.separator, comments=None, quotechar='"', ndmin=2
    )
    try:
        values = load(filled, layout.number_at, np.float64)
        words = load(rows, layout.text_at, str) if layout.text_at else np.empty((len(rows), 0), dtype=str)
    except (ValueError, OverflowError):
        return _convert_slowly(path, rows, lines, layout, on_bad)
    if len(values) != len(rows) or len(words) != len(rows):  # a quote that is never closed joins lines
        return _convert_slowly(path, rows, lines, layout, on_bad)
    return TableBlock(values, words, lines)


def _convert_slowly(
    path: str | os.PathLike, rows: list[str], lines: np.ndarray, layout: _Layout, on_bad: OnBadLine | None
) -> TableBlock:
    """Line by line, cell by cell: knows more spellings of "missing", and names the bad cell."""
    values, words, kept = [], [], []
    for row, line in zip(rows, lines.tolist()):
        found = _cells(row, layout)
        if isinstance(found, str):
            if on_bad is None:
                raise NergError(f"{path}, line {line}{found}, or leave such lines out with --skip-bad-lines")
            on_bad(line, found)
            continue
        cells, numbers = found
        values.append(numbers)
        words.append([cells[k].strip() for k in layout.text_at])
        kept.append(line)
    return TableBlock(
        np.array(values, np.float64).reshape(len(kept), len(layout.number_at)),
        np.array(words, dtype=str).reshape(len(kept), len(layout.text_at)),
        np.array(kept, np.int64),
    )


def _cells(row: str, layout: _Layout) -> tuple[list[str], list[float]] | str:
    """The cells of a line and the numbers among them; or what is wrong with it, and the remedy."""
    try:
        cells = next(csv.reader([row], delimiter=layout.separator), [])
    except csv.Error as error:
        return f": it cannot be split into cells ({error}); mend or remove the line"
    if len(cells) <= max([*layout.number_at, *layout.text_at], default=0):
        return f": {len(cells)} cells, the header has {len(layout.columns)}; mend or remove the line"
    for k in layout.text_at:
        if len(cells[k]) > TEXT_CHARACTERS:
            what = (
                f"column {plain(layout.columns[k], 40)!r}: more than the {TEXT_CHARACTERS:,} characters that are read"
            )
            return f", {what}; mend or remove the line"
    numbers = []
    for k in layout.number_at:
        word = cells[k].strip()
        try:
            numbers.append(np.nan if word.lower() in _MISSING else float(word))
        except ValueError:
            cell = f"column {plain(layout.columns[k], 40)!r}: {plain(word, 60)!r}"
            return f", {cell} is not a number; mend the cell or the column map"
    return cells, numbers


def _parquet(path: str | os.PathLike) -> Any:
    """The open Parquet file ``path``; `NergError` for one that is damaged or claims more than its bytes warrant."""
    pa, pq = pyarrow_modules()
    size = size_of(path, "table")
    with reading(path, "table", also=(pa.ArrowException,)):
        table = pq.ParquetFile(path)
        about = table.metadata
        claimed = sum(about.row_group(i).total_byte_size for i in range(about.num_row_groups))
    # Equal values are stored once: what counts is also what they become.
    if max(claimed, _ROW_BYTES * about.num_rows) > inflated_limit(size):
        raise NergError(
            f'the table "{path}" claims {about.num_rows:,} rows, which its {size:,} bytes do not warrant; copy it again'
        )
    return table


def _iterate_parquet(path: str | os.PathLike, numbers: Sequence[str], texts: Sequence[str]) -> Iterator[TableBlock]:
    import pyarrow as pa

    with _parquet(path) as table:
        names = table.schema_arrow.names
        _require(path, [*numbers, *texts], names)
        twice = [c for c in (*numbers, *texts) if names.count(c) > 1]
        if twice:
            raise NergError(
                f'the table "{path}" has several columns called {plain(twice[0], 40)!r}; rename all but one'
            )
        first, wanted = 1, list(dict.fromkeys([*numbers, *texts]))
        with reading(path, "table", also=(pa.ArrowException,)):
            batches = table.iter_batches(batch_size=BLOCK, columns=wanted)
        while True:
            with reading(path, "table", also=(pa.ArrowException,)):
                batch = next(batches, None)
                if batch is None:
                    return
                n = batch.num_rows
                column = {c: batch.column(batch.schema.get_field_index(c)) for c in wanted}
                values = [_as_numbers(path, c, column[c]) for c in numbers]
                words = [_as_texts(path, c, column[c]) for c in texts]
            yield TableBlock(
                np.stack(values, axis=1) if values else np.empty((n, 0)),
                np.stack(words, axis=1) if words else np.empty((n, 0), dtype=str),
                np.arange(first, first + n),
            )
            first += n


def _as_texts(path: str | os.PathLike, name: str, column: Any) -> np.ndarray:
    words = ["" if v is None else str(v) for v in column.to_pylist()]
    if max(map(len, words), default=0) > TEXT_CHARACTERS:
        raise NergError(
            f'the column {plain(name, 40)!r} of the table "{path}" has cells of more than the {TEXT_CHARACTERS:,} '
            "characters that are read; name another one"
        )
    return np.array(words, dtype=str)


def _as_numbers(path: str | os.PathLike, name: str, column: Any) -> np.ndarray:
    try:
        return column.to_numpy(zero_copy_only=False).astype(np.float64)
    except (TypeError, ValueError):
        raise NergError(
            f'the column {plain(name, 40)!r} of the table "{path}" holds no numbers; name another one'
        ) from None


def _require(path: str | os.PathLike, wanted: list[str], there: list[str]) -> None:
    missing = [c for c in wanted if c not in there]
    if missing:
        brief = lambda names: ", ".join(plain(c, 40) for c in names[:12]) + (", ..." if len(names) > 12 else "")
        raise NergError(
            f"{path} has no column {brief(missing)}; its columns are {brief(there) or 'none'}; name those by --map"
        )
