"""``nerg ablate``: the command line of `nerg_mi.jobs.ablation`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.ablation import AblationOptions

from .options import takes
from .progress import TerminalReporter


@takes(AblationOptions)
def ablate_command(
    rays: Annotated[Path, typer.Argument(help="Rays file (.npz or .parquet), as nerg rays import writes it.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for checkpoints, table and plot.")],
    options: AblationOptions,
) -> None:
    """Train every variant of a gaze field alike; losses on training and held-out positions, and the time of a frame."""
    from nerg_mi.jobs.ablation import ablate

    with TerminalReporter() as reporter:
        ablate(rays, output, options, reporter)
