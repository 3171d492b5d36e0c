"""Tables of tracking data: CSV and Parquet files in blocks, with rows validated against the header.

- Rows without time, origin, direction or participant (empty, NaN, None, ``#N/A``, ``.``, ``--``), with a direction
  of length 0, a confidence outside 0 to 1, or a matrix or quaternion that is no rotation are dropped, counted and
  named by line.
- Fill values: vectors whose components all have one value (0, -1, 9s such as -9999, or the limit of a number type)
  are missing data, and so are such quaternions and angles (except angles of 0 and -1). A direction drops its row; a
  hit point is removed unless the ray points at it to 2 degrees; an origin drops its row where it repeats and the
  participant is otherwise never within 0.1 m of it.
- A line with more or fewer cells than the header, or with a cell that is not a number, ends the import with file,
  line and column; so do repeated column names and a column in two roles. ``--skip-bad-lines`` leaves such lines out,
  at most 1 % of a file's lines or one.
- Validity (presets of Unity): all validity columns are used. Words and 1 next to 0 are understood; 0, 1, 2 of a
  ``gaze_status`` are Varjo's (2 is valid). Any other value ends the import until ``--valid "gaze_status=3"`` says
  which rows are kept (``--valid none``: all). With ``--map``, ``--valid`` names the column too.
- An ``id`` that differs in nearly every row counts rows, and is not taken for participants.
- Compressed files may expand to 100 times their size (256 MB in any case), a line may have a million characters, a
  table 16,384 columns.
"""

from __future__ import annotations

import csv
import datetime
import itertools
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.safe_read import BadLineCallback, read_line_blocks, translate_read_errors
from nerg_mi.files.tables import SEPARATOR_LINE, find_separator
from nerg_mi.files.values import find_name, parse_float, to_name, to_numbers, to_seconds
from nerg_mi.tracking.rays import open_parquet

from .cells import AXES, MISSING_WORDS, count_components, is_missing, parse_vectors, quote_vectors

BLOCK_ROWS = 1 << 16  # rows converted at a time, to bound memory
MAX_COLUMNS = 1 << 14  # maximum number of columns of a table
MAX_TEXT_CHARACTERS = 1000  # maximum length of a cell that is read as text

# Maximum size of an array of text, in characters: all cells take the space of the longest, four bytes per character.
_MAX_TEXT_BLOCK = 1 << 26

# Minimum memory of a row, in bytes.
_ROW_BYTES = 32

_DECIMAL = re.compile(r"\s*[+-]?\d*([.,])\d*([eE][+-]?\d+)?\s*")

# A date or time in any notation.
_CLOCK_LIKE = re.compile(r"\d[:/]\d|\d-\d+-\d")

# Two cells that may be one number or time that was split at a decimal comma.
_INTEGER_CELL, _FRACTION_CELL = re.compile(r"(^|[+:-])\d+$"), re.compile(r"\d+([eE][+-]?\d+)?")


class TableBlock(NamedTuple):
    """A run of n rows of a table."""

    numbers: np.ndarray  # (n, C) float64 in the requested order, NaN for empty cells
    texts: np.ndarray  # (n, T) str
    lines: np.ndarray  # (n,) line numbers in the file, from 1; row numbers for Parquet


def read_table_columns(path: str | os.PathLike) -> list[str]:
    """Names of a table's columns; in a CSV, the cells of the first line. Raises `NergError` for a damaged file."""
    if str(path).lower().endswith(".parquet"):
        with open_parquet(path, "table", _ROW_BYTES) as table:
            return list(table.schema_arrow.names)
    with closing(read_line_blocks(path, "table", _HEADER_LINES)) as blocks:
        return _parse_header(path, next(blocks, [])).columns


def find_vector_columns(path: str | os.PathLike) -> list[str]:
    """Names of the components of columns whose cells contain vectors: ``Gaze.x``, ``Gaze.y``, ``Gaze.z`` for cells such
    as (1, 2, 3) in a column ``Gaze``. `iterate_table` reads them as numbers."""
    columns, cells = read_table_columns(path), dict[int, list[str]]()
    if str(path).lower().endswith(".parquet"):
        for name, values in _read_parquet_texts(path).items():
            cells[columns.index(name)] = [text for v in values if not is_missing(text := "" if v is None else str(v))]
    else:
        for row in next(iterate_samples(path), []):
            for k, cell in enumerate(row[: len(columns)]):
                if not is_missing(cell):
                    cells.setdefault(k, []).append(cell)
    names = ((columns[k], AXES[: count_components(column[:_VECTOR_ROWS])]) for k, column in sorted(cells.items()))
    return [f"{name}.{axis}" for name, axes in names if name and columns.count(name) == 1 for axis in axes]


