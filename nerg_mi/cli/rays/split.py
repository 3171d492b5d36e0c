"""``nerg rays split``: training and test rays that share none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.cli.options import takes
from nerg_mi.jobs.options.rays import SplitOptions

from .arguments import RaysFile


@takes(SplitOptions, "train_output", "test_output")
def rays_split_command(
    rays: RaysFile,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Rays file; -train and -test are put before its ending.")
    ],
    options: SplitOptions,
) -> None:
    """Split into training and test rays that share none: by position, person, time, or several of them at once.

    Of several, training rays are on the training side of each and test rays on the test side of each; the rest is
    purged.
    """
    from nerg_mi.cli.progress import TerminalReporter
    from nerg_mi.jobs.tracking import split_rays

    train, test = (output.with_name(f"{output.stem}-{side}{output.suffix}") for side in ("train", "test"))
    options = replace(options, train_output=train, test_output=test)
    with TerminalReporter() as reporter:
        split_rays(rays, options, reporter)
    typer.echo(f"wrote {train}")
    typer.echo(f"wrote {test}")
