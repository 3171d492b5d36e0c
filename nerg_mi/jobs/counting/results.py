"""Results of statistics as files: a table each, pictures, and the account of how they were made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from nerg_mi.figures.provenance import provenance
from nerg_mi.figures.saving import save
from nerg_mi.figures.statistics_figures import map_figure, moves_figure, things_figure
from nerg_mi.files.atomic import write_text
from nerg_mi.jobs.options.statistics import StatisticsOptions
from nerg_mi.jobs.reporter import Reporter
from nerg_mi.statistics.tables import Row
from nerg_mi.statistics.visits import Sums

from .writing import difference_columns, has_parquet, plain_columns, thing_columns, what_if_columns, write_rows

LARGEST_MATRIX = 60
"""Things of which moves are drawn at most."""

_COLUMNS = {"things": thing_columns, "differences": difference_columns, "what_if": what_if_columns}


class Results(Protocol):
    """The tables of `nerg_mi.jobs.statistics.StatisticsResult`."""

    @property
    def things(self) -> list[Row]: ...

    @property
    def differences(self) -> list[Row]: ...

    @property
    def moves(self) -> list[Row]: ...

    @property
    def durations(self) -> list[Row]: ...

    @property
    def people(self) -> Sequence[Row]: ...

    @property
    def what_if(self) -> list[Row]: ...

    @property
    def isovists(self) -> list[Row]: ...

    @property
    def blanked(self) -> int: ...

    @property
    def sums(self) -> Sums | None: ...


def write_results(
    folder: Path, result: Results, inputs: Sequence[Path], options: StatisticsOptions, reporter: Reporter
) -> list[Path]:
    """Write what there is into the ``folder``: each table as CSV, Markdown and Parquet, and its picture."""
    about = provenance("nerg stats", inputs, options.seed, options)
    files: list[Path] = []
    for name in ("things", "differences", "moves", "durations", "people", "what_if", "isovists"):
        rows: Sequence[Row] = getattr(result, name)
        if rows:
            columns = _COLUMNS.get(name, plain_columns)(rows)
            files += write_rows(folder, name, rows, *columns)
    if result.things:
        first = [r for r in result.things if r["cell"] == result.things[0]["cell"]]
        save(things_figure(first), folder / "things.png", about)
        files.append(folder / "things.png")
    if result.sums is not None and result.moves:
        told = {(r["from"], r["to"]): r["moves"] for r in result.moves if r["cell"] == "all" and r["moves"] is not None}
        names = [n for n in result.sums.areas if any(n in pair for pair in told)]
        if 1 < len(names) <= LARGEST_MATRIX:
            matrix = np.array([[told.get((a, b), 0) for b in names] for a in names], float)
            save(moves_figure(names, matrix), folder / "moves.png", about)
            files.append(folder / "moves.png")
    if result.isovists:
        points = np.array([[r["x"], r["y"]] for r in result.isovists])
        area = np.array([r["area"] for r in result.isovists])
        figure = map_figure(points, area, options.step, "area that is seen [m²]", "Isovists at eye height")
        save(figure, folder / "isovists.png", about)
        files.append(folder / "isovists.png")
    write_text(folder / "about.json", about.json() + "\n")
    files.append(folder / "about.json")
    if not has_parquet():
        reporter.message("Parquet is left out, since pyarrow is not installed: pip install 'nerg-mi[parquet]'")
    reporter.message(f"wrote {len(files)} files to {folder}: {', '.join(p.name for p in files if p.suffix == '.md')}")
    if result.blanked:
        write_text(folder / "blanked.txt", f"{result.blanked} numbers rest on too few people and are blank\n")
        files.append(folder / "blanked.txt")
    return files
