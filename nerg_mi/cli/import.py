"""`nerg import`: the command line of `nerg_mi.jobs.checkpoints`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.errors import NergError
from nerg_mi.jobs.options.checkpoints import ImportOptions

from .mode import OldMode, mode_of
from .options import takes
from .progress import TerminalReporter


@takes(ImportOptions)
def import_command(
    file: Annotated[Path, typer.Argument(help="Checkpoint (.pth) of torch-ngp, or of the NeRG paper's authors.")],
    options: ImportOptions,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Radiance field to write (.safetensors).")
    ] = None,
    gaze: Annotated[Path | None, typer.Option("-g", "--gaze", help="Gaze field to write (.safetensors).")] = None,
    variant: OldMode = None,
) -> None:
    """Convert a checkpoint to the fields of the volumes `nerf` and `gazefield`. Nothing in the file is run."""
    from nerg_mi.jobs import checkpoints

    if output is None and gaze is None:
        raise NergError("nothing is asked for: give -o FIELD.safetensors, --gaze GAZE.safetensors, or both")
    options = replace(options, mode=mode_of(options.mode, variant))
    with TerminalReporter() as reporter:
        checkpoints.import_checkpoint(file, output, gaze, options, reporter)
