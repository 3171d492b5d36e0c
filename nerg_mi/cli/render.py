"""`nerg render`: the command line of `nerg_mi.jobs.pictures`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .defines import Defines, parse_defines
from .mode import BestMode
from .progress import TerminalReporter


def command(
    scene: Annotated[Path, typer.Argument(help="Mitsuba scene file (.xml).")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Picture to write: .exr (all channels) or .png (colour).")
    ],
    define: Defines = None,
    sensor: Annotated[int, typer.Option("-s", "--sensor", help="Index of the sensor, counted from 0.")] = 0,
    mode: BestMode = None,
    spp: Annotated[int, typer.Option("--spp", min=0, help="Samples a pixel; 0: as the scene says.")] = 0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random numbers.")] = 0,
    threads: Annotated[int, typer.Option("-t", "--threads", min=0, help="Worker threads; 0: one a core.")] = 0,
    memory: Annotated[
        float, typer.Option("--memory", help="GB that rendering may take; larger pictures are made in bands.")
    ] = 1.0,
) -> None:
    """Render a scene file to an EXR or PNG file, with the integrator that the scene names.

    An EXR file holds all channels in float32, those of the AOVs among them; a PNG file holds the colour, tonemapped to
    sRGB.
    """
    defaults = parse_defines(define)
    from nerg_mi.jobs import pictures

    options = pictures.PictureOptions(
        defaults=defaults, sensor=sensor, spp=spp, seed=seed, threads=threads, memory=memory, mode=mode
    )
    with TerminalReporter() as reporter:
        pictures.render_file(scene, output, options, reporter)
