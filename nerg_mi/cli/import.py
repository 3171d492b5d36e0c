"""`nerg import`: the command line of `nerg_mi.jobs.checkpoints`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.errors import NergError

from .mode import Mode, OldMode, mode_of
from .progress import TerminalReporter


def command(
    file: Annotated[Path, typer.Argument(help="Checkpoint (.pth) of torch-ngp, or of the NeRG paper's authors.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Radiance field to write (.safetensors).")
    ] = None,
    gaze: Annotated[Path | None, typer.Option("-g", "--gaze", help="Gaze field to write (.safetensors).")] = None,
    ema: Annotated[
        bool | None,
        typer.Option(
            "--ema/--no-ema",
            help="Moving averages of the weights, or the weights.  [default: averages, if there are any]",
        ),
    ] = None,
    color_space: Annotated[str, typer.Option(help="What --color_space was in training: srgb or linear.")] = "srgb",
    bg_radius: Annotated[
        float | None,
        typer.Option(help="What --bg_radius was in training, where there is a background network; 0: leave it out."),
    ] = None,
    finest: Annotated[
        int | None, typer.Option(help="Finest resolution of the hash grid.  [default: 2048 x bound]")
    ] = None,
    half: Annotated[bool, typer.Option("--half", help="Store the weights in fp16.")] = False,
    mode: Mode = "llvm_ad_rgb",
    variant: OldMode = None,
) -> None:
    """Convert a checkpoint to the fields of the volumes `nerf` and `gazefield`. Nothing in the file is run."""
    from nerg_mi.jobs import checkpoints

    if output is None and gaze is None:
        raise NergError("nothing is asked for: give -o FIELD.safetensors, --gaze GAZE.safetensors, or both.")
    options = checkpoints.ImportOptions(
        ema=ema, color_space=color_space, bg_radius=bg_radius, finest=finest, half=half, mode=mode_of(mode, variant)
    )
    with TerminalReporter() as reporter:
        checkpoints.import_checkpoint(file, output, gaze, options, reporter)
