"""`nerg jobs`: the command line of `nerg_mi.jobs.store_account`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .progress import TerminalReporter


def jobs_command(
    folder: Annotated[Path, typer.Argument(help="Store of a job: what was given as --store, or OUTPUT.tasks.")],
    remove_stale: Annotated[
        bool, typer.Option("--remove-stale", help="Take out what no job asks for any more, and what is left over.")
    ] = False,
) -> None:
    """Say what is done of the jobs in a store, what is left, what it takes in bytes, and what is stale.

    Stale is what no job asks for any more as it was started last, and what was made of files that have changed since.
    """
    from nerg_mi.jobs.store_account import account_for_store

    with TerminalReporter() as reporter:
        account_for_store(folder, remove_stale, reporter)
