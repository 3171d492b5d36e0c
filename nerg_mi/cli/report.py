"""`nerg report`: the command line of `nerg_mi.jobs.report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.report import ReportOptions

from .options import takes
from .progress import TerminalReporter


@takes(ReportOptions)
def report_command(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="In any order: a gaze field, and what there is of its place, rays, evaluations (gaze.json, or the "
            "folder of nerg eval gaze); a folder stands for what lies in it.",
            metavar="RUN",
        ),
    ],
    options: ReportOptions,
    output: Annotated[Path, typer.Option("-o", "--output", help="File to write (.html).")] = Path("report.html"),
) -> None:
    """Write a report on a gaze field: one HTML file that opens from disk and needs no network.

    It shows the place, the data, where people were, the gaze, named objects, the scores beside their baselines with a
    verdict in a sentence, uncertainty, settings, limits, provenance and the place in 3D. What is missing is left out,
    and said so.
    """
    from nerg_mi.jobs import report

    with TerminalReporter() as reporter:
        report.make_report(files, output, options, reporter)
