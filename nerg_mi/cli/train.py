"""`nerg train`: the command line of `nerg_mi.jobs.radiance`, and of the training of gaze fields."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.errors import NergError

from .mode import Mode, OldMode, mode_of
from .progress import TerminalReporter
from .train_gaze import train_gaze

app = typer.Typer(no_args_is_help=True, help="Train fields from recordings.")
app.command("gaze")(train_gaze)


@app.command("radiance")
def train_radiance(
    dataset: Annotated[Path, typer.Argument(help="Folder of posed photos, its transforms.json, or a COLMAP model.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Checkpoint to write (.safetensors).")],
    holdout: Annotated[
        int | None, typer.Option(help="Hold out every so many frames, 0 none. Default: transforms_test.json, else 8.")
    ] = None,
    size: Annotated[str, typer.Option(help="Size of the field: small, medium or paper.")] = "small",
    width: Annotated[int | None, typer.Option(help="Width of the pictures in pixels.")] = None,
    downscale: Annotated[float | None, typer.Option(help="Or: divide their size by this.")] = None,
    minutes: Annotated[float | None, typer.Option(help="Train for this long. Default: 5.")] = None,
    steps: Annotated[int | None, typer.Option(help="Or: train for so many steps.")] = None,
    aabb: Annotated[str | None, typer.Option(help="Bounds of what is seen: x0,y0,z0,x1,y1,z1.")] = None,
    scale: Annotated[
        float, typer.Option(help="Multiply all lengths by this: what a unit of the data set measures, in metres.")
    ] = 1.0,
    coordinates: Annotated[
        str,
        typer.Option(help="Of the field: file, original (applied_transform undone), or a dataparser_transforms.json."),
    ] = "file",
    allow_outside: Annotated[
        bool,
        typer.Option("--allow-outside", help="Read files outside of the data set's folder too, where it names them."),
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of the weights, rays and jitter.")] = 0,
    threads: Annotated[int | None, typer.Option(help="CPU threads. Default: all.")] = None,
    half: Annotated[bool, typer.Option("--half", help="Store the weights in fp16.")] = False,
    depth: Annotated[bool, typer.Option(help="Supervise with the data set's depth, where it has any.")] = True,
    depth_weight: Annotated[float | None, typer.Option(help="Weight of the depth's loss.")] = None,
    distortion_weight: Annotated[
        float, typer.Option(help="Weight of mip-NeRF 360's distortion loss, against fog; 0 is none.")
    ] = 0.0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the interrupted run of this output.")] = False,
    save_every: Annotated[
        float, typer.Option(help="Seconds between two states for --resume; 0: only one, when it ends early.")
    ] = 60.0,
    mode: Mode = "llvm_ad_rgb",
    variant: OldMode = None,
) -> None:
    """Train a radiance field on posed pictures, and report the error on those held out."""
    from nerg_mi.jobs import radiance

    options = radiance.RadianceOptions(
        holdout=holdout,
        size=size,
        width=width,
        downscale=downscale,
        minutes=minutes,
        steps=steps,
        aabb=_numbers(aabb),
        scale=scale,
        coordinates=coordinates,
        allow_outside=allow_outside,
        seed=seed,
        threads=threads,
        half=half,
        depth=depth,
        depth_weight=depth_weight,
        distortion_weight=distortion_weight,
        resume=resume,
        save_every=save_every,
        mode=mode_of(mode, variant),
    )
    with TerminalReporter() as reporter:
        radiance.train_radiance(dataset, output, options, reporter)


def _numbers(text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        return tuple(float(x) for x in text.replace(",", " ").split())
    except ValueError as e:
        raise NergError(f'--aabb needs numbers x0,y0,z0,x1,y1,z1, got "{text}"') from e
