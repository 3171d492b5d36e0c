"""The progress of the jobs in a store."""

from __future__ import annotations

from pathlib import Path

from nerg_mi.errors import NergError, parameter
from nerg_mi.files.tables import format_markdown_table
from nerg_mi.files.values import FilePath
from nerg_mi.progress import Progress, open_reporter

from .store import JobStatus, Store, StoreStatus, delete_stale, read_status

_HEADER = ("job", "parts", "done", "left", "size", "computed in", "out of date")


def report_jobs(folder: FilePath, *, remove_stale: bool = False, progress: Progress = None) -> StoreStatus:
    """Show which parts of the jobs in a store are finished, which remain, and which are stale.

    Stale parts are those that the last run of no job uses, and those whose input files have changed since.

    Parameters
    ----------
    folder : path
        Store of a job: the folder given as --store, or OUTPUT.tasks.
    remove_stale : bool
        Remove stale parts, and leftovers of processes that ended an hour ago or earlier.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    StoreStatus
        The jobs with their progress, size and changed inputs, before anything is removed.

    Raises
    ------
    NergError
        The folder is not a store.
    """
    if not Path(folder).is_dir():
        raise NergError(f'there is no folder "{folder}"; give the folder that was given as {parameter("store")}')
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, "reading the store")
        store = Store(folder)
        status = read_status(store)
        if status.jobs:
            reporter.message(format_markdown_table(_HEADER, [_row(job) for job in status.jobs], _HEADER[1:]))
        for job in status.jobs:
            for path in job.changed:
                reporter.message(f"changed since {job.name}: {path}")
            for path in job.missing:
                reporter.message(f"missing for {job.name}: {path}")
        stale, left = len(status.stale), len(status.leftovers)
        reporter.message(
            f"{format_bytes(status.bytes)} in total; stale: {stale} outputs, {format_bytes(status.stale_bytes)}; "
            f"leftovers: {left}, {format_bytes(status.leftover_bytes)}."
        )
        if remove_stale:
            reporter.message(f"Removed {format_bytes(delete_stale(store, status))}.")
        elif stale or left:
            reporter.message(f"{parameter('remove_stale', True)} removes stale outputs and leftovers.")
    return status


def _row(job: JobStatus) -> tuple[str, ...]:
    counts = (job.total, job.done, job.remaining)
    return (job.name, *map(str, counts), format_bytes(job.bytes), f"{job.seconds:.0f} s", str(job.outdated))


def format_bytes(count: float) -> str:
    """Format a number of bytes: 12 kB, 3.4 MB."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "bytes" or count >= 10 else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"
