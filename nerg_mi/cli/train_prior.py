"""``nerg train prior``: the command line of `nerg_mi.jobs.gaze_prior`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.prior import PriorOptions

from .options import takes
from .progress import TerminalReporter


@takes(PriorOptions)
def train_prior(
    rays: Annotated[list[Path], typer.Argument(help="Rays files (.npz or .parquet) or datasets, one a place.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Checkpoint to write (.safetensors).")],
    options: PriorOptions,
) -> None:
    """Make a gaze field for a place where nobody was tracked: how high people looked in other places.

    It stands in any place whose z axis points up. What it is worth: docs/gaze-evaluation.md.
    """
    from nerg_mi.jobs.gaze_prior import learn_prior

    with TerminalReporter() as reporter:
        learn_prior(rays, output, options, reporter)
