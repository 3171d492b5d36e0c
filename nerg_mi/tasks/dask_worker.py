"""A worker of a dask cluster that runs tasks: what it is asked for, and the process that `nerg worker` is.

The task itself is run by a child process (`children`), so that the worker's own keeps answering while kernels are
compiled and run, and outlives them.
"""

from __future__ import annotations

import asyncio
import logging
import signal
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError, expected, sentence

from .addresses import check_address, import_distributed, own_host, security_for
from .children import Child, ChildDied, TaskFailed
from .kept_inputs import KeptInputs
from .making import check_code
from .protocol import Warn
from .receipt import files_in
from .store import Store, shares
from .task import FOLDER, Task, task_of

MOST_SENT = 1 << 28
"""Bytes of an output that are sent back where the store's folder is not shared."""

_LOST = ("worker-handle-scheduler-connection-broken", "worker-heartbeat-missing", "worker-heartbeat-error") + (
    "scheduler-close",
)
"""Dask's reasons for closing a worker that say that the scheduler is gone, and not that it wants this worker to end."""


@cache
def _child() -> Child:
    """The one process of this worker that runs tasks, one at a time."""
    return Child()


@cache
def _inputs() -> KeptInputs:
    return KeptInputs()


@cache
def _own_store() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="nerg-outputs-")


def perform(document: Mapping[str, Any], store: str, probe: str, threads: int = 0) -> dict[str, Any]:
    """Run the task that ``document`` describes, for the client whose ``store`` holds the file ``probe``, with
    ``threads`` at most; 0: with all that this worker has.

    Gives one of: ``receipt``, with ``content`` (names and bytes of files) where the store is not to be seen from here;
    ``needs``, checksums of inputs that have to be sent first, with the ``worker`` that needs them; ``died``, how the
    child ended; ``error``, a sentence, with its ``kind``, ``final``, ``mendable`` or ``fault``, and ``trace``.
    """
    import distributed

    try:
        task = task_of(document)
        check_code(task)
        paths = _inputs().paths(task.inputs)
        if paths is None:
            return {"needs": _inputs().missing(task.inputs), "worker": distributed.get_worker().address}
        if shares(Path(store), probe):
            return {"receipt": vars(_child().make(task, paths, Path(store), threads))}
        return _made_apart(task, paths, threads)
    except ChildDied as error:
        return {"died": str(error)}
    except TaskFailed as error:
        kind = "final" if error.final else "mendable" if error.mendable else "fault"
        return {"error": str(error), "kind": kind, "trace": error.trace}
    except Exception as error:
        if not expected(error):
            raise
        return {"error": sentence(error), "kind": "final", "trace": ""}


def _made_apart(task: Task, paths: dict[str, str], threads: int) -> dict[str, Any]:
    """An output as names and bytes, which nothing here keeps."""
    store = Store(_own_store().name)
    receipt = _child().make(task, paths, store.folder, threads)
    output = store.output(task.key, task.suffix)
    try:
        if receipt.size > MOST_SENT:
            raise NergError(
                f"{task.label} has an output of {receipt.size:,} bytes, more than the {MOST_SENT:,} that workers send; "
                "share the store's folder with the workers"
            )
        files = files_in(output) if task.suffix == FOLDER else [output]
        names = [f.relative_to(output).as_posix() if task.suffix == FOLDER else "" for f in files]
        content = [(n, f.read_bytes()) for n, f in zip(names, files)]
        return {"receipt": vars(receipt), "content": content}
    finally:
        store.remove(task.key, task.suffix)


def receive(sha256: str, number: int, count: int, data: bytes) -> None:
    """Take a part of a file that tasks will read; see `KeptInputs.receive`."""
    _inputs().receive(sha256, number, count, data)


def serve_cluster(address: str, patience: float, tell: Warn, name: str | None = None) -> None:
    """Be a worker of the scheduler at ``address``, until that ends it, or Ctrl-C does.

    It may be there before the scheduler is, and after: it waits for ``patience`` seconds for one to be there. ``tell``
    hears of that. ``name``: by which the scheduler knows it, which no other may have. Raises `NergError` where none
    came.
    """
    check_address(address)
    # What dask logs about connections is told in sentences of ours; importing it sets levels.
    import_distributed()
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        asyncio.run(_serve(address, patience, tell, name, security_for(address)))
    except asyncio.CancelledError:
        # A batch system's SIGTERM ends it as Ctrl-C does, with nothing left behind.
        raise KeyboardInterrupt from None


async def _serve(address: str, patience: float, tell: Warn, name: str | None, security: Any) -> None:
    distributed = import_distributed()
    serving = asyncio.current_task()
    assert serving is not None
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, serving.cancel)

    class OneTask(distributed.Worker):
        ended_for = ""

        async def close(self, *given: Any, reason: str = "", **more: Any) -> Any:
            self.ended_for = self.ended_for or reason
            return await super().close(*given, reason=reason, **more)

    while True:
        # Memory is a child's, which the system bounds; a dashboard would be one more open port.
        with tempfile.TemporaryDirectory(prefix="nerg-dask-") as scratch:
            settings = {"nthreads": 1, "memory_limit": 0, "dashboard": False, "local_directory": scratch}
            settings |= {"host": own_host(address), "dashboard_address": "127.0.0.1:0"}
            worker = OneTask(address, name=name, security=security, **settings)
            try:
                await asyncio.wait_for(worker, patience)
            except asyncio.TimeoutError:
                await worker.close(reason="waited")
                raise NergError(
                    f"no scheduler has answered at {address} for {patience:g} s; start one with "
                    "dask scheduler, and the worker again"
                ) from None
            tell(f"works for {address}")
            try:
                await worker.finished()
            except asyncio.CancelledError:
                await worker.close(timeout=1, reason="interrupted")
                raise
        if worker.ended_for not in _LOST:
            return
        tell(f"{address} is gone; waiting for it")
