"""Engines that run the parts of a job: this process, processes of this machine, or the workers of a Dask cluster.

`run_plan` runs a plan on an engine and yields its outputs in the order of the plan.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError

from .cluster import MAX_WORKER_WAIT, ClusterEngine
from .execution import MAX_ATTEMPTS, Engine, TaskResult, WarningCallback, release_prepared, run_task
from .store import ResultManifest, Store
from .task import Checksums, Plan, SharedContext, Task


def open_engine(name: str | None, threads: int = 0, worker_wait: float = MAX_WORKER_WAIT) -> Engine:
    """Create the engine ``name``.

    Parameters
    ----------
    name
        "local" or None: this process. "local:N": N processes of this machine. "tcp://HOST:PORT" or "tls://HOST:PORT":
        the workers of the Dask scheduler at that address.
    threads
        Threads of each worker process; 0: as many as are available. Ignored by the local engine.
    worker_wait
        Seconds to wait without a suitable worker of a cluster.

    Raises
    ------
    NergError
        For another name.
    ImportError
        If Dask is missing.
    """
    if name is None or name == "local":
        return LocalEngine()
    if match := re.fullmatch(r"local:(\d{1,6})", name):
        return ProcessEngine(int(match[1]), threads)
    if "://" not in name:
        raise NergError(
            f'unknown scheduler "{name}": use local, local:N for N processes, tcp://HOST:PORT or tls://HOST:PORT'
        )
    return ClusterEngine(name, threads, worker_wait=worker_wait)


# ---- This process ----


def _run_and_store(
    store: Store, shared: SharedContext, task: Task, checksums: Checksums, threads: int = 0
) -> ResultManifest:
    with store.write_output(task) as output:
        manifest = run_task(shared, task, output, checksums, threads)
    store.add_manifest(manifest)
    return manifest


class LocalEngine:
    """Runs one task after the other in this process."""

    def run(
        self, shared: SharedContext, tasks: Sequence[Task], store: Store, warn: WarningCallback
    ) -> Generator[TaskResult]:
        checksums = Checksums()
        try:
            for task in tasks:
                yield TaskResult(task, _run_and_store(store, shared, task, checksums))
        finally:
            release_prepared()


# ---- Processes of this machine ----


@contextmanager
def process_pool(count: int, prepare: Callable[..., None], *arguments: Any) -> Iterator[ProcessPoolExecutor]:
    """Create a pool of ``count`` processes, each of which first calls ``prepare(*arguments)``.

    The processes are terminated at the end of the block, and also if this process ends in any other way. They ignore
    Ctrl-C, which this process handles.
    """
    # Not forked: a fork loses the threads of libraries but keeps their locks.
    context = multiprocessing.get_context("spawn")
    child_end, parent_end = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(
        count, context, initializer=_initialize_process, initargs=(child_end, prepare, arguments)
    )
    try:
        yield pool
    finally:
        parent_end.close()
        pool.shutdown(wait=True, cancel_futures=True)


def _initialize_process(parent_pipe: Any, prepare: Callable[..., None], arguments: Sequence[Any]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_parent() -> None:
        try:
            parent_pipe.recv()
        except EOFError:
            os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    prepare(*arguments)


POOL_ENDED_HINT = (
    "if memory was short, use fewer processes; a script needs its own code below if __name__ == '__main__'"
)
"""Remedy for a process of a pool that was terminated."""


class ProcessEngine:
    """Runs tasks in ``count`` processes of this machine.

    Each process runs one task at a time with ``threads`` threads; 0 divides the cores equally. One process uses all
    cores for an image or a training. Several processes help with tasks that do not use all cores, and with tasks whose
    memory must be released afterwards.
    """

    def __init__(self, count: int, threads: int = 0):
        if not 1 <= count <= 1024:
            raise NergError(f"{count} worker processes are not supported; choose 1 to 1024")
        self.count = count
        self.threads = threads or max((os.cpu_count() or 1) // count, 1)

    def run(
        self, shared: SharedContext, tasks: Sequence[Task], store: Store, warn: WarningCallback
    ) -> Generator[TaskResult]:
        pending, attempts = list(reversed(tasks)), Counter[str]()
        while pending:
            running: dict[Future, Task] = {}
            try:
                with process_pool(min(self.count, len(pending)), _set_job, shared, store.folder, self.threads) as pool:
                    while pending or running:
                        while pending and len(running) < self.count:
                            running[pool.submit(_run_in_process, pending[-1])] = pending[-1]
                            pending.pop()
                        done = wait(running, return_when=FIRST_COMPLETED).done
                        for future in sorted(done, key=lambda f: isinstance(f.exception(), BrokenProcessPool)):
                            manifest, worker = future.result()
                            yield TaskResult(running.pop(future), manifest, worker)
            except BrokenProcessPool:
                # It is unknown which of the running tasks terminated its process.
                lost = list(running.values()) or pending[-1:]
                pending += [task for task in running.values() if task not in pending]
                attempts.update(task.key for task in lost)
                names = " or ".join(task.label for task in lost)
                if max(attempts[task.key] for task in lost) >= MAX_ATTEMPTS:
                    raise NergError(
                        f"a process was terminated at {names}, {MAX_ATTEMPTS} times; {POOL_ENDED_HINT}"
                    ) from None
                warn(f"a process was terminated at {names}, perhaps because memory was short; its tasks are run again")


_process_job: list[tuple[SharedContext, Store, int, Checksums]] = []
"""Job of this process of a pool: shared context, store, number of threads and checksums."""


def _set_job(shared: SharedContext, folder: Path, threads: int) -> None:
    _process_job.append((shared, Store(folder), threads, Checksums()))


def _run_in_process(task: Task) -> tuple[ResultManifest, str]:
    shared, store, threads, checksums = _process_job[0]
    return _run_and_store(store, shared, task, checksums, threads), f"process {os.getpid()}"


# ---- Plans ----


@dataclass
class PlanProgress:
    """Progress of a plan.

    Attributes
    ----------
    total
        Number of tasks.
    reused
        Tasks whose output was in the store already.
    done
        Completed tasks, including reused ones.
    seconds
        Time since the first missing task was started.
    processors
        Names of the processors that computed the outputs.
    """

    total: int
    reused: int = 0
    done: int = 0
    seconds: float = 0.0
    processors: set[str] = field(default_factory=set)

    @property
    def fraction(self) -> float:
        """Completed fraction of the tasks, from 0 to 1."""
        return self.done / self.total if self.total else 1.0

    @property
    def remaining_seconds(self) -> float | None:
        """Estimated remaining time from the rate of this run; None until the first task of this run is complete."""
        computed = self.done - self.reused
        return self.seconds * (self.total - self.done) / computed if computed else None

    def format_line(self, with_remaining: bool = True) -> str:
        """Format a line for a progress bar: completed parts, rate, and the remaining time if ``with_remaining``."""
        text = f"{self.done} of {self.total} parts"
        if self.remaining_seconds is None:
            return text
        rate = (self.done - self.reused) / max(self.seconds, 1e-9)
        text += f", {rate:.2g} per second" if rate >= 1 else f", {60 * rate:.2g} per minute"
        return f"{text}, {self.remaining_seconds:.0f} s left" if with_remaining else text


@dataclass(frozen=True)
class TaskOutput:
    """Output of a part: the read-only file or folder ``path`` in the store, and the ``notes`` of the task function."""

    path: Path
    notes: Mapping[str, Any]


def run_plan(
    plan: Plan,
    store: Store,
    engine: Engine,
    on_progress: Callable[[PlanProgress], None] = lambda progress: None,
    warn: WarningCallback = lambda text: None,
) -> Iterator[TaskOutput]:
    """Run ``plan`` and yield the output of each part in order, as soon as it and all previous outputs are available.

    Intact outputs in ``store`` are reused; missing and damaged ones are computed by ``engine``. Because the order of
    the outputs is fixed, floating-point sums over them are reproducible bit by bit. Raises `NergError` if a part fails.
    Completed outputs are kept, and the next run of the same plan continues from there.
    """
    store.save_plan(plan)
    missing: dict[str, Task] = {}
    finished: set[str] = set()
    counts = Counter(task.key for task in plan.tasks)
    progress = PlanProgress(len(plan.tasks))
    for task in plan.tasks:
        if task.key in finished or task.key in missing:
            continue
        manifest = store.find_valid(task.key, task.suffix)
        if manifest is None:
            missing[task.key] = task
        else:
            finished.add(task.key)
            progress.processors.add(manifest.processor)
    progress.reused = progress.done = sum(counts[key] for key in finished)
    on_progress(progress)
    start = time.perf_counter()
    with closing(engine.run(plan.shared, list(missing.values()), store, warn)) as results:
        for task in plan.tasks:
            while task.key not in finished:
                done = next(results, None)
                if done is None:
                    raise RuntimeError(f"{task.label} was not run")
                finished.add(done.task.key)
                progress.done += counts[done.task.key]
                progress.seconds = time.perf_counter() - start
                num_processors = len(progress.processors)
                progress.processors.add(done.manifest.processor)
                if num_processors == 1 < len(progress.processors):
                    names = " and ".join(f'"{name}"' for name in sorted(progress.processors))
                    warn(f"parts are computed on {names}; equal seeds give identical bytes only on equal processors")
                on_progress(progress)
            manifest = store.read_manifest(task.key)
            if manifest is None:
                raise NergError(
                    f'{task.label} was removed from "{store.folder}" while the job was running; start the job again'
                )
            yield TaskOutput(store.output_path(task.key, task.suffix), manifest.notes)
