"""`nerg align`: the command line of `nerg_mi.jobs.alignment`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.alignment import AlignOptions

from .options import takes
from .progress import TerminalReporter


@takes(AlignOptions)
def align_command(
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="Alignment to write (.json), which --align takes; beside it a picture."),
    ],
    options: AlignOptions,
    rays: Annotated[
        Path | None, typer.Argument(help="Rays file (.npz or .parquet). Not needed with --pairs, --twin or --cameras.")
    ] = None,
) -> None:
    """Find how tracking lies in a place: the similarity from the rays' frame to the place's.

    From picked points, a twin, cameras known in both frames, or from the tracking alone: heads in free space, gaze that
    ends on surfaces. A mirrored frame is found and named.
    """
    from nerg_mi.jobs import alignment

    with TerminalReporter() as reporter:
        alignment.align(rays, output, options, reporter)
