"""``nerg train gaze``: the command line of `nerg_mi.jobs.gaze`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.gaze import GazeOptions

from .options import takes
from .progress import TerminalReporter


@takes(GazeOptions)
def train_gaze(
    output: Annotated[Path, typer.Option("-o", "--output", help="Checkpoint to write (.safetensors).")],
    options: GazeOptions,
    rays: Annotated[
        Path | None,
        typer.Argument(
            help="Rays file (.npz or .parquet) or dataset, as nerg rays import writes it. None: --views alone."
        ),
    ] = None,
) -> None:
    """Train a gaze field on rays of attention, and report its scores at positions that were held out."""
    from nerg_mi.jobs import gaze

    with TerminalReporter() as reporter:
        gaze.train_gaze(rays, output, options, reporter)
