"""Tables of tracking: CSV and Parquet files in blocks, with their header checked against their rows."""

from __future__ import annotations

import csv
import datetime
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import BadLineCallback, read_line_blocks, translate_read_errors
from nerg_mi.rays.rays import open_parquet

BLOCK = 1 << 16  # rows converted at a time: memory stays bounded
COLUMNS = 1 << 14  # A table may have so many columns
TEXT_CHARACTERS = 1000  # So many characters may a cell have that is read as text

# Cells of an array of text all take the space of the longest: rows times its characters, at four bytes each.
_TEXT_BLOCK = 1 << 26

# Memory of a row that is read, at least.
_ROW_BYTES = 32

_MISSING = {"", "nan", "na", "n/a", "null", "none", "-"}

_DECIMAL = re.compile(r"\s*[+-]?\d*([.,])\d*([eE][+-]?\d+)?\s*")

# Two cells that a decimal comma may have made of one number, or of a time.
_WHOLE, _FRACTION = re.compile(r"(^|[+:-])\d+$"), re.compile(r"\d+([eE][+-]?\d+)?")


class TableBlock(NamedTuple):
    """A run of n rows of a table."""

    numbers: np.ndarray  # (n, C) float64 in the order asked, NaN where a cell is empty
    texts: np.ndarray  # (n, T) str
    lines: np.ndarray  # (n,) 1-based lines of the file; rows for Parquet


def read_table_columns(path: str | os.PathLike) -> list[str]:
    """Names of a table's columns; of a CSV those of its first line. Raises `NergError` for a damaged file."""
    if str(path).lower().endswith(".parquet"):
        with open_parquet(path, "table", _ROW_BYTES) as table:
            return list(table.schema_arrow.names)
    with closing(read_line_blocks(path, "table", 1)) as blocks:
        return _header(path, next(blocks, [""])[0])[0]


def iterate_table(
    path: str | os.PathLike,
    numbers: Sequence[str],
    texts: Sequence[str] = (),
    header: Sequence[str] | None = None,
    on_bad: BadLineCallback | None = None,
    *,
    first_line: int = 1,
    clocks: Mapping[str, float] | None = None,
    on_note: Callable[..., None] | None = None,
) -> Iterator[TableBlock]:
    """Yield named columns of a table in blocks of at most ``BLOCK`` rows.

    The separator (comma, semicolon or tab) is taken from the header, and the decimal sign (point or comma) from the
    first number that has one. Cells that are empty or say nan, na, null or none are NaN.

    Parameters
    ----------
    header
        The names of the columns of a CSV whose ``first_line`` is none.
    on_bad
        Called with each line that cannot be read, which is left out. Without it such a line raises.
    clocks
        Those of ``numbers`` whose cells may be times such as ``2024-05-01T12:00:00`` or ``12:00:00.25``
        (`clock_seconds`), with the seconds of the unit in which they are returned, and in which plain numbers count.
        Times of day without a date go on past midnight (`DayCounter`).
    on_note
        Called with ``decimal=","`` where commas are taken for decimal signs, and with ``passes_midnight=True`` where
        times of day do.

    Raises
    ------
    NergError
        For a damaged file, a missing or repeated column, a column that is requested twice, and, without ``on_bad``, a
        row with more or fewer cells than the header (a single separator at its end aside) or a cell that is no number,
        naming the line. Where pyarrow is installed it converts the cells, to the same numbers.
    """
    if str(path).lower().endswith(".parquet"):
        yield from _iterate_parquet(path, numbers, texts, clocks or {}, on_note)
        return
    count, layout, convert = 0, None, None
    days: dict[int, DayCounter] = {}
    for raw in read_line_blocks(path, "table", BLOCK):
        skip = max(0, first_line - 1 - count)
        raw, count = raw[skip:], count + min(skip, len(raw))
        if layout is None and raw:
            columns, separator = (list(header), ",") if header is not None else _header(path, raw[0])
            if header is None:
                raw, count = raw[1:], count + 1
            check_columns(path, [*numbers, *texts], columns)
            number_at, text_at = ([columns.index(name) for name in names] for names in (numbers, texts))
            layout = _Layout(separator, columns, number_at, text_at, ".", {}, len(columns))
        blank = [line.isspace() for line in raw]
        lines = count + 1 + np.flatnonzero(~np.array(blank, dtype=bool))
        rows = raw if len(lines) == len(raw) else [line for line, gone in zip(raw, blank) if not gone]
        count += len(raw)
        if rows and layout is not None:
            if convert is None:
                layout = _with_spelling(layout, rows, clocks or {})
                convert = _fast_reader(layout) or (lambda rows: None)
                if on_note is not None and layout.decimal == ",":
                    on_note(decimal=",")
                days = {k: DayCounter(tick, on_note) for k, (tick, dated) in layout.clocks.items() if not dated}
            values = convert(rows)
            block = TableBlock(*values, lines) if values else _convert(path, rows, lines, layout, on_bad)
            for k, counter in days.items():
                column = block.numbers[:, layout.number_at.index(k)]
                column[:] = counter.unwrap(column)
            if len(block.lines):
                yield block
    if layout is None and header is None:
        check_columns(path, [*numbers, *texts], [])


