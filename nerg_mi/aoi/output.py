"""Statistics of attention as files: tables in CSV, Markdown and Parquet, pictures, and the account of how they were
made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.figures.statistics import map_figure, moves_figure, things_figure
from nerg_mi.figures.style import make_provenance, save
from nerg_mi.files.atomic import replace_atomically, write_text
from nerg_mi.files.tables import format_markdown_table, write_csv
from nerg_mi.rays.rays import import_pyarrow
from nerg_mi.statistics.tables import MEASURES_BY_NAME, PREDICTED, MEASURES, ParticipantRows, Row, format_measure
from nerg_mi.statistics.visits import VisitSums
from nerg_mi.workflows.base import Reporter

from .options import StatisticsOptions

# ---- Writing ----
#
# Tables of statistics as files: CSV, Markdown and, with pyarrow, Parquet.

MOST_LINES = 10_000  # rows of a table in Markdown: more are nobody's to read
_PART = 1 << 16
SUPPORT = "support [rays]"
_MEASURES = {"share": "share of gaze", "visible": "visible share"}
_WORDS = {"cell", "value", "first", "second", "thing", "source", "person", "from", "to", "measure", "found"}
FormatRow = Callable[[Row], Sequence[Any]]


def has_parquet() -> bool:
    """Whether Parquet can be written here."""
    return find_spec("pyarrow") is not None


def write_rows(folder: Path, name: str, rows: Sequence[Row], header: Sequence[str], format_row: FormatRow) -> list[Path]:
    """``rows`` as ``name``.csv, .md and, where that can be, .parquet in a ``folder``; ``head`` and ``cells``: the
    columns of the Markdown, which has `MOST_LINES` rows at most and says how many there are. Of no rows there is a
    table of names alone. Rows are read in parts, so that those of `PersonRows` are never there all at once."""
    columns = _names(rows) or list(header)
    written = [folder / f"{name}.csv", folder / f"{name}.md"]
    write_csv(written[0], rows, columns)
    right = [title for title in header if title not in _WORDS]
    text = format_markdown_table(header, [format_row(row) for row in rows[:MOST_LINES]], right) + "\n"
    if len(rows) > MOST_LINES:
        text += f"\nThe first {MOST_LINES:,} of {len(rows):,} rows; all are in {name}.csv.\n"
    write_text(written[1], text)
    if has_parquet():
        written.append(folder / f"{name}.parquet")
        _write_parquet(written[-1], rows, columns)
    return written


def _names(rows: Sequence[Row]) -> list[str]:
    """All columns, in the order in which they appear."""
    if isinstance(rows, ParticipantRows):
        return list(rows.columns)
    return list(dict.fromkeys(key for row in rows for key in row))


def _write_parquet(path: Path, rows: Sequence[Row], columns: Sequence[str]) -> None:
    pa, pq = import_pyarrow()

    def table(start: int) -> Any:
        part = rows[start : start + _PART]
        return pa.table({k: [row.get(k) for row in part] for k in columns})

    first = table(0)
    schema = first.schema
    if len(rows) > _PART:
        # What is not known in the first part may be a number in others.
        kinds = [pa.float64() if pa.types.is_null(f.type) else f.type for f in schema]
        schema = pa.schema(list(zip(columns, kinds)))
    with replace_atomically(path) as temporary, pq.ParquetWriter(temporary, schema) as writer:
        writer.write_table(first.cast(schema))
        for start in range(_PART, len(rows), _PART):
            writer.write_table(table(start).cast(schema))


def cell_name(row: Row) -> str:
    """What a row is of, in words."""
    return "all" if row["cell"] == "all" else f"{row['cell']} {row['value']}"


def thing_columns(rows: Sequence[Row]) -> tuple[list[str], FormatRow]:
    """Head and cells of the table of things, with the measures that any row has."""
    used = [m for m in MEASURES if any(row.get(m.name) is not None for row in rows)]
    foretold = any(row["source"] == PREDICTED for row in rows)
    head = ["cell", "thing", "source", "people", *(m.title for m in used), *([SUPPORT] if foretold else [])]

    def cells(row: Row) -> list[Any]:
        people = "" if row["people"] is None else row["people"]
        found = [cell_name(row), row["thing"], row["source"], people, *(format_measure(row, m) for m in used)]
        return [*found, support_words(row)] if foretold else found

    return head, cells


def difference_columns(rows: Sequence[Row]) -> tuple[list[str], FormatRow]:
    """Head and cells of the table of differences: shares in points of a percent, times in seconds."""
    head = ["cell", "first", "second", "thing", "measure", "second - first", "p", "p, adjusted", "found"]

    def cells(row: Row) -> list[Any]:
        measure = MEASURES_BY_NAME[row["measure"]]
        scale, unit = (100.0, " points") if measure.upper_limit == 1.0 else (1.0, " s" if "[s]" in measure.title else "")
        told = ""
        if row["difference"] is not None:
            told = f"{scale * row['difference']:+.2f}{unit}"
            if row["low"] is not None:
                told += f" [{scale * row['low']:+.2f}, {scale * row['high']:+.2f}]"
        p = ["" if row[key] is None else f"{row[key]:.3g}" for key in ("p", "p_adjusted")]
        name = measure.title.removesuffix(" [s]")
        return [row["cell"], row["first"], row["second"], row["thing"], name, told, *p, "yes" if row["found"] else ""]

    return head, cells


def support_words(row: Row) -> str:
    """How many rays a number of a field rests on, or that its checkpoint does not say."""
    if row["source"] != PREDICTED or row["people"] is None:
        return ""
    support = row.get("support")
    return "not in the checkpoint" if support is None else f"{support:,.0f}" if support >= 100 else f"{support:.3g}"


def what_if_columns(rows: Sequence[Row]) -> tuple[list[str], FormatRow]:
    """Head and cells of the table of changes: shares in percent, their differences in points of it."""
    spread = any(row["difference_spread"] is not None for row in rows)
    head = ["thing", "measure", "people", "before [%]", "after [%]", "difference [points]"]
    head += [*(["± members"] if spread else []), "p", "p, adjusted", SUPPORT]

    def cells(row: Row) -> list[Any]:
        number = lambda value, form: "" if value is None else format(value, form)
        percent = lambda value: "" if value is None else f"{100 * value:.2f}"
        moved = number(None if row["difference"] is None else 100 * row["difference"], "+.2f")
        if row["low"] is not None:
            moved += f" [{100 * row['low']:+.2f}, {100 * row['high']:+.2f}]"
        found = [row["thing"], _MEASURES[row["measure"]], "" if row["people"] is None else row["people"]]
        found += [percent(row["before"]), percent(row["after"]), moved]
        found += [percent(row["difference_spread"])] if spread else []
        return [*found, number(row["p"], ".3g"), number(row["p_adjusted"], ".3g"), support_words(row)]

    return head, cells


def plain_columns(rows: Sequence[Row], names: Sequence[str] = ()) -> tuple[list[str], FormatRow]:
    """Head and cells of a table whose columns are told as they are."""
    head = _names(rows) or list(names)

    def cells(row: Row) -> list[Any]:
        return ["" if row.get(k) is None else f"{row[k]:.4g}" if isinstance(row[k], float) else row[k] for k in head]

    return head, cells


# ---- Results ----
#
# Results of statistics as files: a table each, pictures, and the account of how they were made.

LARGEST_MATRIX = 60  # things of which moves are drawn at most
_COLUMNS = {"things": thing_columns, "differences": difference_columns, "what_if": what_if_columns}


@dataclass(frozen=True, eq=False)
class StatisticsResult:
    """Rows of tables, each a dict: ``things`` (by cell, thing and source), ``differences``, ``moves``, ``durations``,
    ``people``, ``what_if``, ``isovists``; ``sums``: what they were made of; ``blanked``: numbers on too few people;
    ``files`` that were written."""

    aois: list[Row] = field(default_factory=list)
    differences: list[Row] = field(default_factory=list)
    transitions: list[Row] = field(default_factory=list)
    durations: list[Row] = field(default_factory=list)
    participants: Sequence[Row] = ()
    what_if: list[Row] = field(default_factory=list)
    isovists: list[Row] = field(default_factory=list)
    sums: VisitSums | None = None
    num_suppressed: int = 0
    files: list[Path] = field(default_factory=list)


def write_results(
    folder: Path, result: StatisticsResult, inputs: Sequence[Path], options: StatisticsOptions, reporter: Reporter
) -> list[Path]:
    """Write what there is into the ``folder``: each table as CSV, Markdown and Parquet, and its picture."""
    about = make_provenance("nerg stats", inputs, options.seed, options)
    files: list[Path] = []
    for name in ("things", "differences", "moves", "durations", "people", "what_if", "isovists"):
        rows: Sequence[Row] = getattr(result, name)
        if rows:
            columns = _COLUMNS.get(name, plain_columns)(rows)
            files += write_rows(folder, name, rows, *columns)
    if result.aois:
        first = [r for r in result.aois if r["cell"] == result.aois[0]["cell"]]
        save(things_figure(first), folder / "things.png", about)
        files.append(folder / "things.png")
    if result.sums is not None and result.transitions:
        told = {(r["from"], r["to"]): r["moves"] for r in result.transitions if r["cell"] == "all" and r["moves"] is not None}
        names = [n for n in result.sums.areas if any(n in pair for pair in told)]
        if 1 < len(names) <= LARGEST_MATRIX:
            matrix = np.array([[told.get((a, b), 0) for b in names] for a in names], float)
            save(moves_figure(names, matrix), folder / "moves.png", about)
            files.append(folder / "moves.png")
    if result.isovists:
        points = np.array([[r["x"], r["y"]] for r in result.isovists])
        area = np.array([r["area"] for r in result.isovists])
        figure = map_figure(points, area, options.grid_step, "area that is seen [m²]", "Isovists at eye height")
        save(figure, folder / "isovists.png", about)
        files.append(folder / "isovists.png")
    write_text(folder / "about.json", about.json() + "\n")
    files.append(folder / "about.json")
    if not has_parquet():
        reporter.message("Parquet is left out, since pyarrow is not installed: pip install 'nerg-mi[parquet]'")
    reporter.message(f"wrote {len(files)} files to {folder}: {', '.join(p.name for p in files if p.suffix == '.md')}")
    if result.num_suppressed:
        write_text(folder / "blanked.txt", f"{result.num_suppressed} numbers rest on too few people and are blank\n")
        files.append(folder / "blanked.txt")
    return files
