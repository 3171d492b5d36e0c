"""`nerg render`: the command line of `nerg_mi.jobs.film`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.parts import FilmOptions

from .defines import Defines, parse_defines
from .options import takes
from .progress import TerminalReporter


@takes(FilmOptions, "defaults")
def render_command(
    scene: Annotated[Path, typer.Argument(help="Mitsuba scene file (.xml).")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Picture to write: .exr (all channels), .png; .svg, .mp4.")
    ],
    options: FilmOptions,
    define: Defines = None,
) -> None:
    """Render a scene file to a picture or a video, with the integrator that the scene names.

    An EXR file holds all channels in float32, those of the AOVs among them; a PNG file holds the colour, tonemapped to
    sRGB, or an overlay with its scale, which an SVG file can hold, too. Pictures of a sequence have a number added to
    their names, or are the frames of an MP4 file.

    With --store or --scheduler each picture is kept when it is done, and the same command goes on where it ended.
    """
    options = replace(options, defaults=parse_defines(define))
    from nerg_mi.jobs import film

    with TerminalReporter() as reporter:
        film.render_film(scene, output, options, reporter)