class _Layout(NamedTuple):
    """Where in the lines of a CSV the wanted cells stand, and how they are written."""

    separator: str
    columns: list[str]  # of the file
    number_at: list[int]  # places among them of the columns of numbers
    text_at: list[int]  # and of texts
    decimal: str  # sign: point or comma
    clocks: dict[int, tuple[float, bool]]  # places of times as text: seconds of a unit, and whether with a date
    row_cells: int  # of the first row that is whole

    @property
    def width(self) -> int:
        """Cells of a row without the empty one after a separator at its end."""
        return len(self.columns) - (len(self.columns) > 1 and not self.columns[-1])

    def accepts(self, cells: int, last: str) -> bool:
        """Whether a row of so many cells, the last of which is ``last``, is one of the header's."""
        return cells in (self.width, len(self.columns)) or (cells == self.width + 1 and not last.strip())


def _with_spelling(layout: _Layout, rows: list[str], clocks: Mapping[str, float]) -> _Layout:
    """The layout with what the first ``rows`` tell of how numbers and times are written."""
    ticks = {layout.columns.index(name): tick for name, tick in clocks.items() if name in layout.columns}
    times: dict[int, tuple[float, bool]] = {}
    waiting, decimal, row_cells = set(ticks), "", 0
    for row in rows:
        cells = _split(row, layout.separator) or []
        if not layout.accepts(len(cells), cells[-1] if cells else ""):
            continue
        row_cells = row_cells or len(cells)
        for k in [k for k in waiting if cells[k].strip().lower() not in _MISSING]:
            waiting.remove(k)
            time = clock_seconds(cells[k])
            if time is not None:
                times[k] = ticks[k], time[1]
        signs = (match[1] for k in layout.number_at if k not in times and (match := _DECIMAL.fullmatch(cells[k])))
        decimal = decimal or next(signs, "")
        if decimal and not waiting:
            break
    return layout._replace(decimal=decimal or ".", clocks=times, row_cells=row_cells)


def _split(row: str, separator: str) -> list[str] | None:
    """The cells of a line; None where quotes or lengths forbid."""
    try:
        return next(csv.reader([row], delimiter=separator), [])
    except csv.Error:
        return None


