"""`nerg stats`: the command line of `nerg_mi.jobs.statistics`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.aoi.options import StatisticsOptions

from .options import takes
from .progress import TerminalReporter


@takes(StatisticsOptions)
def stats_command(
    files: Annotated[
        list[Path], typer.Argument(help="Rays or a dataset, a scene, a gaze field, a place; in any order.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for tables and pictures.")],
    options: StatisticsOptions,
) -> None:
    """Count attention on things: in rays, and as a gaze field foretells it, with intervals over people.

    Share, dwell, reach, first looks, returns, distance, what could be seen; by cohort, time and zone; differences,
    moves from thing to thing, what if something stood elsewhere. --visibility tells what can be seen from where.
    """
    from nerg_mi.jobs.statistics import statistics

    with TerminalReporter() as reporter:
        statistics(files, output, options, reporter)
