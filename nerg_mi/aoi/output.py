"""Attention statistics as files: tables (CSV, Markdown, Parquet), figures and provenance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.figures import style
from nerg_mi.files.atomic import make_folder, replace_atomically, write_text
from nerg_mi.files.dataframes import ResultTables
from nerg_mi.files.tables import format_markdown_table, write_csv
from nerg_mi.files.values import FilePath
from nerg_mi.tracking.rays import import_pyarrow

from .charts import aois_figure, transitions_figure
from .tables import MEASURES, MEASURES_BY_NAME, NO_INTERVAL, PREDICTED, ParticipantRows, Row, format_measure
from .visits import VisitSums

# ---- Tables ----

MAX_MARKDOWN_ROWS = 10_000  # maximum number of rows of a Markdown table
_PARQUET_BATCH = 1 << 16
SUPPORT = "support [samples]"
_WHAT_IF_TITLES = {
    "share": "attention share",
    "corrected_share": "attention share, corrected for the tracker",
    "visible": "visible share",
}
_TEXT_COLUMNS = {
    "cell",
    "value",
    "first",
    "second",
    "AOI",
    "source",
    "participant",
    "from",
    "to",
    "measure",
    "significant",
    "note",
}
FormatRow = Callable[[Row], Sequence[Any]]


def has_parquet() -> bool:
    """Return whether pyarrow is installed, which writes Parquet files."""
    return find_spec("pyarrow") is not None


def write_rows(
    folder: Path, name: str, rows: Sequence[Row], header: Sequence[str], format_row: FormatRow
) -> list[Path]:
    """Write ``rows`` as CSV, Markdown and, if pyarrow is installed, Parquet. Return the paths.

    Parameters
    ----------
    folder
        Output folder.
    name
        File name without suffix.
    rows
        Rows of the table. They are read in batches, since `ParticipantRows` creates rows on access.
    header, format_row
        Column titles of the Markdown table, and a function that formats one of its rows. At most `MAX_MARKDOWN_ROWS`
        rows are written to Markdown.
    """
    columns = _column_names(rows)
    written = [folder / f"{name}.csv", folder / f"{name}.md"]
    write_csv(written[0], rows, columns)
    numeric = [title for title in header if title not in _TEXT_COLUMNS]
    text = format_markdown_table(header, [format_row(row) for row in rows[:MAX_MARKDOWN_ROWS]], numeric) + "\n"
    if len(rows) > MAX_MARKDOWN_ROWS:
        text += f"\nThis table shows {MAX_MARKDOWN_ROWS:,} of {len(rows):,} rows. See {name}.csv for all rows.\n"
    write_text(written[1], text)
    if has_parquet():
        written.append(folder / f"{name}.parquet")
        _write_parquet(written[-1], rows, columns)
    return written


def _column_names(rows: Sequence[Row]) -> list[str]:
    """Return all keys in order of first appearance."""
    if isinstance(rows, ParticipantRows):
        return list(rows.columns)
    return list(dict.fromkeys(key for row in rows for key in row))


def _write_parquet(path: Path, rows: Sequence[Row], columns: Sequence[str]) -> None:
    pa, pq = import_pyarrow()

    def table(start: int) -> Any:
        batch = rows[start : start + _PARQUET_BATCH]
        return pa.table({k: [row.get(k) for row in batch] for k in columns})

    first = table(0)
    schema = first.schema
    if len(rows) > _PARQUET_BATCH:
        # A column that is null in the first batch may have numbers in a later one.
        types = [pa.float64() if pa.types.is_null(f.type) else f.type for f in schema]
        schema = pa.schema(list(zip(columns, types)))
    with replace_atomically(path) as temporary, pq.ParquetWriter(temporary, schema) as writer:
        writer.write_table(first.cast(schema))
        for start in range(_PARQUET_BATCH, len(rows), _PARQUET_BATCH):
            writer.write_table(table(start).cast(schema))


def format_cell(row: Row) -> str:
    """Return the name of the cell of ``row``."""
    return "all" if row["cell"] == "all" else f"{row['cell']} {row['value']}"


def aoi_columns(rows: Sequence[Row]) -> tuple[list[str], FormatRow]:
    """Return the header and the row formatter of the AOI table; measures without values are omitted."""
    measures = [m for m in MEASURES if any(row.get(m.name) is not None for row in rows)]
    has_predictions = any(row["source"] == PREDICTED for row in rows)
    header = [
        "cell",
        "AOI",
        "source",
        "participants",
        *(m.title for m in measures),
        *([SUPPORT] if has_predictions else []),
    ]

    def format_row(row: Row) -> list[Any]:
        participants = "" if row["participants"] is None else row["participants"]
        cells_of_row = [
            format_cell(row),
            row["aoi"],
            row["source"],
            participants,
            *(format_measure(row, m) for m in measures),
        ]
        return [*cells_of_row, format_support(row)] if has_predictions else cells_of_row

    return header, format_row


def difference_columns(rows: Sequence[Row]) -> tuple[list[str], FormatRow]:
    """Return the header and the row formatter of the table of differences; shares are in percentage points, times in
    seconds."""
    header = ["cell", "first", "second", "AOI", "measure", "second - first", "p", "p, adjusted", "significant"]

    def format_row(row: Row) -> list[Any]:
        measure = MEASURES_BY_NAME[row["measure"]]
        scale, unit = (
            (100.0, " points") if measure.upper_limit == 1.0 else (1.0, " s" if "[s]" in measure.title else "")
        )
        difference = ""
        if row["difference"] is not None:
            difference = f"{scale * row['difference']:+.2f}{unit}"
            if row["low"] is not None:
                difference += f" [{scale * row['low']:+.2f}, {scale * row['high']:+.2f}]"
        p_values = ["" if row[key] is None else f"{row[key]:.3g}" for key in ("p", "p_adjusted")]
        name = measure.title.removesuffix(" [s]")
        return [
            row["cell"],
            row["first"],
            row["second"],
            row["aoi"],
            name,
            difference,
            *p_values,
            "yes" if row["significant"] else "",
        ]

    return header, format_row


def format_support(row: Row) -> str:
    """Format the number of training samples that support a prediction, or state that the checkpoint lacks it."""
    if row["source"] != PREDICTED or row["participants"] is None:
        return ""
    support = row.get("support")
    return "not in the checkpoint" if support is None else f"{support:,.0f}" if support >= 100 else f"{support:.3g}"


def what_if_columns(rows: Sequence[Row]) -> tuple[list[str], FormatRow]:
    """Return the header and the row formatter of the what-if table; shares are in percent, differences in percentage
    points."""
    has_spread = any(row["difference_spread"] is not None for row in rows)
    header = ["AOI", "measure", "participants", "before [%]", "after [%]", "difference [points]"]
    header += [*(["± ensemble"] if has_spread else []), "p", "p, adjusted", SUPPORT]

    def format_row(row: Row) -> list[Any]:
        number = lambda value, form: "" if value is None else format(value, form)
        percent = lambda value: "" if value is None else f"{100 * value:.2f}"
        difference = number(None if row["difference"] is None else 100 * row["difference"], "+.2f")
        if row["low"] is not None:
            difference += f" [{100 * row['low']:+.2f}, {100 * row['high']:+.2f}]"
        cells_of_row = [
            row["aoi"],
            _WHAT_IF_TITLES[row["measure"]],
            "" if row["participants"] is None else row["participants"],
        ]
        cells_of_row += [percent(row["before"]), percent(row["after"]), difference]
        cells_of_row += [percent(row["difference_spread"])] if has_spread else []
        return [*cells_of_row, number(row["p"], ".3g"), number(row["p_adjusted"], ".3g"), format_support(row)]

    return header, format_row


def all_columns(rows: Sequence[Row]) -> tuple[list[str], FormatRow]:
    """Return the header and the row formatter of a table that shows all keys."""
    header = _column_names(rows)

    def format_row(row: Row) -> list[Any]:
        return ["" if row.get(k) is None else f"{row[k]:.4g}" if isinstance(row[k], float) else row[k] for k in header]

    return header, format_row


# ---- Results ----

MAX_MATRIX_AREAS = 60  # maximum number of areas in the figure of transitions
_COLUMNS = {"aois": aoi_columns, "differences": difference_columns, "what_if": what_if_columns}


def _describe_largest(rows: Sequence[Row], source: str) -> str:
    """Return a sentence on the largest share of time of the areas of a source."""
    valid = [row for row in rows if row["share"] is not None]
    if not valid:
        return f"No {source} share of time is known."
    shares = np.array([row["share"] for row in valid])
    if not shares.any():
        return f"No {source} gaze is on an area."
    largest = [row for row, is_largest in zip(valid, np.isclose(shares, shares.max(), rtol=1e-9, atol=0)) if is_largest]
    share = format_measure(largest[0], MEASURES_BY_NAME["share"])
    share += f" ({NO_INTERVAL})" if largest[0].get("share_low") is None else ""
    names = " and ".join(row["aoi"] for row in largest)
    if len(valid) == 1:
        return f"{names} has the {source} share of time {share}."
    return f"{names} {'has' if len(largest) == 1 else 'have'} the largest {source} share of time: {share}."


@dataclass(frozen=True, eq=False, repr=False)
class StatisticsResult(ResultTables):
    """Attention statistics: tables as lists of dicts.

    Parameters
    ----------
    aois
        Measures by cell, area and source.
    differences
        Differences between cells.
    power
        Power of these differences by number of participants.
    transitions
        Transitions between areas.
    durations
        Histogram of visit durations.
    participants
        Measures of single participants.
    what_if
        Predicted effects of the changes.
    tracker
        Measures by cell and area, corrected for the error of the eye tracker.
    resolution
        Areas, and pairs of neighbours, that are too small for its accuracy.
    sums
        Sums that the tables were computed from.
    groups
        Names of the areas that are groups of others.
    num_suppressed
        Number of values that were suppressed because they rest on too few participants.
    provenance
        Origin of the tables.
    """

    TABLES = (
        "aois",
        "differences",
        "power",
        "transitions",
        "durations",
        "participants",
        "what_if",
        "tracker",
        "resolution",
    )

    aois: list[Row] = field(default_factory=list)
    differences: list[Row] = field(default_factory=list)
    power: list[Row] = field(default_factory=list)
    transitions: list[Row] = field(default_factory=list)
    durations: list[Row] = field(default_factory=list)
    participants: Sequence[Row] = ()
    what_if: list[Row] = field(default_factory=list)
    tracker: list[Row] = field(default_factory=list)
    resolution: list[Row] = field(default_factory=list)
    sums: VisitSums | None = None
    groups: Sequence[str] = ()
    num_suppressed: int = 0
    provenance: style.Provenance = field(default_factory=lambda: style.Provenance("nerg stats"))

    @property
    def verdict(self) -> str:
        """The area with the largest share, groups left out, and the significant differences between cells, in short
        sentences, one a line."""
        rows = [row for row in self.aois if row["cell"] == "all" and row["aoi"] not in self.groups]
        lines = [] if rows else ["There are no areas."]
        for source in dict.fromkeys(row["source"] for row in rows):
            lines.append(_describe_largest([row for row in rows if row["source"] == source], source))
        if self.differences:
            significant = [row for row in self.differences if row["significant"]]
            tested = sum(row["p_adjusted"] is not None for row in self.differences)
            untested = len(self.differences) - tested
            rest = f"; {untested} could not be tested, for lack of participants" if untested else ""
            lines.append(f"{len(significant)} of {tested} tested differences are significant{rest}.")
            format_row = difference_columns(significant)[1]
            for cell, first, second, aoi, measure, difference, *_ in map(format_row, significant):
                lines.append(f"{aoi}, {measure}: {difference} from {cell} {first} to {second}.")
        return "\n".join(lines)

    def save(self, folder: FilePath) -> list[Path]:
        """Write the non-empty tables (CSV, Markdown and, with pyarrow, Parquet), their figures and the provenance to a
        folder, which is created. Return the files."""
        folder, files = make_folder(Path(folder)), list[Path]()
        for name in self.TABLES:
            if rows := getattr(self, name):
                columns = _COLUMNS.get(name, all_columns)(rows)
                files += write_rows(folder, name, rows, *columns)
        if self.aois:
            first_cell = [r for r in self.aois if r["cell"] == self.aois[0]["cell"]]
            style.save(aois_figure(first_cell), folder / "aois.png", self.provenance)
            files.append(folder / "aois.png")
        if self.sums is not None and self.transitions:
            counts = {
                (r["from"], r["to"]): r["transitions"]
                for r in self.transitions
                if r["cell"] == "all" and r["transitions"] is not None
            }
            names = [n for n in self.sums.areas if any(n in pair for pair in counts)]
            if 1 < len(names) <= MAX_MATRIX_AREAS:
                matrix = np.array([[counts.get((a, b), 0) for b in names] for a in names], float)
                style.save(transitions_figure(names, matrix), folder / "transitions.png", self.provenance)
                files.append(folder / "transitions.png")
        write_text(folder / "about.json", self.provenance.json() + "\n")
        files.append(folder / "about.json")
        if self.num_suppressed:
            text = f"{self.num_suppressed} values are suppressed, because they rest on too few participants\n"
            write_text(folder / "suppressed.txt", text)
            files.append(folder / "suppressed.txt")
        return files
