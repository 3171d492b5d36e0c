"""``nerg rays filter``: some of the rays."""

from __future__ import annotations

from dataclasses import replace

import typer

from nerg_mi.cli.options import takes
from nerg_mi.jobs.options.rays import FilterOptions

from .arguments import Output, RaysFile


@takes(FilterOptions, "output")
def rays_filter_command(rays: RaysFile, output: Output, options: FilterOptions) -> None:
    """Keep some rays: conditions first, then fixations, then thinning of those who stand still."""
    from nerg_mi.cli.progress import TerminalReporter
    from nerg_mi.jobs.tracking import filter_rays

    with TerminalReporter() as reporter:
        filter_rays(rays, replace(options, output=output), reporter)
    typer.echo(f"wrote {output}")
