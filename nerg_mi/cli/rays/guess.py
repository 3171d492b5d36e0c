"""``nerg rays guess``: what an unknown table is likely to be."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.cli.progress import TerminalReporter


def command(
    file: Annotated[Path, typer.Argument(help="Tracking file, or folder of a recording, that is not known.")],
) -> None:
    """Propose the preset or the column map of an unknown file: what is sure, what is a guess, what no file says.

    Nothing is imported: the whole command is printed, for you to check and to run.
    """
    from nerg_mi.files.bounded import plain
    from nerg_mi.jobs.tracking import guess_import

    with TerminalReporter() as reporter:
        found = guess_import(file, reporter)
    for name, sentences in (("sure", found.sure), ("guess", found.guessed), ("open", found.open)):
        for sentence in sentences:
            # Names of columns are no control characters of a terminal.
            typer.echo(f"{name:6} {plain(sentence, 2000)}")
    typer.echo("")
    typer.echo("nothing can be proposed" if found.command is None else plain(found.command, 100_000))
