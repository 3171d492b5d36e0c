"""The sub-commands of ``nerg rays``. Their options are those of readers, so that NumPy is loaded with them."""

from __future__ import annotations

import typer

from . import filter, guess, imports, plot, show, split


def make_app() -> typer.Typer:
    """All sub-commands; the import has the options of all readers that are registered now."""
    app = typer.Typer(
        no_args_is_help=True,
        help="Import tracking files as rays of attention, look at them, choose among them and split them.",
    )
    app.command("import", help=imports.HELP)(imports.make_command())
    app.command("guess")(guess.command)
    app.command("show")(show.command)
    app.command("filter")(filter.command)
    app.command("split")(split.command)
    app.command("plot")(plot.command)
    return app


app = make_app()
