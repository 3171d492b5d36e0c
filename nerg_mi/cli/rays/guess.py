"""``nerg rays guess``: what an unknown table is likely to be."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.cli.progress import TerminalReporter


def rays_guess_command(
    files: Annotated[
        list[Path], typer.Argument(help="Unknown tracking files, folders of them, or folders of recordings.")
    ],
) -> None:
    """Propose the preset or the column map of unknown files: what is sure, what is a guess, what no file says.

    Nothing is imported: the whole command is printed, one for all files that are alike, for you to check and to run.
    """
    from nerg_mi.files.safe_read import plain
    from nerg_mi.jobs.tracking import guess_imports

    with TerminalReporter() as reporter:
        proposals = guess_imports(files, reporter)
    for k, proposal in enumerate(proposals):
        if len(proposals) > 1:
            more = f" and {len(proposal.paths) - 1} more" if len(proposal.paths) > 1 else ""
            typer.echo("\n" * (k > 0) + plain(f"{proposal.paths[0]}{more}", 2000))
        for name, sentences in (("sure", proposal.sure), ("guess", proposal.guessed), ("open", proposal.open)):
            for sentence in sentences:
                # Names of columns are no control characters of a terminal.
                typer.echo(f"{name:6} {plain(sentence, 2000)}")
        typer.echo("")
        typer.echo("nothing can be proposed" if proposal.command is None else plain(proposal.command, 100_000))
