"""`nerg poses`: the command line of `nerg_mi.jobs.poses`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.poses import PoseOptions

from .options import takes
from .progress import TerminalReporter


@takes(PoseOptions)
def poses_command(
    pictures: Annotated[Path, typer.Argument(metavar="PHOTOS|VIDEO", help="Folder of photos (JPEG, PNG), or a video.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to make: a capture with poses.")],
    options: PoseOptions,
) -> None:
    """Find out from where photos were taken, or frames of a video, and write them as a capture for nerg train radiance.

    Needs pycolmap, and PyAV for videos: pip install "nerg-mi[poses]".
    """
    from nerg_mi.jobs import poses

    with TerminalReporter() as reporter:
        poses.find_poses(pictures, output, options, reporter)