def _read_parquet_texts(path: str | os.PathLike) -> dict[str, list[Any]]:
    """First cells of the columns of a Parquet table that are neither numbers nor times."""
    import pyarrow as pa

    is_number = lambda kind: pa.types.is_primitive(kind) or pa.types.is_decimal(kind)
    with open_parquet(path, "table", _ROW_BYTES) as table:
        schema = table.schema_arrow
        fields = (schema.field(k) for k in range(len(schema.names)))
        names = [field.name for field in fields if not is_number(field.type) and schema.names.count(field.name) == 1]
        with translate_read_errors(path, "table", extra_errors=(pa.ArrowException,)):
            batch = next(table.iter_batches(batch_size=_SAMPLED_ROWS, columns=names), None) if names else None
            return batch.to_pydict() if batch is not None else {}


def find_column(name: str, columns: Sequence[str]) -> str:
    """Return the name among ``columns`` that is equal to ``name`` in its folded form, or of whose vectors it is a
    component; ``name`` itself if there is none."""
    k = find_name(name, columns)
    if k is not None:
        return columns[k]
    base, dot, axis = name.rpartition(".")
    k = find_name(base, columns) if dot and axis in AXES else None
    return name if k is None else f"{columns[k]}.{axis}"


def split_component(name: str, columns: Sequence[str]) -> str | None:
    """The column of the cells with vectors of which ``name`` is a component, such as ``Gaze`` for ``Gaze.x``; None for
    a name in ``columns``, and any other name."""
    base, _, axis = name.rpartition(".")
    return base if name not in columns and base in columns and axis and axis in AXES else None


def iterate_table(
    path: str | os.PathLike,
    numbers: Sequence[str],
    texts: Sequence[str] = (),
    header: Sequence[str] | None = None,
    on_bad_line: BadLineCallback | None = None,
    **options: Any,
) -> Iterator[TableBlock]:
    """Iterate over columns of a table in blocks, as `_iterate_cells` with its ``options``.

    A number ``Gaze.x`` is the first component of the vectors in the cells of a column ``Gaze``, if no column has its
    name; all components of a vector must be requested.
    """
    available = list(header or read_table_columns(path))
    columns = {name: find_column(name, available) for name in (*numbers, *texts)}
    numbers, texts = ([columns[name] for name in names] for names in (numbers, texts))
    if clocks := options.get("clocks"):
        options["clocks"] = {columns.get(name, name): tick for name, tick in clocks.items()}
    bases = {name: base for name in numbers if (base := split_component(name, available))}
    if not bases:
        yield from _iterate_cells(path, numbers, texts, header, on_bad_line, **options)
        return
    plain = [name for name in numbers if name not in bases]
    words = list(dict.fromkeys((*texts, *bases.values())))
    for block in _iterate_cells(path, plain, words, header, on_bad_line, **options):
        value, is_bad = dict(zip(plain, block.numbers.T)), np.zeros(len(block.lines), bool)
        for base in dict.fromkeys(bases.values()):
            names = [f"{base}.{axis}" for axis in AXES if bases.get(f"{base}.{axis}") == base]
            cells = block.texts[:, words.index(base)]
            vectors, is_other = parse_vectors(cells.tolist(), len(names))
            for row in np.flatnonzero(is_other & ~is_bad):
                cell = sanitize(str(cells[row]), 60)
                reason = f", column {sanitize(base, 40)!r}: {cell!r} is not {len(names)} numbers; correct the cell"
                _report_bad_line(path, int(block.lines[row]), f"{reason} or the columns", on_bad_line)
            value |= zip(names, vectors.T)
            is_bad |= is_other
        stacked = np.stack([value[name] for name in numbers], axis=1)
        if not is_bad.all():
            yield TableBlock(stacked[~is_bad], block.texts[~is_bad, : len(texts)], block.lines[~is_bad])


def _report_bad_line(path: str | os.PathLike, line: int, reason: str, on_bad_line: BadLineCallback | None) -> None:
    if on_bad_line is None:
        raise NergError(f"{path}, line {line}{reason}, or skip such lines with {parameter('skip_bad_lines', True)}")
    on_bad_line(line, reason)


