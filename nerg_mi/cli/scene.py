"""`nerg scene`: the command line of `nerg_mi.jobs.scene`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.scene import SceneOptions

from .options import takes
from .progress import TerminalReporter


@takes(SceneOptions)
def scene_command(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="In any order: a place (radiance field, splats, mesh, .xml scene, .vol), a gaze field, rays.",
            metavar="FILES",
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Scene file to write (.xml).")],
    options: SceneOptions,
) -> None:
    """Write a scene file for a place, a gaze field or rays, with a camera and an observer.

    A gaze field alone is shown in the place that it was trained in, which is found beside it. The scene is commented;
    each of its defaults can be set when it is rendered (nerg render -D).
    """
    from nerg_mi.jobs import scene

    with TerminalReporter() as reporter:
        scene.write_scene(files, output, options, reporter)
