"""`nerg train`: the command line of `nerg_mi.jobs.radiance`, and of the training of gaze fields."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.radiance import RadianceOptions

from .mode import OldMode, mode_of
from .options import takes
from .progress import TerminalReporter
from .train_gaze import train_gaze
from .train_prior import train_prior

train_app = typer.Typer(no_args_is_help=True, help="Train fields from recordings.")
train_app.command("gaze")(train_gaze)
train_app.command("prior")(train_prior)


@train_app.command("radiance")
@takes(RadianceOptions)
def train_radiance(
    dataset: Annotated[Path, typer.Argument(help="Folder of posed photos, its transforms.json, or a COLMAP model.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Checkpoint to write (.safetensors).")],
    options: RadianceOptions,
    variant: OldMode = None,
) -> None:
    """Train a radiance field on posed pictures, and report the error on those held out."""
    from nerg_mi.jobs import radiance

    options = replace(options, mode=mode_of(options.mode, variant))
    with TerminalReporter() as reporter:
        radiance.train_radiance(dataset, output, options, reporter)