def _iterate_cells(
    path: str | os.PathLike,
    numbers: Sequence[str],
    texts: Sequence[str] = (),
    header: Sequence[str] | None = None,
    on_bad_line: BadLineCallback | None = None,
    *,
    first_line: int = 1,
    separator: str = ",",
    clocks: Mapping[str, float] | None = None,
    on_note: Callable[..., None] | None = None,
) -> Iterator[TableBlock]:
    """Iterate over columns of a table in blocks of about `BLOCK_ROWS` rows.

    The separator (comma, semicolon or tab) is read from a first line such as ``sep=;``, or detected in the header, and
    the decimal sign (point or comma) in the first number that has one. Missing values are NaN (`is_missing`). Cells are
    converted with pyarrow if it is installed, with the same results.

    Parameters
    ----------
    numbers, texts
        Columns to read as numbers and as text.
    header
        Names of the columns of a CSV without a header, whose data start at ``first_line``.
    separator
        Separator of a CSV without a header.
    on_bad_line
        Called with each unreadable line, which is skipped. Without it such a line is an error.
    clocks
        Columns of ``numbers`` that may contain times such as ``2024-05-01T12:00:00`` or ``12:00:00.25``
        (`parse_clock_seconds`), with the unit in seconds in which they are returned, and of plain numbers in them.
        Times of day without a date continue past midnight (`DayCounter`).
    on_note
        Called with ``decimal=","`` for decimal commas, and with ``passes_midnight=True`` for times of day past
        midnight.

    Raises
    ------
    NergError
        For a damaged file, a missing or repeated column, a column that is requested twice, and, without
        ``on_bad_line``, for the line of a row with more or fewer cells than the header (except for one separator at its
        end) or a cell that is not a number.
    """
    if str(path).lower().endswith(".parquet"):
        yield from _iterate_parquet(path, numbers, texts, clocks or {}, on_note)
        return
    blocks = read_line_blocks(path, "table", BLOCK_ROWS)
    first = next(blocks, [])
    if header is None:
        top = _parse_header(path, first)
    else:
        top = _Header(list(header), separator, first_line - 1, False)
    check_columns(path, [*numbers, *texts], top.columns)
    number_at, text_at = ([top.columns.index(name) for name in names] for names in (numbers, texts))
    layout, convert = _Layout(top.separator, top.columns, number_at, text_at, ".", {}, len(top.columns)), None
    days: dict[int, DayCounter] = {}
    for raw, starts in _iterate_rows(itertools.chain([first[top.size :]], blocks), layout, top):
        blank = np.array([line.isspace() for line in raw], dtype=bool)
        lines = starts[~blank]
        rows = list(itertools.compress(raw, ~blank)) if blank.any() else raw
        if rows:
            if convert is None:
                layout = _detect_spelling(layout, rows, clocks or {})
                convert = _make_arrow_converter(layout) or (lambda rows: None)
                if on_note is not None and layout.decimal == ",":
                    on_note(decimal=",")
                days = {k: DayCounter(tick, on_note) for k, (tick, dated) in layout.clocks.items() if not dated}
            values = convert(rows)
            block = TableBlock(*values, lines) if values else _convert(path, rows, lines, layout, on_bad_line)
            for k, counter in days.items():
                column = block.numbers[:, layout.number_at.index(k)]
                column[:] = counter.unwrap(column)
            if len(block.lines):
                yield block


class _Layout(NamedTuple):
    """Positions and notation of the requested cells in the lines of a CSV."""

    separator: str
    columns: list[str]  # of the file
    number_at: list[int]  # indices of the columns of numbers
    text_at: list[int]  # indices of the columns of text
    decimal: str  # sign: point or comma
    clocks: dict[int, tuple[float, bool]]  # indices of columns of times in text form: unit in seconds, has a date
    row_cells: int  # number of cells of the first complete row
    time_at: frozenset[int] = frozenset()  # indices of columns that may contain times in text form

    @property
    def width(self) -> int:
        """Number of cells of a row, without an empty one after a separator at its end."""
        return len(self.columns) - (len(self.columns) > 1 and not self.columns[-1])

    def accepts(self, cells: int, last: str) -> bool:
        """Whether a row with this number of cells, the last of which is ``last``, matches the header."""
        return cells in (self.width, len(self.columns)) or (cells == self.width + 1 and not last.strip())


def _detect_spelling(layout: _Layout, rows: list[str], clocks: Mapping[str, float]) -> _Layout:
    """Detect the decimal sign and the columns of times in the first ``rows``."""
    ticks = {layout.columns.index(name): tick for name, tick in clocks.items() if name in layout.columns}
    times: dict[int, tuple[float, bool]] = {}
    pending, decimal, row_cells = set(ticks), "", 0
    for row in rows:
        cells = _split_cells(row, layout.separator) or []
        if not layout.accepts(len(cells), cells[-1] if cells else ""):
            continue
        row_cells = row_cells or len(cells)
        for k in [k for k in pending if not is_missing(cells[k])]:
            pending.remove(k)
            time = parse_clock_seconds(cells[k])
            if time is not None:
                times[k] = ticks[k], time[1]
        values = (cells[k] for k in layout.number_at if k not in times and not is_missing(cells[k]))
        signs = (match[1] for cell in values if (match := _DECIMAL.fullmatch(cell)))
        decimal = decimal or next(signs, "")
        if decimal and not pending:
            break
    return layout._replace(decimal=decimal or ".", clocks=times, row_cells=row_cells, time_at=frozenset(ticks))


def _split_cells(row: str, separator: str) -> list[str] | None:
    """Split a line into cells; None for invalid quotes or lengths."""
    try:
        return next(csv.reader([row], delimiter=separator), [])
    except csv.Error:
        return None


# The first line of tables for Excel that names the separator; saved by another program, it has empty cells.
_HEADER_LINES = 16  # lines in which the header ends
_SAMPLED_ROWS = 400  # rows of a block that are searched for vectors
_VECTOR_ROWS = 100  # cells of a column that must be vectors
_MAX_RECORD_LINES = 100  # lines of one row whose cells contain line breaks in quotes


