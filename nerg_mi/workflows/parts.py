"""Workflows in parts: where parts run, and the state of their store."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError, parameter
from nerg_mi.files.safe_read import resolve_path
from nerg_mi.files.tables import format_markdown_table
from nerg_mi.options import PartOptions
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rendering.scene import list_scene_files
from nerg_mi.tasks.engines import PlanProgress, TaskOutput, open_engine, run_plan
from nerg_mi.tasks.store import JobStatus, Store, StoreStatus, read_status, remove_stale
from nerg_mi.tasks.task import FileGroup, Plan

SUFFIX = ".tasks"
"""Suffix of the default store next to an output."""

_HEADER = ("job", "parts", "done", "left", "size", "computed in", "out of date")


class PartRunner:
    """The store and the engine of one job, which writes ``output``.

    ``threads`` is the number of threads of each process. Raises `NergError` for a folder that is not writable, and for
    an unknown scheduler.
    """

    def __init__(self, options: PartOptions, output: Path, reporter: Reporter, threads: int | None = None):
        self.store = Store(output.with_suffix(SUFFIX) if options.store is None else options.store)
        self.engine = open_engine(options.scheduler, threads or 0, options.worker_wait)
        self._reporter = reporter

    def run(self, plan: Plan, since: float = 0.0, until: float = 1.0) -> Iterator[TaskOutput]:
        """Yield the outputs of ``plan`` in order, see `run_plan`.

        This stage covers the progress from ``since`` to ``until``. Ctrl-C raises ``KeyboardInterrupt`` with a message
        on how to resume.
        """

        def show(progress: PlanProgress) -> None:
            self._reporter.progress(since + (until - since) * progress.fraction, progress.format_line(until == 1.0))

        try:
            yield from run_plan(plan, self.store, self.engine, show, self._reporter.warn)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"Interrupted; finished parts are stored in {self.store.folder}: run the same command again to resume."
            ) from None


@dataclass(frozen=True)
class PlannedScene:
    """A scene file, mesh or field with all ``files`` that it refers to, and values of its `<default>`s.

    Identifies a part, and locates the files where the part runs.
    """

    files: FileGroup
    defaults: dict[str, str]

    @staticmethod
    def plan(path: str | Path, defaults: Mapping[str, str] | None = None, *extra_files: Path) -> PlannedScene:
        """Return the scene file ``path`` with these values and additional files."""
        return PlannedScene(
            FileGroup(Path(path), (*list_scene_files(path, defaults), *extra_files)), dict(defaults or {})
        )

    def checked_path(self) -> Path:
        """Return the path of the scene file.

        Raises `NergError` if it refers to other files than when the job was planned, as an absolute path may do on a
        worker.
        """
        planned = {resolve_path(path) for path in self.files.members}
        for file in list_scene_files(self.files.path, self.defaults):
            if resolve_path(file) not in planned:
                raise NergError(
                    f'the scene "{self.files.path.name}" reads "{file}", which is not the file that the job was '
                    "planned with; use paths relative to the scene, so that workers find the same files"
                )
        return self.files.path


def account_for_store(folder: str | Path, remove: bool = False, reporter: Reporter = SILENT) -> StoreStatus:
    """Report the jobs in the store ``folder``: progress, size, and changed inputs.

    ``remove`` deletes parts that no job uses, parts whose input files have changed, and leftovers of processes that
    ended an hour ago or earlier. Raises `NergError` if the folder is not a store.
    """
    if not Path(folder).is_dir():
        raise NergError(f'there is no folder "{folder}"; give the folder that was given as {parameter("store")}')
    reporter.progress(0.0, "reading the store")
    store = Store(folder)
    account = read_status(store)
    if account.jobs:
        reporter.message(format_markdown_table(_HEADER, [_row(job) for job in account.jobs], _HEADER[1:]))
    for job in account.jobs:
        for path in job.changed:
            reporter.message(f"changed since {job.name}: {path}")
        for path in job.missing:
            reporter.message(f"missing for {job.name}: {path}")
    stale, left = len(account.stale), len(account.leftovers)
    reporter.message(
        f"{format_bytes(account.bytes)} in total; stale: {stale} outputs, {format_bytes(account.stale_bytes)}; "
        f"leftovers: {left}, {format_bytes(account.leftover_bytes)}."
    )
    if remove:
        reporter.message(f"Removed {format_bytes(remove_stale(store, account))}.")
    elif stale or left:
        reporter.message("nerg jobs --remove-stale removes stale outputs and leftovers.")
    return account


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
