"""The scheduler that is a cluster of dask: tasks go to its workers, outputs come to the store.

Dask gives a task of a worker that died to another one. What it does not do is done here: a scheduler that went away is
waited for; what a slow worker keeps too long is run by another one too; files that a worker does not have are sent.
"""

from __future__ import annotations

import logging
import queue
import statistics
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from nerg_mi.errors import NergError, sentence

from . import dask_worker
from .addresses import check_address, import_distributed, security_for, unprotected
from .children import TaskFailed, failure
from .kept_inputs import CHUNK, MOST
from .protocol import ATTEMPTS, Done, Warn
from .receipt import Receipt
from .store import Store
from .task import Task

PATIENCE = 120.0
"""Seconds that a scheduler may be gone before the job ends."""

SLOW = 20.0
"""Seconds after which a task may be run by another worker too, if it also takes four times as long as others did."""

EVERY = 2.0
"""Seconds between two looks at which workers there are."""

LONELY = 10.0
"""Seconds without any worker after which that is said."""


class Lost(Exception):
    """The connection to the scheduler is gone, and everything that was asked of it."""


@dataclass
class _Open:
    """A task that is asked for: how often it has ended its worker or failed, since when, and by which futures."""

    task: Task
    attempts: int = 0
    since: float = 0.0
    futures: list[Any] = field(default_factory=list)


class Cluster:
    """Runs tasks on the workers of the dask scheduler at ``address`` (tcp://HOST:PORT or tls://HOST:PORT), as many at a
    time as there are workers, each with ``threads`` at most; 0: with all that it has. A scheduler that is gone is
    waited for as long as ``patience`` seconds. Raises `NergError` for an address that is none."""

    def __init__(self, address: str, patience: float = PATIENCE, slow: float = SLOW, threads: int = 0):
        check_address(address)
        import_distributed()
        security_for(address)
        self.address, self.patience, self.slow, self.threads = address, patience, slow, threads

    def run(self, tasks: Iterator[Task], store: Store, warn: Warn) -> Generator[Done]:
        danger = unprotected(self.address)
        if danger is not None:
            warn(danger)
        open_tasks: dict[str, _Open] = {}
        with store.probe() as probe, _quiet():
            while True:
                client = self._connected(warn)
                try:
                    yield from _Session(client, tasks, open_tasks, store, probe, self.slow, self.threads, warn).serve()
                    return
                except Lost:
                    warn(f"the scheduler at {self.address} is gone; waiting for it for {self.patience:g} s")
                    for kept in open_tasks.values():
                        kept.futures.clear()
                finally:
                    client.close(timeout=2)

    def _connected(self, warn: Warn) -> Any:
        distributed = import_distributed()
        until = time.monotonic() + self.patience
        while True:
            try:
                security = security_for(self.address)
                return distributed.Client(self.address, security=security, timeout=5, set_as_default=False)
            except OSError as error:
                if time.monotonic() > until:
                    raise NergError(
                        f"no scheduler answers at {self.address} ({sentence(error)[:120]}); start one with dask "
                        "scheduler, and the job again: what is done is kept"
                    ) from error
            time.sleep(0.5)


