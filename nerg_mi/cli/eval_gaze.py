"""``nerg eval gaze``: the command line of `nerg_mi.jobs.evaluation`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.evaluation import GazeEvaluationOptions

from .options import takes
from .progress import TerminalReporter


@takes(GazeEvaluationOptions)
def eval_gaze(
    gaze: Annotated[
        Path, typer.Argument(help="Checkpoint of a gaze field that was trained with --test-zones (.safetensors).")
    ],
    rays: Annotated[Path, typer.Argument(help="The rays file or dataset that it was trained on.")],
    options: GazeEvaluationOptions,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for tables and pictures. Default: GAZE.eval.")
    ] = None,
) -> None:
    """Scores beside uniform, position-blind, nearest probes, nearest rays and the other half of the people."""
    from nerg_mi.evaluation.gaze import SCORES, print_scores
    from nerg_mi.jobs.evaluation import evaluate_gaze

    with TerminalReporter() as reporter:
        found = evaluate_gaze(gaze, rays, output or gaze.with_suffix(".eval"), options, reporter)
    rows = [{k: row[k] for k in ("method", *SCORES, "integral")} for row in found.rows]
    print_scores(rows, f"{gaze.name}, {found.split}: {found.positions} positions, {found.people} persons")
    typer.echo("\n".join(f"wrote {path}" for path in found.files))