class _Header(NamedTuple):
    """The first lines of a CSV."""

    columns: list[str]
    separator: str
    size: int  # lines before the first row
    quotes_vectors: bool  # whether the rows have vectors in brackets whose separators would split them


def _parse_header(path: str | os.PathLike, lines: Sequence[str]) -> _Header:
    """Parse the header in the first ``lines`` of a CSV."""
    size = next((k for k, line in enumerate(lines) if not line.isspace()), 0)
    match = SEPARATOR_LINE.fullmatch(lines[size].rstrip("\r\n")) if lines else None
    size += 1 if match else 0
    line = lines[size] if size < len(lines) else ""
    separator = match[1].replace("\\t", "\t") if match else find_separator(line)
    while _is_open(line, separator) and size < min(len(lines) - 1, _HEADER_LINES):
        size += 1
        line = f"{line.rstrip()} {lines[size]}"
    columns = _split_header(path, line.rstrip("\r\n"), separator)
    header = _Header(columns, separator, size + 1, False)
    width = _Layout(separator, columns, [], [], ".", {}, len(columns))
    num_rows = [0, 0]
    for row in _sample_rows(lines[size + 1 :]):
        if "(" in row or "[" in row or "{" in row:
            for k, text in enumerate((row, quote_vectors(row, separator))):
                cells = _split_cells(text, separator) or [""]
                num_rows[k] += width.accepts(len(cells), cells[-1])
    return header._replace(quotes_vectors=num_rows[1] > num_rows[0])


def iterate_samples(path: str | os.PathLike) -> Iterator[list[list[str]]]:
    """Cells of about `_SAMPLED_ROWS` rows of each block of a CSV, the first ones and some of the others."""
    with closing(read_line_blocks(path, "table", BLOCK_ROWS)) as blocks:
        first = next(blocks, [])
        header = _parse_header(path, first)
        layout = _Layout(header.separator, header.columns, [], [], ".", {}, len(header.columns))
        for rows, _ in _iterate_rows(itertools.chain([first[header.size :]], blocks), layout, header):
            yield [_split_cells(row, header.separator) or [] for row in _sample_rows(rows)]