class _Session:
    """What is asked of one connection, until all is done or the connection is lost."""

    def __init__(
        self,
        client: Any,
        tasks: Iterator[Task],
        open_tasks: dict[str, _Open],
        store: Store,
        probe: str,
        slow: float,
        threads: int,
        warn: Warn,
    ):
        self.client, self.tasks, self.open, self.store = client, tasks, open_tasks, store
        self.probe, self.slow, self.threads, self.warn = probe, slow, threads, warn
        self.found: queue.Queue[tuple[str, Any]] = queue.Queue()
        self.workers: list[str] = []
        self.took: list[float] = []
        self.looked, self.begun, self.told = 0.0, time.monotonic(), False

    def serve(self) -> Generator[Done]:
        self._look()
        for kept in self.open.values():
            self._ask(kept)
        while True:
            # Also while tasks end one after the other: workers may have joined.
            self._look()
            self._fill()
            if not self.open:
                return
            try:
                key, future = self.found.get(timeout=0.25)
            except queue.Empty:
                self._look()
                self._hurry()
                continue
            kept = self.open.get(key)
            # The other of two that ran the same task was faster.
            if kept is not None and future in kept.futures:
                done = self._settle(kept, future)
                if done is not None:
                    del self.open[key]
                    for other in kept.futures:
                        other.cancel()
                    yield done

    def _fill(self) -> None:
        """Ask for more, as long as there are fewer than every worker has one and one to follow."""
        while len(self.open) < 2 * len(self.workers) + 1:
            task = next(self.tasks, None)
            if task is None:
                return
            self.open[task.key] = kept = _Open(task)
            self._ask(kept)

    def _ask(self, kept: _Open, workers: list[str] | None = None) -> None:
        kept.since = time.monotonic()
        task, number = kept.task, len(kept.futures)
        key = f"nerg-{task.key[:24]}-{time.monotonic_ns()}-{number}"
        asked = (dask_worker.perform, task.document(), str(self.store.folder), self.probe, self.threads)
        future = self.client.submit(*asked, key=key, pure=False, workers=workers)
        kept.futures.append(future)
        future.add_done_callback(lambda f: self.found.put((task.key, f)))

    def _look(self) -> None:
        """Which workers there are. Raises `Lost` where the scheduler does not answer."""
        if time.monotonic() - self.looked < EVERY:
            return
        self.looked = time.monotonic()
        try:
            if self.client.status != "running":
                raise Lost
            now = list(self.client.nthreads())
        except (OSError, TimeoutError, RuntimeError, ValueError) as error:
            raise Lost from error
        gone = set(self.workers) - set(now)
        if gone:
            self.warn(f"{len(gone)} of {len(self.workers)} workers have gone; their parts are run again")
        self.workers = now
        if not now and not self.told and time.monotonic() - self.begun > LONELY:
            self.told = True
            self.warn(f'no worker is there; start some with "nerg worker {self.client.scheduler.address}"')

    def _hurry(self) -> None:
        """Have idle workers run what takes others too long, when nothing else is left to ask for."""
        if len(self.open) > 2 * len(self.workers) or not self.took:
            return
        late = max(self.slow, 4 * statistics.median(self.took))
        behind = [k for k in self.open.values() if len(k.futures) == 1 and time.monotonic() - k.since > late]
        if not behind:
            return
        try:
            idle = [worker for worker, keys in self.client.processing().items() if not keys]
        except (OSError, TimeoutError) as error:
            raise Lost from error
        for kept, worker in zip(behind, idle):
            since = kept.since
            self.warn(f"{kept.task.label} takes long where it is; another worker runs it too")
            self._ask(kept, [worker])
            kept.since = since

    def _settle(self, kept: _Open, future: Any) -> Done | None:
        """What came of asking for a task: it is done, or is asked for again."""
        if future.cancelled() or future.status == "lost":
            raise Lost
        try:
            came = future.result(timeout=60)
        except Exception as error:
            self._failed(kept, future, error)
            return None
        if "receipt" in came:
            receipt, task = Receipt(**came["receipt"]), kept.task
            if "content" in came:
                self.store.put(task, receipt, came["content"])
            elif not self.store.output(task.key, task.suffix).exists():
                self._again(kept, future, "its output is not in the store")
                return None
            self.took.append(time.monotonic() - kept.since)
            return Done(task, receipt, str(came.get("worker", future.key)))
        if "needs" in came:
            self._send(came["worker"], came["needs"], kept.task)
            kept.futures.remove(future)
            self._ask(kept)
        elif "died" in came:
            self._again(kept, future, came["died"])
        elif came["kind"] == "mendable" and kept.attempts + 1 < ATTEMPTS:
            # It may be the worker's own, such as a full disk; another one has another.
            self._again(kept, future, came["error"])
        else:
            error = TaskFailed(came["error"], came["trace"], came["kind"] == "final", came["kind"] != "fault")
            raise failure(kept.task, error)
        return None

    def _failed(self, kept: _Open, future: Any, error: Exception) -> None:
        """What dask itself says of a task: it has given up, or the connection is lost."""
        kind = type(error).__name__
        if kind in ("CancelledError", "FutureCancelledError", "CommClosedError") or self.client.status != "running":
            raise Lost from error
        if kind == "KilledWorker":
            raise NergError(
                f"{kept.task.label} was begun by several workers, and each of them ended; run it alone to see why"
            ) from error
        if isinstance(error, ImportError):
            raise NergError(
                f"a worker cannot run nerg_mi ({sentence(error)}); start workers with nerg worker, of the same version"
            ) from error
        if kind == "TimeoutError":
            self._again(kept, future, "its answer did not come")
            return
        raise error

    def _again(self, kept: _Open, future: Any, why: str) -> None:
        kept.futures.remove(future)
        kept.attempts += 1
        if kept.attempts >= ATTEMPTS:
            raise NergError(f"{kept.task.label} was run {kept.attempts} times and never done, the last time: {why}")
        self.warn(f"{kept.task.label} is run again: {why}")
        if not kept.futures:
            self._ask(kept)

    def _send(self, worker: str, needs: list[str], task: Task) -> None:
        """Send a worker the files that it has not. One that goes away meanwhile needs nothing any more."""
        files = {file.sha256: file for file in task.inputs}
        for sha256 in needs:
            file = files[sha256]
            if file.size > MOST:
                raise NergError(
                    f'"{file.path}" has {file.size:,} bytes, and at most {MOST:,} are sent; share its folder'
                )
            count = max(-(-file.size // CHUNK), 1)
            with open(file.path, "rb") as source:
                for number in range(count):
                    try:
                        self.client.run(
                            dask_worker.receive, sha256, number, count, source.read(CHUNK), workers=[worker]
                        )
                    except (OSError, ValueError, KeyError):
                        return


@contextmanager
def _quiet() -> Iterator[None]:
    """What dask logs about connections is told in sentences of ours."""
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before):
            logger.setLevel(level)