def _header(path: str | os.PathLike, line: str) -> tuple[list[str], str]:
    """Column names and the separator between them."""
    line = line.rstrip("\r\n").lstrip("\ufeff")
    if line.startswith("Format Version,"):
        raise NergError(f'"{path}" is an export of OptiTrack\'s Motive; import it with --preset motive')
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
    separator, number_at, text_at, words = layout.separator, layout.number_at, layout.text_at, set(layout.text_at)
    words |= set(layout.clocks)
    names = [str(i) for i in range(layout.row_cells)]
    if not layout.width <= len(names) <= layout.width + 1:
        return None
    # A row may end in a separator; nothing may stand after it unless the header names it.
    spare = [names[-1]] if len(names) > len(layout.columns) else []
    options = dict(
        read_options=pc.ReadOptions(column_names=names),
        parse_options=pc.ParseOptions(delimiter=separator, ignore_empty_lines=False),
        convert_options=pc.ConvertOptions(
            include_columns=[*(names[i] for i in (*number_at, *text_at)), *spare],
            column_types={
                **{names[i]: pa.float64() for i in number_at},
                **{names[i]: pa.string() for i in words},
                **{name: pa.string() for name in spare},
            },
            null_values=["", *(spelt for word in _MISSING if word for spelt in (word, word.upper(), word.title()))],
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
        if any(cell.strip() for name in spare for cell in table.column(name).to_pylist()):
            return None
        numbers = []
        for i in number_at:
            column = table.column(names[i])
            if i in layout.clocks:
                times = _clock_column(column.to_pylist(), *layout.clocks[i])
                if times is None:
                    return None
                numbers.append(times)
            else:
                numbers.append(column.to_numpy())
        values = np.stack(numbers, axis=1) if numbers else np.empty((len(rows), 0))
        cells = [table.column(names[i]).to_numpy() for i in text_at]
        if any(len(rows) * max(map(len, column)) > _TEXT_BLOCK for column in cells):
            return None
        texts = [np.char.strip(column.astype(str)) for column in cells]
        return values, np.stack(texts, axis=1) if texts else np.empty((len(rows), 0), dtype=str)

    return convert


def _clock_column(cells: Sequence[str], tick: float, dated: bool) -> np.ndarray | None:
    """Times (n,) in units of ``tick`` seconds; None where a cell is none, or differs in whether it has a date."""
    times = [np.nan if cell.strip().lower() in _MISSING else _clock(cell, tick, dated) for cell in cells]
    return None if None in times else np.array(times, np.float64)


def _clock(cell: str, tick: float, dated: bool) -> float | None:
    time = clock_seconds(cell)
    return None if time is None or time[1] != dated else time[0] / tick


def _convert(
    path: str | os.PathLike, rows: list[str], lines: np.ndarray, layout: _Layout, on_bad: BadLineCallback | None
) -> TableBlock:
    too_long = layout.text_at and len(rows) * max(map(len, rows)) > _TEXT_BLOCK
    if too_long or layout.decimal != "." or layout.clocks or not all(_has_all_cells(row, layout) for row in rows):
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


def _has_all_cells(row: str, layout: _Layout) -> bool:
    if '"' in row:
        cells = _split(row, layout.separator) or []
        return layout.accepts(len(cells), cells[-1] if cells else "")
    row = row.rstrip("\r\n")
    return layout.accepts(row.count(layout.separator) + 1, row[row.rfind(layout.separator) + 1 :])


def _convert_slowly(
    path: str | os.PathLike, rows: list[str], lines: np.ndarray, layout: _Layout, on_bad: BadLineCallback | None
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
        return f": it cannot be split into cells ({error}); correct or remove the line"
    if not layout.accepts(len(cells), cells[-1] if cells else ""):
        return _why_other_width(cells, layout)
    for k in layout.text_at:
        if len(cells[k]) > TEXT_CHARACTERS:
            what = (
                f"column {sanitize(layout.columns[k], 40)!r}: more than the {TEXT_CHARACTERS:,} characters that are read"
            )
            return f", {what}; correct or remove the line"
    numbers = []
    for k in layout.number_at:
        word = cells[k].strip()
        number = np.nan if word.lower() in _MISSING else _number(word, k, layout)
        if number is None:
            cell = f"column {sanitize(layout.columns[k], 40)!r}: {sanitize(word, 60)!r}"
            return f", {cell} {_why_no_number(word, k, layout)}"
        numbers.append(number)
    return cells, numbers


def _number(word: str, k: int, layout: _Layout) -> float | None:
    if k in layout.clocks:
        return _clock(word, *layout.clocks[k])
    if layout.decimal == ",":
        # A point would be another decimal sign, or one between thousands.
        word = "" if "." in word else word.replace(",", ".", 1)
    try:
        return float(word)
    except ValueError:
        return None


def _why_no_number(word: str, k: int, layout: _Layout) -> str:
    if k in layout.clocks:
        return "is no time such as those before it; write all times of the column alike"
    if any(sign in word for sign in ".," if sign != layout.decimal):
        sign = {".": "points", ",": "commas"}[layout.decimal]
        return f"is not a number with the decimal {sign} that the table has; write all numbers alike"
    return "is not a number; correct the cell or the column map"


def _why_other_width(cells: list[str], layout: _Layout) -> str:
    """What is wrong with a row of more or fewer cells than the header has, and the remedy."""
    why, pairs, k = f": {len(cells)} cells, the header has {layout.width}", 0, 0
    while k + 1 < len(cells):
        pair = bool(_WHOLE.search(cells[k]) and _FRACTION.fullmatch(cells[k + 1]))
        pairs, k = pairs + pair, k + 1 + pair
    if layout.separator == "," and 0 < len(cells) - layout.width <= pairs:
        return (
            f"{why}; are these decimal commas? They cannot be told from the commas between cells: export the table "
            "with decimal points, or with semicolons between its cells"
        )
    return f"{why}; correct or remove the line"


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
            batches = table.iter_batches(batch_size=BLOCK, columns=wanted)
        while True:
            with translate_read_errors(path, "table", extra_errors=(pa.ArrowException,)):
                batch = next(batches, None)
                if batch is None:
                    return
                n = batch.num_rows
                column = {c: batch.column(batch.schema.get_field_index(c)) for c in wanted}
                values = [_as_numbers(path, c, column[c], days.get(c)) for c in numbers]
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
            f'the column {sanitize(name, 40)!r} of the table "{path}" has cells of more than the {TEXT_CHARACTERS:,} '
            "characters that are read; name another one"
        )
    return np.array(words, dtype=str)


def _as_numbers(path: str | os.PathLike, name: str, column: Any, days: DayCounter | None) -> np.ndarray:
    """A column as (n,) float64; one of times, for which there are ``days``, in their unit."""
    try:
        values = column.to_numpy(zero_copy_only=False)
        if days is not None and values.dtype == object:
            cells = ["" if cell is None else str(cell) for cell in column.to_pylist()]
            dated = next((time[1] for cell in cells if (time := clock_seconds(cell))), False)
            values = _clock_column(cells, days.tick, dated)
            values = values if dated or values is None else days.unwrap(values)
        elif days is not None and values.dtype.kind == "M":
            since = values.astype("datetime64[ns]").astype(np.int64) * (1e-9 / days.tick)
            values = np.where(np.isnat(values), np.nan, since)
        if values is None or values.dtype.kind == "M":
            raise TypeError("no numbers")
        return values.astype(np.float64)
    except (TypeError, ValueError):
        raise NergError(
            f'the column {sanitize(name, 40)!r} of the table "{path}" holds no numbers; name another one'
        ) from None


def check_columns(path: str | os.PathLike, wanted: Sequence[str], there: Sequence[str]) -> None:
    """Raise `NergError` for a ``wanted`` column that is not ``there``, is there several times, or is wanted twice."""
    missing = [c for c in wanted if c not in there]
    if missing:
        brief = lambda names: ", ".join(sanitize(c, 40) for c in names[:12]) + (", ..." if len(names) > 12 else "")
        raise NergError(
            f"{path} has no column {brief(missing)}; its columns are {brief(there) or 'none'}; name those by --map"
        )
    repeated = next((c for c in wanted if there.count(c) > 1), None)
    if repeated is not None:
        raise NergError(f'the table "{path}" has several columns called {sanitize(repeated, 40)!r}; rename all but one')
    twice = next((c for c in wanted if wanted.count(c) > 1), None)
    if twice is not None:
        raise NergError(f"the column {sanitize(twice, 40)!r} of {path} is used in two roles; name another one in --map")


# ---- Times of day, and dates with one, as text: ISO 8601 and what is close to it ----

_CLOCK = re.compile(
    r"(?:(?:(?P<year>\d{4})[-/](?P<month>\d\d)[-/](?P<day>\d\d)|"
    r"(?P<day_>\d\d)\.(?P<month_>\d\d)\.(?P<year_>\d{4}))(?:T|,? +))?"
    r"(?P<hour>\d\d?):(?P<minute>\d\d):(?P<second>\d\d)(?:[.,](?P<fraction>\d+))?"
    r"(?: ?(?P<half>[AaPp])\.?[Mm]\.?)? ?(?P<zone>Z|(?P<sign>[+-])(?P<zone_hour>\d\d):?(?P<zone_minute>\d\d))?"
)
# ISO 8601's basic format; its time alone would be a number.
_BASIC = re.compile(r"(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d)(\d\d)(?=\D|$)")
_EPOCH = datetime.date(1970, 1, 1).toordinal()


def clock_seconds(text: str) -> tuple[float, bool] | None:
    """Seconds of a time such as ``2024-05-01T12:00:00.25+02:00`` or ``12:00:00.25``, and whether it has a date.

    With a date they count from 1970 in UTC, as which a time without an offset is taken; else from midnight. None for
    any other text. Dates are year-month-day or day.month.year, and hours count to 24 or have AM or PM, so that no order
    has to be guessed.
    """
    match = _CLOCK.fullmatch(_BASIC.sub(r"\1-\2-\3T\4:\5:\6", text.strip()[:64]))
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
        offset = 3600 * int(match["zone_hour"]) + 60 * int(match["zone_minute"])
        seconds -= offset if match["sign"] == "+" else -offset
    year, month, day = (match[name] or match[f"{name}_"] for name in ("year", "month", "day"))
    if year is None:
        return seconds, False
    try:
        days = datetime.date(int(year), int(month), int(day)).toordinal() - _EPOCH
    except ValueError:
        return None
    return 86400.0 * days + seconds, True


_DAY = 86400.0
_PAUSE = 3600.0  # seconds between two times of one recording, at most, of which one is before midnight


class DayCounter:
    """Lets times of day without a date go on past midnight, block by block of one column.

    Midnight lies between two times of which the second is earlier, and within an hour of the first on the next day.
    Other steps back lead from one recording to another, as in a table of several participants, and steps forth of more
    than half a day to the day before. ``tick``: seconds of a unit; ``on_note(passes_midnight=True)`` is called where a
    block has times of another day.
    """

    def __init__(self, tick: float, on_note: Callable[..., None] | None = None) -> None:
        self.tick, self._on_note = tick, on_note
        self._last, self._day = np.nan, 0

    def unwrap(self, times: np.ndarray) -> np.ndarray:
        """Units since the first midnight, (n,), of units since the last one; NaN stays."""
        valid = np.isfinite(times)
        if not valid.any():
            return times
        steps = self.tick * np.diff(times[valid], prepend=self._last)
        days = self._day + np.cumsum((steps < _PAUSE - _DAY).astype(int) - (steps > _DAY / 2))
        days -= np.minimum(np.minimum.accumulate(days), 0)
        self._last, self._day = times[valid][-1], int(days[-1])
        if days.any() and self._on_note is not None:
            self._on_note(passes_midnight=True)
        out = times.copy()
        out[valid] += days * (_DAY / self.tick)
        return out
