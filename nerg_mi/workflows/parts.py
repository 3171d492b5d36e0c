"""Long workflows in parts: where parts run, and what is done, missing and stale in their store."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import resolve_path
from nerg_mi.files.tables import format_markdown_table
from nerg_mi.rendering.scene import list_scene_files
from nerg_mi.tasks.engines import TaskOutput, PlanProgress, open_engine, run_plan
from nerg_mi.tasks.store import StoreStatus, JobStatus, Store, read_status, remove_stale
from nerg_mi.tasks.task import FileGroup, Plan

from .base import SILENT, Reporter
from .options import PartOptions

SUFFIX = ".tasks"
"""Of the store beside an output, where none is named."""

_HEAD = ("job", "parts", "done", "left", "size", "computed in", "out of date")


class PartRunner:
    """The store and the engine of one job, which writes ``output``. ``threads``: of each process that makes parts.
    Raises `NergError` for a folder that cannot be written to, and for a scheduler that does not exist."""

    def __init__(self, options: PartOptions, output: Path, reporter: Reporter, threads: int | None = None):
        self.store = Store(output.with_suffix(SUFFIX) if options.store is None else options.store)
        self.engine = open_engine(options.scheduler, threads or 0)
        self._reporter = reporter

    def run(self, plan: Plan, since: float = 0.0, until: float = 1.0) -> Iterator[TaskOutput]:
        """The outputs of ``plan`` in its order; see `run_plan`. Of the whole job this is from the share ``since`` to
        the share ``until``. Ctrl-C says where it goes on from."""

        def show(progress: PlanProgress) -> None:
            self._reporter.progress(since + (until - since) * progress.fraction, progress.format_line(until == 1.0))

        try:
            yield from run_plan(plan, self.store, self.engine, show, self._reporter.warn)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"Interrupted; the parts that are done are kept in {self.store.folder}: the same command goes on."
            ) from None


@dataclass(frozen=True)
class PlannedScene:
    """A scene file, a mesh or a field with the ``files`` that are read because of it, and values of its `<default>`s:
    what a part is kept by, and where they lie wherever it runs."""

    files: FileGroup
    defaults: dict[str, str]

    @staticmethod
    def plan(path: str | Path, defaults: Mapping[str, str] | None = None, *others: Path) -> PlannedScene:
        """The scene file ``path`` with these values, and files beside it that are read as well."""
        return PlannedScene(FileGroup(Path(path), (*list_scene_files(path, defaults), *others)), dict(defaults or {}))

    def checked_path(self) -> Path:
        """The scene file. Raises `NergError` where it reads other files than the job was planned with, as on a worker
        where a whole path leads to somebody else's file."""
        planned = {resolve_path(path) for path in self.files.members}
        for file in list_scene_files(self.files.path, self.defaults):
            if resolve_path(file) not in planned:
                raise NergError(
                    f'the scene "{self.files.path.name}" reads "{file}", which is not the file that the job was '
                    "planned with; name files relative to the scene, so that workers find the same ones"
                )
        return self.files.path


def account_for_store(folder: str | Path, remove: bool = False, reporter: Reporter = SILENT) -> StoreStatus:
    """Report the jobs in the store ``folder``: how far each is, what it takes, and which inputs have changed.

    ``remove``: remove what no job asks for any more, what was made of files that have changed since, and what processes
    that died left over an hour ago or earlier. Raises `NergError` for a folder that is no store.
    """
    if not Path(folder).is_dir():
        raise NergError(f'there is no folder "{folder}"; name the one that was given as --store')
    reporter.progress(0.0, "looking at what is there")
    store = Store(folder)
    account = read_status(store)
    if account.jobs:
        reporter.message(format_markdown_table(_HEAD, [_row(job) for job in account.jobs], _HEAD[1:]))
    for job in account.jobs:
        for path in job.changed:
            reporter.message(f"changed since {job.name}: {path}")
        for path in job.missing:
            reporter.message(f"not there any more for {job.name}: {path}")
    stale, left = len(account.stale), len(account.leftovers)
    reporter.message(
        f"{format_bytes(account.bytes)} in all; stale: {stale} outputs, {format_bytes(account.stale_bytes)}; "
        f"left over: {left}, {format_bytes(account.leftover_bytes)}."
    )
    if remove:
        reporter.message(f"Removed {format_bytes(remove_stale(store, account))}.")
    elif stale or left:
        reporter.message("nerg jobs --remove-stale takes out what is stale or left over.")
    return account


def _row(job: JobStatus) -> tuple[str, ...]:
    counts = (job.total, job.done, job.remaining)
    return (job.name, *map(str, counts), format_bytes(job.bytes), f"{job.seconds:.0f} s", str(job.outdated))


def format_bytes(count: float) -> str:
    """So many bytes as one says it: 12 kB, 3.4 MB."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "bytes" or count >= 10 else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"
