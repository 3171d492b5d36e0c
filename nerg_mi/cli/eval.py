"""`nerg eval`: the command line of `nerg_mi.jobs.radiance`, and of the evaluation of gaze fields."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .eval_gaze import eval_gaze
from .mode import Mode, OldMode, mode_of
from .progress import TerminalReporter

app = typer.Typer(no_args_is_help=True, help="Score trained fields.")
app.command("gaze")(eval_gaze)


@app.command("radiance")
def eval_radiance(
    field: Annotated[Path, typer.Argument(help="Checkpoint of a radiance field (.safetensors).")],
    dataset: Annotated[Path, typer.Argument(help="Posed image set with the views to compare with.")],
    holdout: Annotated[
        int | None, typer.Option(help="As it was trained with. Default: transforms_test.json, else 8.")
    ] = None,
    train: Annotated[bool, typer.Option("--train", help="Score the training views instead.")] = False,
    width: Annotated[int | None, typer.Option(help="Width of the pictures. Default: as it was trained.")] = None,
    scale: Annotated[float, typer.Option(help="As it was trained with.")] = 1.0,
    coordinates: Annotated[str, typer.Option(help="As it was trained with.")] = "file",
    allow_outside: Annotated[
        bool,
        typer.Option("--allow-outside", help="Read files outside of the data set's folder too, where it names them."),
    ] = False,
    spp: Annotated[int, typer.Option(min=1, help="Rays a pixel. The scatter of few is part of the score.")] = 16,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for the pictures. Default: FIELD.eval")
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the scores to this file.")] = None,
    threads: Annotated[int | None, typer.Option(help="CPU threads. Default: all.")] = None,
    mode: Mode = "llvm_ad_rgb",
    variant: OldMode = None,
) -> None:
    """PSNR and SSIM on held-out views, and the error of depth where it is known, rendered by the integrator."""
    from nerg_mi.jobs import radiance

    options = radiance.RadianceScoreOptions(
        holdout=holdout,
        train=train,
        width=width,
        scale=scale,
        coordinates=coordinates,
        allow_outside=allow_outside,
        spp=spp,
        pictures=output or field.with_suffix(".eval"),
        json_file=json_file,
        threads=threads,
        mode=mode_of(mode, variant),
    )
    with TerminalReporter() as reporter:
        radiance.evaluate_radiance(field, dataset, options, reporter)
