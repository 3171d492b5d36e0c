"""``nerg rays plot``: the floor plan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.cli.progress import TerminalReporter
from nerg_mi.ranges import LENGTHS

from .arguments import RaysFile


def rays_plot_command(
    rays: RaysFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="Picture to write (.png or .svg).")],
    kind: Annotated[
        str, typer.Option(help="density: rays/m² with mean directions; layout: each ray's place, with dimensions.")
    ] = "density",
    cell: Annotated[
        float | None,
        typer.Option(
            min=LENGTHS.low,
            max=LENGTHS.high,
            help="density: edge of a cell, metres.  [default: a fiftieth of the plan]",
        ),
    ] = None,
    test: Annotated[Path | None, typer.Option(help="layout: the test rays of a split, drawn beside.")] = None,
) -> None:
    """The floor plan: where people stood and how densely, or the layout."""
    from nerg_mi.jobs.tracking import PlotOptions, plot_rays

    with TerminalReporter() as reporter:
        plot_rays(rays, PlotOptions(kind=kind, cell=cell, test=test, output=output), reporter)
    typer.echo(f"wrote {output}")
