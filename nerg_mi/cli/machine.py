"""``nerg doctor``: Say what works on this machine, and how to repair what does not.
``nerg worker``: Run parts of long jobs for a cluster (dask).

What these commands run is imported when they run: the doctor has to work where Mitsuba does not.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import typer

from nerg_mi.ranges import SECONDS, ValidatedDataclass, Range
from nerg_mi.workflows.base import Reporter, argument, command
from nerg_mi.workflows.options import option


@command("doctor", more="Ends with exit code 0 if some compiled variant of Mitsuba works, else with 1.")
def diagnose(reporter: Reporter) -> None:
    """Tell what works. Raises ``typer.Exit``."""
    from nerg_mi.diagnosis import run_diagnosis

    diagnosis = run_diagnosis()
    reporter.message(str(diagnosis))
    raise typer.Exit(0 if diagnosis.is_usable else 1)


@dataclass(frozen=True, kw_only=True)
class WorkerOptions(ValidatedDataclass):
    """What a worker has of its machine, and how long it waits."""

    threads: int = option(0, "Worker threads; 0: one a core.", "-t", "--threads", within=Range(0, 1024))
    wait: float = option(600.0, "Seconds to wait for a scheduler that is not there, or is gone.", within=SECONDS)
    name: str | None = option(None, "What the scheduler calls this worker.  [default: its address]")


@command(
    "worker",
    "Run parts of jobs for a dask scheduler, one at a time, until that ends it or Ctrl-C does.",
    more="One worker a machine, or a graphics card, has all of it. Jobs are sent there with --scheduler.",
    options=WorkerOptions,
    address=argument("Of a dask scheduler: tcp://HOST:PORT or tls://HOST:PORT.", str),
)
def work(address: str, options: WorkerOptions, reporter: Reporter) -> None:
    """Join a cluster."""
    from nerg_mi.tasks.engines import run_dask_worker, describe_exposure
    from nerg_mi.threads import THREADS_VARIABLE

    if options.threads:
        os.environ[THREADS_VARIABLE] = str(options.threads)
    danger = describe_exposure(address)
    if danger is not None:
        reporter.warn(danger)
    run_dask_worker(address, options.wait, reporter.message, options.name)
