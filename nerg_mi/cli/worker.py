"""`nerg worker`: the command line of `nerg_mi.tasks.dask_worker`."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from nerg_mi.ranges import SECONDS, check_number

from .progress import TerminalReporter


def worker_command(
    address: Annotated[str, typer.Argument(help="Of a dask scheduler: tcp://HOST:PORT or tls://HOST:PORT.")],
    threads: Annotated[
        int, typer.Option("-t", "--threads", min=0, max=1024, help="Worker threads; 0: one a core.")
    ] = 0,
    wait: Annotated[
        float,
        typer.Option(
            min=SECONDS.low, max=SECONDS.high, help="Seconds to wait for a scheduler that is not there, or is gone."
        ),
    ] = 600.0,
    name: Annotated[
        str | None, typer.Option(help="What the scheduler calls this worker.  [default: its address]")
    ] = None,
) -> None:
    """Run parts of jobs for a dask scheduler, one at a time, until that ends it or Ctrl-C does.

    One worker a machine, or a graphics card, has all of it. Jobs are sent there with --scheduler.
    """
    from nerg_mi.tasks.addresses import unprotected
    from nerg_mi.tasks.dask_worker import serve_cluster
    from nerg_mi.threads import VARIABLE

    check_number(wait, SECONDS, "--wait")
    if threads:
        os.environ[VARIABLE] = str(threads)
    with TerminalReporter() as reporter:
        danger = unprotected(address)
        if danger is not None:
            reporter.warn(danger)
        serve_cluster(address, wait, reporter.message, name)
