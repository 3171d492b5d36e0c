"""Engines that run the parts of a job: this process, processes of this machine, or the workers of a Dask cluster.

`run_plan` runs a plan on an engine and yields its outputs in the order of the plan.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import multiprocessing
import os
import re
import signal
import tempfile
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

from nerg_mi.errors import NergError, format_error, is_user_error
from nerg_mi.files.atomic import create_folder_atomically, make_folder, write_bytes
from nerg_mi.files.safe_read import read_bytes
from nerg_mi.threads import get_worker_threads, limit_threads, set_thread_count

from .store import ResultManifest, Store, make_manifest, read_contents
from .task import (
    FOLDER_SUFFIX,
    Checksums,
    InputFile,
    Plan,
    SharedContext,
    Task,
    compute_code_digest,
    compute_value_digest,
    relocate_paths,
)

MAX_ATTEMPTS = 3
"""Number of times that a part may terminate its process before the job fails with an error that names the part."""

WORKER_WAIT = 10.0
"""Seconds without any worker after which a warning is issued."""

MAX_PENDING = 200
"""Maximum number of parts that are submitted to a cluster at a time. It bounds the memory of a long plan; additional
workers are idle."""

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


def open_engine(name: str | None, threads: int = 0) -> Engine:
    """Create the engine ``name``.

    Parameters
    ----------
    name
        "local" or None: this process. "local:N": N processes of this machine. "tcp://HOST:PORT" or "tls://HOST:PORT":
        the workers of the Dask scheduler at that address.
    threads
        Threads of each worker process; 0: as many as are available. Ignored by the local engine.

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
    return ClusterEngine(name, threads)


# ---- One task ----


class ChangedInput(NergError):
    """A file has changed since the job was planned. A retry cannot help."""


class MissingInputFiles(Exception):
    """Some input files of a task do not exist at the planned paths on this machine."""


_prepared_common: list[tuple[Any, Any]] = []


def prepare_once(common: Any, factory: Callable[[], Any]) -> Any:
    """Return ``factory()``, cached for all parts with the same ``common``. Only the last value is cached."""
    if not _prepared_common or _prepared_common[0][0] is not common:
        _prepared_common.clear()
        _prepared_common.append((common, factory()))
    return _prepared_common[0][1]


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


def _run_and_store(
    store: Store, shared: SharedContext, task: Task, checksums: Checksums, threads: int = 0
) -> ResultManifest:
    with store.write_output(task) as output:
        manifest = run_task(shared, task, output, checksums, threads)
    store.add_manifest(manifest)
    return manifest


def _check_unchanged(files: Sequence[InputFile], checksums: Checksums) -> None:
    for file in files:
        if checksums.compute(file.path) != file.sha256:
            raise ChangedInput(
                f'"{file.path}" was changed while the job was running; start the job again: results that do not '
                "depend on "
                "this file are kept"
            )


class LocalEngine:
    """Runs one task after the other in this process."""

    def run(
        self, shared: SharedContext, tasks: Sequence[Task], store: Store, warn: WarningCallback
    ) -> Generator[TaskResult]:
        checksums = Checksums()
        for task in tasks:
            yield TaskResult(task, _run_and_store(store, shared, task, checksums))


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


# ---- Dask ----

_ADDRESS = re.compile(r"(tcp|tls)://(\[[0-9a-fA-F:]+\]|[\w.-]+):(\d{1,5})")

TLS_HINT = (
    "tls:// needs certificates: set DASK_DISTRIBUTED__COMM__TLS__CA_FILE, and __CLIENT__CERT and __CLIENT__KEY "
    "(for workers __WORKER__CERT and __WORKER__KEY) in place of __CA_FILE, or write them into dask's configuration"
)


def import_distributed() -> ModuleType:
    """Import the module `distributed` of Dask. Raises ``ImportError`` with the install command if it is missing."""
    try:
        import distributed
    except ImportError:
        raise ImportError('a cluster needs dask, which is not installed: pip install "nerg-mi[cluster]"') from None
    return distributed


def check_address(address: str) -> None:
    """Raise `NergError` unless ``address`` is a scheduler address: tcp://HOST:PORT or tls://HOST:PORT."""
    match = _ADDRESS.fullmatch(address)
    if match is None or not 0 < int(match[3]) < 65536:
        raise NergError(f'"{address}" is not a scheduler address; use tcp://HOST:PORT or tls://HOST:PORT')


def describe_exposure(address: str) -> str | None:
    """Return a warning if the connection to ``address`` is neither encrypted nor local; otherwise None."""
    match = _ADDRESS.fullmatch(address)
    if match is None or match[1] == "tls" or _is_loopback(match[2].strip("[]")):
        return None
    return (
        f"{address} is not protected: anyone who can reach that port, or a worker's port, can run code on the "
        "scheduler, the "
        "workers and this machine; use tls://, or a tunnel to 127.0.0.1"
    )


