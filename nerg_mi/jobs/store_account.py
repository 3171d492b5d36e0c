"""``nerg jobs``: Say what is done of a long job, what is left and what is stale.

What the store of a job in parts holds, as lines that are read, and what of it is taken out.
"""

from __future__ import annotations

from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.files.tables import markdown_table
from nerg_mi.tasks.account import Account, JobAccount, read_account, remove_stale
from nerg_mi.tasks.store import Store

from .commands import argument, command, extra
from .reporter import SILENT, Reporter

_HEAD = ("job", "parts", "done", "left", "size", "computed in", "out of date")


@command(
    "jobs",
    "Say what is done of the jobs in a store, what is left, what it takes in bytes, and what is stale.",
    more="Stale is what no job asks for any more as it was started last, and what was made of files that have changed "
    "since.",
    folder=argument("Store of a job: what was given as --store, or OUTPUT.tasks."),
    remove=extra(False, "Take out what no job asks for any more, and what is left over.", bool, "--remove-stale"),
)
def account_for_store(folder: str | Path, remove: bool = False, reporter: Reporter = SILENT) -> Account:
    """Tell of the jobs in the store ``folder``: how far each is, what it takes, and which inputs have changed.

    ``remove``: take out what no job asks for any more, what was made of files that have changed since, and what was
    left over an hour ago or earlier, by workers that died or for parts that nobody asks for any more. Raises
    `NergError` for a folder that is no store.
    """
    if not Path(folder).is_dir():
        raise NergError(f'there is no folder "{folder}"; name the one that was given as --store')
    reporter.progress(0.0, "looking at what is there")
    store = Store(folder)
    account = read_account(store)
    rows = [_row(job) for job in account.jobs]
    if rows:
        reporter.message(markdown_table(_HEAD, rows, _HEAD[1:]))
    for job in account.jobs:
        for path in job.changed:
            reporter.message(f"changed since {job.what}: {path}")
        for path in job.gone:
            reporter.message(f"not there any more for {job.what}: {path}")
    stale, left = len(account.stale), len(account.leftovers)
    reporter.message(
        f"{size(account.bytes)} in all; stale: {stale} outputs, {size(account.stale_bytes)}; "
        f"left over: {left}, {size(account.leftover_bytes)}."
    )
    if remove:
        reporter.message(f"Removed {size(remove_stale(store, account))}.")
    elif stale or left:
        reporter.message("nerg jobs --remove-stale takes out what is stale or left over.")
    return account


def _row(job: JobAccount) -> tuple[str, ...]:
    counts = (job.total, job.done, job.left)
    return (job.what, *map(str, counts), size(job.bytes), f"{job.seconds:.0f} s", str(job.outdated))


def size(count: float) -> str:
    """So many bytes as one says it: 12 kB, 3.4 MB."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "bytes" or count >= 10 else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"
