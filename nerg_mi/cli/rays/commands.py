"""The sub-commands of ``nerg rays``. Their options are those of readers, so that NumPy is loaded with them."""

from __future__ import annotations

import typer

from .filter import rays_filter_command
from .guess import rays_guess_command
from .imports import IMPORT_HELP, make_import_command
from .plot import rays_plot_command
from .show import rays_show_command
from .split import rays_split_command


def make_rays_app() -> typer.Typer:
    """All sub-commands; the import has the options of all readers that are registered now."""
    app = typer.Typer(
        no_args_is_help=True,
        help="Import tracking files as rays of attention, look at them, choose among them and split them.",
    )
    app.command("import", help=IMPORT_HELP)(make_import_command())
    app.command("guess")(rays_guess_command)
    app.command("show")(rays_show_command)
    app.command("filter")(rays_filter_command)
    app.command("split")(rays_split_command)
    app.command("plot")(rays_plot_command)
    return app


rays_app = make_rays_app()
