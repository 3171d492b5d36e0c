"""Tables of rays: CSV (also ``.gz``) and Parquet, read by named columns."""
from __future__ import annotations

import csv
import gzip
import itertools
import os
from pathlib import Path
from typing import IO, Callable, Iterator, NamedTuple, Sequence

import numpy as np

BLOCK = 1 << 16  # rows converted at a time: memory stays bounded

_MISSING = {"", "nan", "na", "n/a", "null", "none", "-"}


class TableBlock(NamedTuple):
    """``numbers`` (n, C) float64 in the order asked, NaN where a cell is empty;
    ``texts`` (n, T) str; ``lines`` (n,) 1-based lines of the file (rows for
    Parquet)."""

    numbers: np.ndarray
    texts: np.ndarray
    lines: np.ndarray


def table_columns(path: str | os.PathLike) -> list[str]:
    """Names of a table's columns; of a CSV those of its first line."""
    if str(path).lower().endswith(".parquet"):
        from .rays_file import pyarrow_modules

        return list(pyarrow_modules()[1].ParquetFile(path).schema_arrow.names)
    with _open(path) as source:
        return _header(source.readline())[0]


def iterate_table(
    path: str | os.PathLike, numbers: Sequence[str], texts: Sequence[str] = (), header: Sequence[str] | None = None
) -> Iterator[TableBlock]:
    """Yield named columns of a table in blocks of at most ``BLOCK`` rows.

    The separator (comma, semicolon or tab) is taken from the header. Cells
    that are empty or say nan, na, null or none are NaN. ``header``: the names
    of the columns of a CSV whose first line is none. Raises ``ValueError``
    for a missing column (naming those there are), a row with too few cells, or
    a cell that is no number (naming its line). Where pyarrow is installed it
    converts the cells, to the same numbers.
    """
    if str(path).lower().endswith(".parquet"):
        yield from _iterate_parquet(path, numbers, texts)
        return
    with _open(path) as source:
        if header is None:
            columns, separator = _header(source.readline())
            count = 1
        else:
            columns, separator, count = list(header), ",", 0
        where = {c: i for i, c in reversed(list(enumerate(columns)))}
        _require(path, [*numbers, *texts], columns)
        number_at, text_at = [where[c] for c in numbers], [where[c] for c in texts]
        convert = _fast_reader(separator, columns, number_at, text_at) or (lambda rows: None)
        while raw := list(itertools.islice(source, BLOCK)):
            blank = [line.isspace() for line in raw]
            lines = count + 1 + np.flatnonzero(~np.array(blank))
            kept = raw if len(lines) == len(raw) else [line for line, gone in zip(raw, blank) if not gone]
            count += len(raw)
            if kept:
                found = convert(kept)
                yield TableBlock(*found, lines) if found else _convert(path, kept, lines, separator, columns, number_at, text_at)


def _header(line: str) -> tuple[list[str], str]:
    """Column names and the separator between them."""
    line = line.rstrip("\r\n").lstrip("\ufeff")
    separator = max(",;\t", key=line.count)
    return [c.strip() for c in next(csv.reader([line], delimiter=separator))] if line else [], separator


def _fast_reader(
    separator: str, columns: list[str], number_at: list[int], text_at: list[int]
) -> Callable[[list[str]], tuple[np.ndarray, np.ndarray] | None] | None:
    """A function of lines that converts them with pyarrow, three times as fast and on all cores; ``None`` without pyarrow.

    It gives ``None`` for lines that are in any way unusual (missing cells, words among numbers), which the slower reader
    converts, or refuses by line and column.
    """
    try:
        import pyarrow as pa
        from pyarrow import csv as pc
    except ImportError:
        return None
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
        except pa.ArrowInvalid:
            return None
        if table.num_rows != len(rows):  # a quoted cell with a line break
            return None
        values = np.stack([table.column(names[i]).to_numpy() for i in number_at], axis=1) if number_at else np.empty((len(rows), 0))
        words = [np.char.strip(table.column(names[i]).to_numpy().astype(str)) for i in text_at]
        return values, np.stack(words, axis=1) if words else np.empty((len(rows), 0), dtype=str)

    return convert


def _convert(
    path: object, rows: list[str], lines: np.ndarray, separator: str, columns: list[str], number_at: list[int], text_at: list[int]
) -> TableBlock:
    # Empty cells are common (a gaze ray that hits nothing) and NumPy's fast
    # reader refuses them, so they are spelt out first.
    gap = separator * 2
    filled = rows
    if any(gap in row for row in rows):
        filled = [r.replace(gap, f"{separator}nan{separator}").replace(gap, f"{separator}nan{separator}") if gap in r else r for r in rows]
    options = dict(delimiter=separator, comments=None, quotechar='"', ndmin=2)
    try:
        values = np.loadtxt(filled, usecols=number_at, dtype=np.float64, **options)
    except ValueError:
        values = _convert_slowly(path, rows, lines, separator, columns, number_at)
    words = np.loadtxt(rows, usecols=text_at, dtype=str, **options) if text_at else np.empty((len(rows), 0), dtype=str)
    return TableBlock(values, words, lines)


def _convert_slowly(
    path: object, rows: list[str], lines: np.ndarray, separator: str, columns: list[str], number_at: list[int]
) -> np.ndarray:
    """Cell by cell: knows more spellings of "missing", and names the bad cell."""
    out = np.empty((len(rows), len(number_at)))
    for i, cells in enumerate(csv.reader(rows, delimiter=separator)):
        if len(cells) <= max(number_at, default=0):
            raise ValueError(f"{path}, line {lines[i]}: {len(cells)} cells, the header has {len(columns)}; mend or remove the line")
        for j, k in enumerate(number_at):
            word = cells[k].strip()
            try:
                out[i, j] = np.nan if word.lower() in _MISSING else float(word)
            except ValueError:
                raise ValueError(
                    f"{path}, line {lines[i]}, column {columns[k]!r}: {word!r} is not a number; mend the cell or the column map"
                ) from None
    return out


def _iterate_parquet(path: str | os.PathLike, numbers: Sequence[str], texts: Sequence[str]) -> Iterator[TableBlock]:
    from .rays_file import pyarrow_modules

    _, pq = pyarrow_modules()
    table = pq.ParquetFile(path)
    _require(path, [*numbers, *texts], table.schema_arrow.names)
    first = 1
    for batch in table.iter_batches(batch_size=BLOCK, columns=list(dict.fromkeys([*numbers, *texts]))):
        n = batch.num_rows
        column = lambda c: batch.column(batch.schema.get_field_index(c))
        values = [column(c).to_numpy(zero_copy_only=False).astype(np.float64) for c in numbers]
        words = [np.array(["" if v is None else str(v) for v in column(c).to_pylist()], dtype=str) for c in texts]
        yield TableBlock(
            np.stack(values, axis=1) if values else np.empty((n, 0)),
            np.stack(words, axis=1) if words else np.empty((n, 0), dtype=str),
            np.arange(first, first + n),
        )
        first += n


def _require(path: object, wanted: list[str], there: list[str]) -> None:
    missing = [c for c in wanted if c not in there]
    if missing:
        brief = lambda names: ", ".join(c[:40] for c in names[:12]) + (", ..." if len(names) > 12 else "")
        raise ValueError(f"{path} has no column {brief(missing)}; its columns are {brief(there) or 'none'}")


def _open(path: str | os.PathLike) -> IO[str]:
    if Path(path).suffix.lower() == ".gz":
        return gzip.open(path, "rt", encoding="utf-8", newline="")
    return open(path, "rt", encoding="utf-8", newline="")
