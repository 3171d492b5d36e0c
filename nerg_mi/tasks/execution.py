"""One task: its execution, its result, and the interface of engines that run many."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from nerg_mi.errors import NergError, format_error, is_user_error
from nerg_mi.threads import set_thread_count

from .store import ResultManifest, Store, make_manifest
from .task import Checksums, InputFile, SharedContext, Task, compute_code_digest

MAX_ATTEMPTS = 3
"""Number of times that a part may terminate its process before the job fails with an error that names the part."""

WarningCallback = Callable[[str], None]
"""Callback that receives a warning as one sentence."""


@dataclass(frozen=True)
class TaskResult:
    """A ``task`` whose output is complete in the store. ``worker``: the process that computed it ("" for this
    process).
    """

    task: Task
    manifest: ResultManifest
    worker: str = ""


class Engine(Protocol):
    """Runs tasks and stores their outputs.

    ``run`` yields each result when it is complete, in any order. Closing the generator cancels the remaining tasks. A
    task that fails raises an error that names it.
    """

    def run(
        self, shared: SharedContext, tasks: Sequence[Task], store: Store, warn: WarningCallback
    ) -> Generator[TaskResult]: ...


class ChangedInput(NergError):
    """A file has changed since the job was planned. A retry cannot help."""


_prepared_common: list[tuple[Any, Any]] = []


def prepare_once(common: Any, factory: Callable[[], Any]) -> Any:
    """Return ``factory()``, cached for all parts with the same ``common``. Only the last value is cached."""
    if not _prepared_common or _prepared_common[0][0] is not common:
        _prepared_common.clear()
        _prepared_common.append((common, factory()))
    return _prepared_common[0][1]


def release_prepared() -> None:
    """Release what `prepare_once` has cached."""
    _prepared_common.clear()


def run_task(shared: SharedContext, task: Task, output: Path, checksums: Checksums, threads: int = 0) -> ResultManifest:
    """Run ``task``, which writes ``output``, and return its manifest.

    Parameters
    ----------
    shared
        Context that all tasks of the job share.
    task
        The task.
    output
        File or folder to write.
    checksums
        Cache of the checksums of input files.
    threads
        CPU threads; 0 keeps the current number.

    Raises
    ------
    ChangedInput
        If an input file differs from the planned one, before or after the run.
    NergError
        If the job was planned by another version of this package, or the task fails with an error that the user can
        fix.
    """
    if shared.code_digest != compute_code_digest():
        raise NergError(
            f"{task.label} was planned by another version of nerg_mi ({shared.code_digest}) than the worker's "
            f"({compute_code_digest()}); install the same one everywhere and start the workers again"
        )
    files = (*shared.files, *task.files)
    _check_unchanged(files, checksums)
    if threads:
        set_thread_count(threads)
    start = time.perf_counter()
    try:
        notes = shared.work(shared.common, task.value, output) or {}
    except Exception as error:
        if is_user_error(error):
            raise NergError(f"{task.label}: {format_error(error)}") from error
        raise RuntimeError(f"{task.label}: {type(error).__name__}: {error}") from error
    seconds = time.perf_counter() - start
    # A file that changed during the run may have been read partly in its old and partly in its new version.
    _check_unchanged(files, checksums)
    return make_manifest(task, output, seconds, notes)


def _check_unchanged(files: Sequence[InputFile], checksums: Checksums) -> None:
    for file in files:
        if checksums.compute(file.path) != file.sha256:
            raise ChangedInput(
                f'"{file.path}" was changed while the job was running; start the job again: results that do not '
                "depend on "
                "this file are kept"
            )
