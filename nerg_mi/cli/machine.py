"""``nerg doctor``: Check the installation and suggest fixes.
``nerg worker``: Run parts of jobs for a dask cluster.

The modules that these commands need are imported when they run, because ``nerg doctor`` must work without Mitsuba.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import typer

from nerg_mi.options import INPUT, PERFORMANCE, option
from nerg_mi.progress import Reporter
from nerg_mi.ranges import SECONDS, Range, ValidatedDataclass
from nerg_mi.workflows.base import argument, command


@command("doctor", more="The exit code is 0 if a compiled variant of Mitsuba works, else 1.")
def diagnose(reporter: Reporter) -> None:
    """Report the state of the installation. Raises ``typer.Exit``."""
    from nerg_mi.diagnosis import run_diagnosis

    diagnosis = run_diagnosis()
    reporter.message(str(diagnosis))
    raise typer.Exit(0 if diagnosis.is_usable else 1)


@dataclass(frozen=True, kw_only=True)
class WorkerOptions(ValidatedDataclass):
    """Options of ``nerg worker``."""

    threads: int = option(
        0, "Number of CPU threads; 0: one per core.", "-t", "--threads", within=Range(0, 1024), group=PERFORMANCE
    )
    wait: float = option(
        600.0,
        "Time in seconds to wait for a scheduler that does not answer before the worker ends.",
        within=SECONDS,
        group=INPUT,
    )
    name: str | None = option(None, "Name of this worker at the scheduler.  [default: its address]", group=INPUT)


@command(
    "worker",
    "Run parts of jobs for a dask scheduler, one at a time, until the scheduler stops the worker or Ctrl-C is pressed.",
    more="Start one worker per machine or GPU; it uses all of it. Jobs are sent there with --scheduler.",
    options=WorkerOptions,
    address=argument("Address of the dask scheduler: tcp://HOST:PORT or tls://HOST:PORT.", str),
)
def work(address: str, options: WorkerOptions, reporter: Reporter) -> None:
    """Connect to a dask scheduler and run the parts that it sends."""
    from nerg_mi.tasks.cluster import describe_exposure, run_dask_worker
    from nerg_mi.threads import THREADS_VARIABLE

    if options.threads:
        os.environ[THREADS_VARIABLE] = str(options.threads)
    warning = describe_exposure(address)
    if warning is not None:
        reporter.warn(warning)
    run_dask_worker(address, options.wait, reporter.message, options.name)
