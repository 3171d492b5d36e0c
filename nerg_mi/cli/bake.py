"""`nerg bake`: the command line of `nerg_mi.jobs.bake`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.bake import BakeOptions

from .options import takes
from .progress import TerminalReporter


@takes(BakeOptions)
def bake_command(
    surface: Annotated[
        Path,
        typer.Argument(
            help="Mesh (.ply, .obj, .glb), scene (.xml), radiance field (.safetensors), or Gaussian splats."
        ),
    ],
    output: Annotated[
        list[Path],
        typer.Option(
            "-o",
            "--output",
            help="Files to write, repeatable: .ply, .glb (with colours), .csv (of faces), .json (summary); of Gaussian "
            "splats .ply and .json.",
        ),
    ],
    options: BakeOptions,
) -> None:
    """Put gaze on surfaces: how much of it each square metre receives, from a gaze field or from tracked rays."""
    from nerg_mi.formats.splats.files import is_splats
    from nerg_mi.jobs.bake import bake
    from nerg_mi.jobs.bake_splats import bake_splats

    with TerminalReporter() as reporter:
        (bake_splats if is_splats(surface) else bake)(surface, output, options, reporter)