def _sample_rows(rows: Sequence[str]) -> list[str]:
    half = _SAMPLED_ROWS // 2
    return [row for row in (*rows[:half], *rows[half :: len(rows) // half + 1]) if not row.isspace()]


def _is_open(text: str, separator: str) -> bool:
    """Whether a quoted cell of a row begins in ``text``, but does not end."""
    if '"' not in text:
        return False
    cells = re.finditer(rf'(?:^|{re.escape(separator)})"(?:[^"]|"")*("?)', text)
    return any(not match[1] for match in cells)


def _iterate_rows(
    blocks: Iterable[list[str]], layout: _Layout, header: _Header
) -> Iterator[tuple[list[str], np.ndarray]]:
    """Join lines to rows with line breaks in quoted cells, in which spaces replace them; returns blocks of rows and
    their first lines (n,)."""
    rest, line = list[str](), header.size + 1
    for block in blocks:
        block = rest + block
        rows, starts, rest = _join_lines(block, layout) if any(r.count('"') % 2 for r in block) else (block, None, [])
        starts = np.arange(len(rows)) if starts is None else np.array(starts, np.int64)
        if header.quotes_vectors:
            rows = [quote_vectors(row, layout.separator) for row in rows]
        yield rows, line + starts
        line += len(block) - len(rest)
    if rest:
        yield rest, line + np.arange(len(rest))


def _join_lines(lines: list[str], layout: _Layout) -> tuple[list[str], list[int], list[str]]:
    """Rows, the indices of their first lines, and the lines of a row that continues after ``lines``. Lines are joined
    if this gives a row with the cells of the header: a stray quotation mark must not join others."""
    rows, starts, k = [], [], 0
    while k < len(lines):
        row, end = lines[k], k + 1
        if row.count('"') % 2 and _is_open(row, layout.separator):
            while _is_open(row, layout.separator) and end < len(lines) and end - k < _MAX_RECORD_LINES:
                row, end = f"{row.rstrip()} {lines[end]}", end + 1
            if _is_open(row, layout.separator) and end == len(lines) and end - k < _MAX_RECORD_LINES:
                return rows, starts, lines[k:]
            cells = _split_cells(row, layout.separator) or [""]
            if _is_open(row, layout.separator) or not layout.accepts(len(cells), cells[-1]):
                row, end = lines[k], k + 1
        rows.append(row)
        starts.append(k)
        k = end
    return rows, starts, []


def _split_header(path: str | os.PathLike, line: str, separator: str) -> list[str]:
    if line.startswith("Format Version,"):
        raise NergError(f'"{path}" is an export of OptiTrack\'s Motive; import it with {parameter("preset", "motive")}')
    if line.count(separator) >= MAX_COLUMNS:
        raise NergError(
            f'the table "{path}" has more columns than the maximum of {MAX_COLUMNS:,}; provide one with fewer'
        )
    try:
        return [c.strip() for c in next(csv.reader([line], delimiter=separator))] if line else []
    except csv.Error as error:
        raise NergError(f'the first line of the table "{path}" is not a header ({error}); is it a table?') from error


def _make_arrow_converter(layout: _Layout) -> Callable[[list[str]], tuple[np.ndarray, np.ndarray] | None] | None:
    """Make a function that converts lines with pyarrow on all cores; None without pyarrow.

    The function returns None for unusual lines (missing cells, words among numbers); the slow converter then converts
    them, or reports line and column.
    """
    try:
        import pyarrow as pa
        from pyarrow import csv as pc
    except ImportError:
        return None
    separator, number_at, text_at, words = layout.separator, layout.number_at, layout.text_at, set(layout.text_at)
    words |= set(layout.clocks)
    names = [str(i) for i in range(layout.row_cells)]
    if not layout.width <= len(names) <= layout.width + 1:
        return None
    # A row may end with a separator, but not with a cell that has no column.
    trailing = [names[-1]] if len(names) > len(layout.columns) else []
    options = dict(
        read_options=pc.ReadOptions(column_names=names),
        parse_options=pc.ParseOptions(delimiter=separator, ignore_empty_lines=False),
        convert_options=pc.ConvertOptions(
            include_columns=[*(names[i] for i in (*number_at, *text_at)), *trailing],
            column_types={
                **{names[i]: pa.float64() for i in number_at},
                **{names[i]: pa.string() for i in words},
                **{name: pa.string() for name in trailing},
            },
            null_values=[
                "",
                *(spelt for word in MISSING_WORDS if word for spelt in (word, word.upper(), word.title())),
            ],
            strings_can_be_null=False,
            decimal_point=layout.decimal,
        ),
    )

    def convert(rows: list[str]) -> tuple[np.ndarray, np.ndarray] | None:
        try:
            table = pc.read_csv(pa.BufferReader("".join(rows).encode()), **options)
        except pa.ArrowException:
            return None
        if table.num_rows != len(rows):  # a quoted cell with a line break
            return None
        if any(cell.strip() for name in trailing for cell in table.column(name).to_pylist()):
            return None
        numbers = []
        for i in number_at:
            column = table.column(names[i])
            if i in layout.clocks:
                times = _parse_clock_column(column.to_pylist(), *layout.clocks[i])
                if times is None:
                    return None
                numbers.append(times)
            else:
                numbers.append(column.to_numpy())
        values = np.stack(numbers, axis=1) if numbers else np.empty((len(rows), 0))
        cells = [table.column(names[i]).to_numpy() for i in text_at]
        if any(len(rows) * max(map(len, column)) > _MAX_TEXT_BLOCK for column in cells):
            return None
        texts = [np.char.strip(column.astype(str)) for column in cells]
        return values, np.stack(texts, axis=1) if texts else np.empty((len(rows), 0), dtype=str)

    return convert


def _parse_clock_column(cells: Sequence[str], tick: float, dated: bool) -> np.ndarray | None:
    """Times (n,) in units of ``tick`` seconds; None if a cell is not a time, or differs in whether it has a date."""
    times = [np.nan if is_missing(cell) else _parse_clock(cell, tick, dated) for cell in cells]
    return None if None in times else np.array(times, np.float64)


def _parse_clock(cell: str, tick: float, dated: bool) -> float | None:
    time = parse_clock_seconds(cell)
    return None if time is None or time[1] != dated else time[0] / tick


def _convert(
    path: str | os.PathLike, rows: list[str], lines: np.ndarray, layout: _Layout, on_bad_line: BadLineCallback | None
) -> TableBlock:
    too_long = layout.text_at and len(rows) * max(map(len, rows)) > _MAX_TEXT_BLOCK
    if too_long or layout.decimal != "." or layout.clocks or not all(_has_all_cells(row, layout) for row in rows):
        return _convert_slowly(path, rows, lines, layout, on_bad_line)
    # Empty cells and n/a are common (gaze without a hit), but NumPy's fast parser rejects them: write nan instead.
    gap = layout.separator * 2
    completed_rows = rows
    if any(gap in row for row in rows):
        spelt = f"{layout.separator}nan{layout.separator}"
        completed_rows = [r.replace(gap, spelt).replace(gap, spelt) if gap in r else r for r in rows]
    completed_rows = [r.replace("n/a", "nan") if "n/a" in r else r for r in completed_rows]
    load = lambda lines, places, kind: np.loadtxt(
        lines, usecols=places, dtype=kind, delimiter=layout.separator, comments=None, quotechar='"', ndmin=2
    )
    try:
        values = load(completed_rows, layout.number_at, np.float64)
        words = load(rows, layout.text_at, str) if layout.text_at else np.empty((len(rows), 0), dtype=str)
    except (ValueError, OverflowError):
        return _convert_slowly(path, rows, lines, layout, on_bad_line)
    if len(values) != len(rows) or len(words) != len(rows):  # an unclosed quote joins lines
        return _convert_slowly(path, rows, lines, layout, on_bad_line)
    return TableBlock(values, words, lines)


def _has_all_cells(row: str, layout: _Layout) -> bool:
    if '"' in row:
        cells = _split_cells(row, layout.separator) or []
        return layout.accepts(len(cells), cells[-1] if cells else "")
    row = row.rstrip("\r\n")
    return layout.accepts(row.count(layout.separator) + 1, row[row.rfind(layout.separator) + 1 :])


def _convert_slowly(
    path: str | os.PathLike, rows: list[str], lines: np.ndarray, layout: _Layout, on_bad_line: BadLineCallback | None
) -> TableBlock:
    """Convert cell by cell: accepts more words for missing values, and reports the bad cell."""
    values, words, good_lines = [], [], []
    for row, line in zip(rows, lines.tolist()):
        parsed = _parse_cells(row, layout)
        if isinstance(parsed, str):
            _report_bad_line(path, line, parsed, on_bad_line)
            continue
        cells, numbers = parsed
        values.append(numbers)
        words.append([cells[k].strip() for k in layout.text_at])
        good_lines.append(line)
    return TableBlock(
        np.array(values, np.float64).reshape(len(good_lines), len(layout.number_at)),
        np.array(words, dtype=str).reshape(len(good_lines), len(layout.text_at)),
        np.array(good_lines, np.int64),
    )


def _parse_cells(row: str, layout: _Layout) -> tuple[list[str], list[float]] | str:
    """Cells of a line and the numbers in them; or a description of the error, and the remedy."""
    try:
        cells = next(csv.reader([row], delimiter=layout.separator), [])
    except csv.Error as error:
        return f": it cannot be split into cells ({error}); correct or remove the line"
    if not layout.accepts(len(cells), cells[-1] if cells else ""):
        return _explain_cell_count(cells, layout)
    for k in layout.text_at:
        if len(cells[k]) > MAX_TEXT_CHARACTERS:
            name = sanitize(layout.columns[k], 40)
            what = f"column {name!r}: more characters than the maximum of {MAX_TEXT_CHARACTERS:,}"
            return f", {what}; correct or remove the line"
    numbers = []
    for k in layout.number_at:
        word = cells[k].strip()
        number = np.nan if is_missing(word) else _parse_number(word, k, layout)
        if number is None:
            cell = f"column {sanitize(layout.columns[k], 40)!r}: {sanitize(word, 60)!r}"
            return f", {cell} {_explain_bad_number(word, k, layout)}"
        numbers.append(number)
    return cells, numbers


def _parse_number(word: str, k: int, layout: _Layout) -> float | None:
    if k in layout.clocks:
        return _parse_clock(word, *layout.clocks[k])
    if layout.decimal == ",":
        # A point would be a second decimal sign, or a thousands separator.
        word = "" if "." in word else word.replace(",", ".", 1)
    try:
        return parse_float(word)
    except ValueError:
        return None


def _explain_bad_number(word: str, k: int, layout: _Layout) -> str:
    if k in layout.clocks:
        return "is not a time like those before it; use one notation in the whole column"
    if any(sign in word for sign in ".," if sign != layout.decimal):
        sign = {".": "points", ",": "commas"}[layout.decimal]
        return f"is not a number with the decimal {sign} of the table; use one notation for all numbers"
    if k in layout.time_at and _CLOCK_LIKE.search(word):
        return (
            "is not a number, and as a time its parts may have several meanings; write year-month-day "
            "hours:minutes:seconds, hours:minutes:seconds, or seconds"
        )
    return "is not a number; correct the cell, or use another column"


def _explain_cell_count(cells: list[str], layout: _Layout) -> str:
    """Describe a row with more or fewer cells than the header, with the remedy."""
    reason, pairs, k = f": {len(cells)} cells, the header has {layout.width}", 0, 0
    while k + 1 < len(cells):
        pair = bool(_INTEGER_CELL.search(cells[k]) and _FRACTION_CELL.fullmatch(cells[k + 1]))
        pairs, k = pairs + pair, k + 1 + pair
    if layout.separator == "," and 0 < len(cells) - layout.width <= pairs:
        return (
            f"{reason}; are these decimal commas? They cannot be distinguished from separators: export the table with "
            "decimal points, or with semicolons as separators"
        )
    return f"{reason}; correct or remove the line"


def _iterate_parquet(
    path: str | os.PathLike,
    numbers: Sequence[str],
    texts: Sequence[str],
    clocks: Mapping[str, float],
    on_note: Callable[..., None] | None,
) -> Iterator[TableBlock]:
    import pyarrow as pa

    days = {name: DayCounter(tick, on_note) for name, tick in clocks.items()}
    with open_parquet(path, "table", _ROW_BYTES) as table:
        names = table.schema_arrow.names
        check_columns(path, [*numbers, *texts], names)
        first, wanted = 1, [*numbers, *texts]
        with translate_read_errors(path, "table", extra_errors=(pa.ArrowException,)):
            batches = table.iter_batches(batch_size=BLOCK_ROWS, columns=wanted)
        while True:
            with translate_read_errors(path, "table", extra_errors=(pa.ArrowException,)):
                batch = next(batches, None)
                if batch is None:
                    return
                n = batch.num_rows
                column = {c: batch.column(batch.schema.get_field_index(c)) for c in wanted}
                values = [_to_numbers(path, c, column[c], days.get(c)) for c in numbers]
                words = [_to_texts(path, c, column[c]) for c in texts]
            yield TableBlock(
                np.stack(values, axis=1) if values else np.empty((n, 0)),
                np.stack(words, axis=1) if words else np.empty((n, 0), dtype=str),
                np.arange(first, first + n),
            )
            first += n


def _to_texts(path: str | os.PathLike, name: str, column: Any) -> np.ndarray:
    words = [to_name(value) for value in column.to_pylist()]
    if max(map(len, words), default=0) > MAX_TEXT_CHARACTERS:
        raise NergError(
            f'the column {sanitize(name, 40)!r} of the table "{path}" has cells with more characters than the maximum '
            f"of {MAX_TEXT_CHARACTERS:,}; use another column"
        )
    return np.array(words, dtype=str)


def _to_numbers(path: str | os.PathLike, name: str, column: Any, days: DayCounter | None) -> np.ndarray:
    """Convert a column to (n,) float64; times, for which there are ``days``, to their unit."""
    try:
        column = column.cast("float64") if str(column.type).startswith("decimal") else column
        values = column.to_numpy(zero_copy_only=False)
        if days is not None and values.dtype == object:
            cells = ["" if cell is None else str(cell) for cell in column.to_pylist()]
            dated = next((time[1] for cell in cells if (time := parse_clock_seconds(cell))), False)
            values = _parse_clock_column(cells, days.tick, dated)
            values = values if dated or values is None else days.unwrap(values)
        elif days is not None and values.dtype.kind in "mM":
            values = to_seconds(values, name) / days.tick
        if values is None:
            raise TypeError("no numbers")
        return to_numbers(values, name, flags=True)
    except (TypeError, ValueError):
        raise NergError(
            f'the column {sanitize(name, 40)!r} of the table "{path}" does not contain numbers; convert it, or '
            "use another column"
        ) from None


def _list_names(names: Sequence[str]) -> str:
    return ", ".join(sanitize(c, 40) for c in names[:12]) + (", ..." if len(names) > 12 else "")


# Beginnings of files that are no tables, and their remedies.
_OTHER_FILES = {
    "<": "it is HTML or XML instead of a table; download or export it again",
    "version https://git-lfs": 'it is a pointer of Git LFS; get the file (run "git lfs pull")',
    "{": "it is JSON; convert it to CSV",
    "[": "it is JSON; convert it to CSV",
    "PK\x03\x04": "it is a workbook or an archive; export it as CSV",
}


def explain_columns(columns: Sequence[str], remedy: str = f"choose some of them with {parameter('columns')}") -> str:
    """The end of a sentence about missing columns: which ``columns`` there are, and the ``remedy``; or why there is no
    header."""
    if not any(columns):
        return "it is empty; export it again"
    other = next((reason for start, reason in _OTHER_FILES.items() if columns[0].startswith(start)), None)
    if other is not None:
        return other
    if len(columns) == 1 and columns[0].startswith(("#", "%", "//")):
        return "its first line is a comment; remove the lines above the header"
    if len(columns) == 1 and ("|" in columns[0] or len(columns[0].split()) > 2):
        return (
            f'its first line, "{sanitize(columns[0], 40)}", has neither commas, semicolons nor tabs; export it with '
            "one of these between its columns"
        )
    return f"its columns are {_list_names(columns)}; {remedy}"


def _find_header(path: str | os.PathLike, names: Sequence[str]) -> int | None:
    """The number of the line, among the first of a text file, with all ``names``; programs write metadata above it."""
    if str(path).lower().endswith(".parquet"):
        return None
    with closing(read_line_blocks(path, "table", _HEADER_LINES)) as blocks:
        lines = [line.rstrip("\r\n") for line in next(blocks, [])]
    has_names = lambda line, separator: set(names) <= {cell.strip(' "') for cell in line.split(separator)}
    return next((k for k, line in enumerate(lines, 1) if any(has_names(line, separator) for separator in ",;\t")), None)


def check_columns(path: str | os.PathLike, requested: Sequence[str], available: Sequence[str]) -> None:
    """Raise `NergError` for a requested column that is missing, exists several times, or is requested twice."""
    missing = [c for c in requested if c not in available]
    if missing:
        line = _find_header(path, requested)
        where = f"line {line} has these columns; remove the lines above it" if line else explain_columns(available)
        raise NergError(f"{path} has no column {_list_names(missing)}; {where}")
    repeated = next((c for c in requested if available.count(c) > 1), None)
    if repeated is not None:
        raise NergError(f'the table "{path}" has several columns called {sanitize(repeated, 40)!r}; rename all but one')
    twice = next((c for c in requested if requested.count(c) > 1), None)
    if twice is not None:
        raise NergError(
            f"the column {sanitize(twice, 40)!r} of {path} has two roles; use another one in {parameter('columns')}"
        )


# ---- Times of day, and dates with times, as text: ISO 8601 and similar notations ----

_CLOCK_FORMAT = re.compile(
    r"(?:(?P<days>[+-]?\d+) days?,? \+?)?(?:(?:(?P<year>\d{4})[-/](?P<month>\d\d)[-/](?P<day>\d\d)|"
    r"(?P<day_>\d\d)\.(?P<month_>\d\d)\.(?P<year_>\d{4}))(?:[Tt]|,? +))?"
    r"(?P<hour>\d\d?):(?P<minute>\d\d):(?P<second>\d\d)(?:[.,](?P<fraction>\d+))?"
    r"(?: ?(?P<half>[AaPp])\.?[Mm]\.?)? ?"
    r"(?P<zone>[Zz]|UTC|GMT|(?P<sign>[+-])(?P<zone_hour>\d\d)(?::?(?P<zone_minute>\d\d))?)?"
)
# ISO 8601's basic format, only with a date: the time alone would be a number.
_BASIC_FORMAT = re.compile(r"(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d)(\d\d)(?=\D|$)")
_EPOCH = datetime.date(1970, 1, 1).toordinal()


def parse_clock_seconds(text: str) -> tuple[float, bool] | None:
    """Seconds of a time such as ``2024-05-01T12:00:00.25+02:00`` or ``12:00:00.25``, and whether it has a date, or is a
    duration with days, such as ``0 days 00:00:01.5``.

    With a date, seconds since 1970 in UTC, which is also assumed without an offset; otherwise since midnight. None for
    other text. Dates are year-month-day or day.month.year, and hours are up to 24 or have AM or PM, so that the order
    is never ambiguous.
    """
    match = _CLOCK_FORMAT.fullmatch(_BASIC_FORMAT.sub(r"\1-\2-\3T\4:\5:\6", text.strip()[:64]))
    if match is None:
        return None
    hour, minute, second = int(match["hour"]), int(match["minute"]), int(match["second"])
    if match["half"]:
        if not 1 <= hour <= 12:
            return None
        hour = hour % 12 + 12 * (match["half"] in "Pp")
    if hour > 23 or minute > 59 or second > 60:
        return None
    seconds = 3600.0 * hour + 60 * minute + second + (float(f"0.{match['fraction']}") if match["fraction"] else 0.0)
    if match["sign"]:
        offset = 3600 * int(match["zone_hour"]) + 60 * int(match["zone_minute"] or 0)
        seconds -= offset if match["sign"] == "+" else -offset
    year, month, day = (match[name] or match[f"{name}_"] for name in ("year", "month", "day"))
    if match["days"]:
        return (86400.0 * int(match["days"]) + seconds, True) if year is None else None
    if year is None:
        return seconds, False
    try:
        days = datetime.date(int(year), int(month), int(day)).toordinal() - _EPOCH
    except ValueError:
        return None
    return 86400.0 * days + seconds, True


_DAY_SECONDS = 86400.0
_MAX_PAUSE = 3600.0  # maximum seconds between the last time before midnight and the next time of a recording


class DayCounter:
    """Continues times of day without a date past midnight, block by block of one column.

    Midnight is assumed between two times if the second is earlier, and within an hour of the first on the next day.
    Other backward steps start another recording, as in a table of several participants, and forward steps of more than
    half a day go to the previous day. ``tick`` is the unit in seconds; ``on_note(passes_midnight=True)`` is called for
    blocks with times of another day.
    """

    def __init__(self, tick: float, on_note: Callable[..., None] | None = None) -> None:
        self.tick, self._on_note = tick, on_note
        self._last, self._day = np.nan, 0

    def unwrap(self, times: np.ndarray) -> np.ndarray:
        """Convert times (n,) since the last midnight to times since the first midnight; keeps NaN."""
        valid = np.isfinite(times)
        if not valid.any():
            return times
        steps = self.tick * np.diff(times[valid], prepend=self._last)
        days = self._day + np.cumsum((steps < _MAX_PAUSE - _DAY_SECONDS).astype(int) - (steps > _DAY_SECONDS / 2))
        days -= np.minimum(np.minimum.accumulate(days), 0)
        self._last, self._day = times[valid][-1], int(days[-1])
        if days.any() and self._on_note is not None:
            self._on_note(passes_midnight=True)
        out = times.copy()
        out[valid] += days * (_DAY_SECONDS / self.tick)
        return out