def find_local_host(address: str) -> str:
    """Return the address of this machine that the scheduler at ``address`` can reach. A worker listens on this
    address only.
    """
    match = _ADDRESS.fullmatch(address)
    host = match[2].strip("[]") if match is not None else ""
    if _is_loopback(host):
        return "127.0.0.1" if host == "localhost" else host
    return import_distributed().utils.get_ip(host)


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def make_security(address: str) -> Any:
    """Return the security settings of Dask for ``address``: its configured certificates for tls://, otherwise None.

    Raises `NergError` if tls:// has no certificates.
    """
    distributed = import_distributed()
    if not address.startswith("tls://"):
        return None
    security = distributed.Security(require_encryption=True)
    if not security.tls_ca_file:
        raise NergError(TLS_HINT)
    return security


class ClusterEngine:
    """Runs tasks on the workers of the Dask scheduler at ``address``.

    If a worker dies, Dask runs its task on another one; failed tasks are retried. Raises `NergError` for an invalid
    address.

    Parameters
    ----------
    address
        tcp://HOST:PORT or tls://HOST:PORT.
    threads
        Maximum number of threads per worker; 0: all threads of the worker.
    timeout
        Seconds to wait for the scheduler.
    """

    def __init__(self, address: str, threads: int = 0, timeout: float = 10.0):
        check_address(address)
        make_security(address)
        self.address, self.threads, self.timeout = address, threads, timeout

    def run(
        self, shared: SharedContext, tasks: Sequence[Task], store: Store, warn: WarningCallback
    ) -> Generator[TaskResult]:
        if not tasks:
            return
        distributed = import_distributed()
        exposure = describe_exposure(self.address)
        if exposure is not None:
            warn(exposure)
        with _silence_dask(), self._connect() as client:
            try:
                _wait_for_worker(client, warn)
                submitter, pending, running = _Submitter(client, shared), list(reversed(tasks)), dict[Any, Task]()
                completed = distributed.as_completed(loop=client.loop)
                while pending or running:
                    while pending and len(running) < MAX_PENDING:
                        future = submitter.submit(pending[-1], self.threads)
                        running[future] = pending.pop()
                        completed.add(future)
                    future = next(completed)
                    task = running.pop(future)
                    try:
                        manifest, content, worker = future.result()
                    except MissingInputFiles:
                        submitter.sends_files = True
                        pending.append(task)
                        continue
                    except distributed.KilledWorker:
                        raise NergError(
                            f"{task.label} was started by several workers, each of which terminated; run it locally "
                            "to find "
                            "the cause"
                        ) from None
                    except ImportError as error:
                        raise NergError(
                            f"a worker cannot run nerg_mi ({format_error(error)}); start workers with nerg worker, in "
                            "the "
                            "same version"
                        ) from error
                    store.import_output(task, manifest, content)
                    yield TaskResult(task, manifest, worker)
            except (distributed.CancelledError, distributed.comm.CommClosedError, asyncio.CancelledError):
                raise NergError(
                    f"the scheduler at {self.address} has stopped; start a scheduler and the job again: completed "
                    "results are kept"
                ) from None

    def _connect(self) -> Any:
        distributed = import_distributed()
        try:
            return distributed.Client(
                self.address, security=make_security(self.address), timeout=self.timeout, set_as_default=False
            )
        except OSError as error:
            raise NergError(
                f"no scheduler answers at {self.address} ({format_error(error)[:120]}); start one with dask "
                "scheduler, and "
                "start the job again: completed results are kept"
            ) from error


class _Submitter:
    """Submits tasks with the shared context, and with their files after a worker has reported that it lacks them.

    Context and files are stored as Dask futures, which Dask recomputes if the worker that holds them dies.
    """

    def __init__(self, client: Any, shared: SharedContext):
        self.client, self.sends_files = client, False
        self._futures: dict[str, Any] = {}
        self._shared = shared
        self._job = self._store_on_cluster("job", shared)
        # Dask prefers workers that hold the inputs of a task. Replication avoids that all tasks go to one worker.
        client.replicate([self._job])

    def submit(self, task: Task, threads: int) -> Any:
        """Submit ``task`` to `_run_on_worker` and return its future."""
        files: dict[str, Any] = {}
        if self.sends_files:
            for file in (*self._shared.files, *task.files):
                files[file.sha256] = self._store_on_cluster(
                    file.sha256, lambda file=file: read_bytes(file.path, "input", file.size)
                )
        return self.client.submit(_run_on_worker, self._job, task, files, threads, pure=False, retries=MAX_ATTEMPTS - 1)

    def _store_on_cluster(self, name: str, value: Any) -> Any:
        if name not in self._futures:
            with warnings.catch_warnings():
                # Suppress Dask's warning about large objects.
                warnings.simplefilter("ignore", UserWarning)
                self._futures[name] = self.client.submit(_identity, value() if callable(value) else value, pure=False)
        return self._futures[name]


def _identity(value: Any) -> Any:
    return value


