"""A task run, in whatever process: inputs checked, the output written whole or not at all, and signed for."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

from nerg_mi.errors import NergError

from .code import code_digest, processor
from .inputs import Checksums, check_unchanged
from .receipt import Receipt, receipt_for
from .store import Store
from .task import Task, find_function


class OtherCode(NergError):
    """Who should run a task has another version of this package: it may run others, and not this one."""


def make_output(task: Task, paths: Mapping[str, Path], store: Store, checksums: Checksums) -> Receipt:
    """Run ``task`` on the files ``paths``, by the names of its inputs, and put its output into ``store``.

    Raises `inputs.ChangedInput` where a file has other bytes than were planned with, before or after, `OtherCode` where
    the task was planned by another version of this package, and whatever its function raises.
    """
    check_code(task)
    work = find_function(task.function)
    check_unchanged(task.inputs, paths, checksums)
    start = time.perf_counter()
    with store.writing(task) as output:
        notes = work(task.parameters, paths, output) or {}
        seconds = time.perf_counter() - start
        # What was read may have been half of one version and half of another.
        check_unchanged(task.inputs, paths, checksums)
        receipt = receipt_for(task, output, seconds, processor(), notes)
    store.add(receipt)
    return receipt


def check_code(task: Task) -> None:
    """Raise `OtherCode` unless ``task`` was planned by the code that is here."""
    planned = task.versions.get("code")
    if planned not in (None, code_digest()):
        raise OtherCode(
            f"{task.label} was planned by another version of nerg_mi ({planned}) than the worker's ({code_digest()}); "
            "install the same one everywhere and start the workers again"
        )
