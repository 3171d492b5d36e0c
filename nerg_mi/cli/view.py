"""`nerg view`: the command line of `nerg_mi.viewer`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.view import ViewOptions

from .options import takes
from .progress import TerminalReporter


@takes(ViewOptions)
def view_command(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="A scene, or a place (radiance field, splats, mesh, .vol), a gaze field, rays; a folder.",
            metavar="FILES",
        ),
    ],
    options: ViewOptions,
) -> None:
    """Show a place with its gaze in the browser, where the observer is dragged.

    The page is served to this machine alone, until Ctrl-C; nothing is fetched from anywhere else. At another --host its
    address has a token.
    """
    from nerg_mi.viewer import serve

    with TerminalReporter() as reporter:
        serve.view_files(files, options, reporter)