def _wait_for_worker(client: Any, warn: WarningCallback) -> None:
    try:
        client.wait_for_workers(1, timeout=WORKER_WAIT)
    except TimeoutError:
        warn(f'no worker is connected; start workers with "nerg worker {client.scheduler.address}"')


@contextmanager
def _silence_dask() -> Iterator[None]:
    """Suppress Dask's log messages about connections, which are reported as warnings and errors of this package."""
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels):
            logger.setLevel(level)


# ---- Functions that run on a Dask worker ----

_checksums = Checksums()
_local_shared: list[tuple[SharedContext, SharedContext]] = []


def _run_on_worker(
    shared: SharedContext, task: Task, files: Mapping[str, bytes], threads: int
) -> tuple[ResultManifest, list[tuple[str, bytes]], str]:
    """Run a task on this Dask worker.

    Returns the manifest, the files of the output, and the address of the worker. ``files`` maps the SHA-256 of input
    files to their bytes. Raises `MissingInputFiles` if files are missing.
    """
    worker = import_distributed().get_worker()
    scratch = Path(worker.local_directory)
    if not _local_shared or _local_shared[0][0] is not shared:
        inputs, common = localize_inputs(shared.files, shared.common, files, scratch)
        _local_shared[:] = [(shared, replace(shared, files=inputs, common=common))]
    inputs, value = localize_inputs(task.files, task.value, files, scratch)
    task = replace(task, files=inputs, value=value)
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        output = Path(folder, f"output{task.suffix.rstrip(FOLDER_SUFFIX)}")
        if task.suffix == FOLDER_SUFFIX:
            make_folder(output)
        try:
            receipt = run_task(
                _local_shared[0][1], task, output, _checksums, limit_threads(get_worker_threads(), threads)
            )
        except RuntimeError as error:
            # Dask does not transfer the cause of an exception. The traceback is needed to find the bug.
            raise RuntimeError(f"{error}\n{traceback.format_exc()}") from None
        return receipt, read_contents(output), worker.address


def localize_inputs(
    inputs: tuple[InputFile, ...], value: Any, files: Mapping[str, bytes], scratch: Path
) -> tuple[tuple[InputFile, ...], Any]:
    """Return ``inputs`` and ``value`` with the paths on this machine.

    The planned paths are used if they contain the same bytes. Otherwise the files are written below ``scratch`` in the
    same layout.
    """
    if all(_checksums.is_unchanged(file) for file in inputs):
        return inputs, value
    if not all(file.sha256 in files for file in inputs):
        raise MissingInputFiles
    folder = scratch / f"nerg-{compute_value_digest([[file.name, file.sha256] for file in inputs])[:32]}"
    if not folder.exists():
        with create_folder_atomically(folder) as temporary:
            for file in inputs:
                write_bytes(temporary / file.name, files[file.sha256])
    localized = tuple(replace(file, path=str(folder / file.name)) for file in inputs)
    return localized, relocate_paths(value, inputs, folder)


def run_dask_worker(address: str, timeout: float, on_message: WarningCallback, name: str | None = None) -> None:
    """Run a Dask worker for the scheduler at ``address`` until the scheduler or Ctrl-C stops it.

    The worker has one Dask thread, and its process is restarted if it dies. Raises `NergError` if no scheduler answers.

    Parameters
    ----------
    address
        Address of the scheduler.
    timeout
        Seconds to wait for the scheduler.
    on_message
        Callback for status messages.
    name
        Unique name of the worker at the scheduler.
    """
    check_address(address)
    import_distributed()
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        asyncio.run(_serve_async(address, timeout, on_message, name, make_security(address)))
    except asyncio.CancelledError:
        # The SIGTERM of a batch system stops the worker in the same way as Ctrl-C, including the cleanup.
        raise KeyboardInterrupt from None


async def _serve_async(
    address: str, timeout: float, on_message: WarningCallback, name: str | None, security: Any
) -> None:
    import dask.config

    serving = asyncio.current_task()
    assert serving is not None
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, serving.cancel)
    # The system limits the memory, this package controls the threads, and a dashboard would open another port.
    settings = {"nthreads": 1, "memory_limit": 0, "dashboard": False, "host": find_local_host(address), "name": name}
    settings |= {"dashboard_address": "127.0.0.1:0", "security": security, "death_timeout": timeout}
    settings |= {"silence_logs": logging.CRITICAL}
    with (
        dask.config.set({"distributed.nanny.pre-spawn-environ": {}}),
        tempfile.TemporaryDirectory(prefix="nerg-dask-") as scratch,
    ):
        try:
            async with import_distributed().Nanny(address, local_directory=scratch, **settings) as nanny:
                on_message(f"connected to {address}")
                await nanny.finished()
                on_message(f"{address} has stopped; start the worker again when a scheduler is running")
        except (asyncio.TimeoutError, OSError) as error:
            raise NergError(
                f"no scheduler answered at {address} within {timeout:g} s; start one with dask scheduler, and start "
                "the "
                "worker again"
            ) from error
