"""`nerg render`: the command line of `nerg_mi.rendering`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer


def command(
    scene: Annotated[Path, typer.Argument(help="Mitsuba scene file (.xml).")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Picture to write: .exr (all channels) or .png (colour).")],
    define: Annotated[
        Optional[list[str]],
        typer.Option("-D", "--define", metavar="KEY=VALUE", help="Value for $KEY or a <default> of the scene; repeatable."),
    ] = None,
    sensor: Annotated[int, typer.Option("-s", "--sensor", help="Index of the sensor, counted from 0.")] = 0,
    variant: Annotated[
        Optional[str],
        typer.Option("-m", "--mode", help="Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]"),
    ] = None,
    spp: Annotated[int, typer.Option("--spp", min=0, help="Samples a pixel; 0: as the scene says.")] = 0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random numbers.")] = 0,
    threads: Annotated[int, typer.Option("-t", "--threads", min=0, help="Worker threads; 0: one a core.")] = 0,
) -> None:
    """Render a scene file to an EXR or PNG file, with the integrator that the scene names.

    An EXR file holds all channels in float32, those of the AOVs among them; a PNG file holds the colour, tonemapped to sRGB.
    """
    from .. import rendering

    defaults = rendering.parse_defines(define or [])
    report = rendering.render_file(
        scene, output, defaults=defaults, sensor=sensor, variant=variant, spp=spp, seed=seed, threads=threads
    )
    print(report)
