"""`nerg refine`: the command line of `nerg_mi.jobs.refinement`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.checkpoints import RefineOptions

from .options import takes
from .progress import TerminalReporter


@takes(RefineOptions)
def refine_command(
    field: Annotated[Path, typer.Argument(help="Radiance field (.safetensors).")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Radiance field to write (.safetensors).")],
    options: RefineOptions,
) -> None:
    """Find more closely where a trained field holds matter, so that it renders with fewer evaluations.

    Fields that are trained or imported now have it. Weights stay as they are, and gaze fields know the new file.
    """
    from nerg_mi.jobs import refinement

    with TerminalReporter() as reporter:
        refinement.refine_checkpoint(field, output, options, reporter)
