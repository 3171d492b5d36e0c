"""`nerg bake`: the command line of `nerg_mi.jobs.bake`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.bake import BakeOptions

from .options import takes
from .progress import TerminalReporter


@takes(BakeOptions)
def command(
    surface: Annotated[
        Path, typer.Argument(help="Mesh (.ply, .obj, .glb), scene (.xml), or radiance field (.safetensors).")
    ],
    output: Annotated[
        list[Path],
        typer.Option(
            "-o",
            "--output",
            help="Files to write, repeatable: .ply, .glb (with colours), .csv (of faces), .json (summary).",
        ),
    ],
    options: BakeOptions,
) -> None:
    """Put gaze on surfaces: how much of it each square metre receives, from a gaze field or from tracked rays."""
    from nerg_mi.jobs import bake

    with TerminalReporter() as reporter:
        bake.bake(surface, output, options, reporter)
