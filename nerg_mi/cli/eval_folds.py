"""``nerg eval folds``: the command line of `nerg_mi.jobs.folds`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.folds import FoldOptions

from .options import takes
from .progress import TerminalReporter


@takes(FoldOptions)
def eval_folds(
    rays: Annotated[Path, typer.Argument(help="Rays file (.npz or .parquet) or dataset.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the table.")],
    options: FoldOptions,
) -> None:
    """Train and score a gaze field again and again, each time without other people and zones, and tell the means.

    Each fold is kept when it is done, and the same command goes on where it ended.
    """
    from nerg_mi.evaluation.gaze import SCORES, print_scores
    from nerg_mi.jobs.folds import evaluate_folds

    with TerminalReporter() as reporter:
        found = evaluate_folds(rays, output, options, reporter)
    for split in options.splits.split(","):
        rows = [{k: row.get(k, math.nan) for k in ("method", *SCORES)} for row in found.rows if row["split"] == split]
        print_scores(rows, f"{split}: means of {options.folds} folds")
