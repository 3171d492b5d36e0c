"""Engine that runs the parts of a job on the workers of a Dask cluster, and the workers themselves."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import math
import os
import pickle
import re
import signal
import tempfile
import time
import traceback
import warnings
from collections import Counter, defaultdict
from collections.abc import Awaitable, Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

from nerg_mi.errors import NergError, format_error
from nerg_mi.files.atomic import create_folder_atomically, make_folder, write_bytes
from nerg_mi.files.safe_read import read_bytes
from nerg_mi.progress import Progress, open_reporter
from nerg_mi.ranges import SECONDS, Range, check_ranges
from nerg_mi.threads import THREADS_VARIABLE, get_worker_threads, limit_threads

from .execution import MAX_ATTEMPTS, TaskResult, WarningCallback, run_task
from .store import ResultManifest, Store, read_contents
from .task import (
    FOLDER_SUFFIX,
    Checksums,
    InputFile,
    SharedContext,
    Task,
    compute_code_digest,
    compute_value_digest,
    relocate_paths,
)

MAX_LOSSES = 4
"""Number of workers of a cluster that may terminate while they run the same part before the job fails."""

MAX_WORKER_WAIT = 600.0
"""Seconds that a job waits by default without a suitable worker."""

MESSAGE_DELAY = 5.0
"""Seconds after which a message says what is waited for."""

POLL_INTERVAL = 1.0
"""Seconds between two looks at the workers of a cluster."""

FETCH_TIMEOUT = 30.0
"""Seconds to wait for the output of a part before it is checked that its worker still exists."""


class MissingInputFiles(Exception):
    """Some input files of a task do not exist at the planned paths on this machine."""


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

    Workers are checked when they connect; each runs as many tasks at a time as it has threads. If a worker dies, its
    tasks run on another one; failed tasks are retried. Raises `NergError` for an invalid address.

    Parameters
    ----------
    address
        tcp://HOST:PORT or tls://HOST:PORT.
    threads
        Maximum number of threads per worker; 0: all threads of the worker.
    timeout
        Seconds to wait for the scheduler.
    worker_wait
        Seconds to wait without a suitable worker.
    """

    def __init__(self, address: str, threads: int = 0, timeout: float = 10.0, worker_wait: float = MAX_WORKER_WAIT):
        check_address(address)
        make_security(address)
        self.address, self.threads, self.timeout, self.worker_wait = address, threads, timeout, worker_wait

    def run(
        self, shared: SharedContext, tasks: Sequence[Task], store: Store, warn: WarningCallback
    ) -> Generator[TaskResult]:
        if not tasks:
            return
        distributed = import_distributed()
        exposure = describe_exposure(self.address)
        if exposure is not None:
            warn(exposure)
        with _silence_dask(), self._connect(warn) as client:
            try:
                _check_scheduler(client)
                with closing(_Workers(client, shared.code_digest, self.worker_wait, warn)) as workers:
                    yield from _Dispatcher(client, shared, tasks, workers, self.threads).run(store)
            except (distributed.CancelledError, distributed.comm.CommClosedError, asyncio.CancelledError):
                raise NergError(
                    f"the scheduler at {self.address} has stopped; start a scheduler and the job again: completed "
                    "results are kept"
                ) from None

    def _connect(self, warn: WarningCallback) -> Any:
        distributed, security = import_distributed(), make_security(self.address)
        try:
            # In a thread, because this one may have an event loop, as in a notebook.
            with ThreadPoolExecutor(1) as pool:
                probe = pool.submit(asyncio.run, _probe_scheduler(self.address, self.timeout, security))
                if wait([probe], timeout=MESSAGE_DELAY).not_done:
                    warn(f"waiting for the scheduler at {self.address}, for at most {self.timeout:g} s")
                probe.result()
            with warnings.catch_warnings():
                # Dask's table of versions; `_check_scheduler` and `_Workers` report what matters.
                warnings.simplefilter("ignore")
                return distributed.Client(self.address, security=security, timeout=self.timeout, set_as_default=False)
        except OSError as error:
            raise NergError(
                f"no scheduler answers at {self.address} ({format_error(error)[:120]}); start one with dask "
                "scheduler, and start the job again: completed results are kept"
            ) from error


async def _probe_scheduler(address: str, timeout: float, security: Any) -> None:
    """Raise ``OSError`` unless a scheduler answers at ``address``.

    Dask itself waits without a limit for the answer of another program that listens there.
    """

    async def ask() -> str:
        async with import_distributed().rpc(
            address, timeout=timeout, connection_args=security.get_connection_args("client") if security else None
        ) as server:
            return (await server.identity())["type"]

    try:
        kind = await asyncio.wait_for(ask(), timeout)
    except (TimeoutError, asyncio.TimeoutError):
        raise OSError(f"no answer within {timeout:g} s") from None
    except OSError:
        raise
    except Exception as error:
        # The bytes of another program, read as those of a scheduler, cause errors of any type.
        raise OSError("another program answers there") from error
    if kind != "Scheduler":
        raise OSError(f"it is the address of a {kind.lower()}")


# ---- Suitable processes of a cluster ----


def _check_scheduler(client: Any) -> None:
    """Raise `NergError` unless the scheduler of ``client`` has the same libraries: it unpickles tasks, too."""

    async def find_fault() -> str:
        async def call() -> None:
            await client.run_on_scheduler(compute_code_digest)

        return await _find_fault(await client.scheduler.versions(), call)

    fault = client.sync(find_fault)
    if fault:
        raise NergError(
            f"the scheduler at {client.scheduler.address} cannot be used: {fault}; start dask scheduler in the same "
            "environment as the workers"
        )


async def _find_fault(versions: Mapping[str, Any], import_package: Callable[[], Awaitable[None]]) -> str:
    """Return why a process cannot handle parts; "" if it can.

    Parameters
    ----------
    versions
        Versions of the process, as Dask reports them.
    import_package
        Imports this package in the process.
    """
    local = import_distributed().versions.get_versions()
    pairs = [(name, versions["packages"].get(name), local["packages"][name]) for name in ("dask", "distributed")]
    python, local_python = (".".join(v["host"]["python"].split(".")[:2]) for v in (versions, local))
    pairs.append(("Python", python, local_python))
    differences = [f"{name} {theirs} instead of {mine}" for name, theirs, mine in pairs if theirs != mine]
    if differences:
        return f"it has {' and '.join(differences)}"
    try:
        await import_package()
    except OSError:
        raise
    except Exception as error:
        # Dask does not keep the type of an error that it meets while it unpickles.
        return f"it cannot import this version of nerg_mi ({format_error(error)})"
    return ""


class _Workers:
    """The workers of a cluster. Those that cannot run the parts of a job are named in a warning and not used.

    Attributes
    ----------
    threads
        Number of threads of each suitable worker, by address.
    """

    def __init__(self, client: Any, code_digest: str, max_wait: float, warn: WarningCallback):
        self.threads: dict[str, int] = {}
        self._client, self._code_digest, self._max_wait, self._warn = client, code_digest, max_wait, warn
        self._checks: dict[str, Future[str]] = {}
        self._faults: dict[str, str] = {}
        self._updated, self._last_suitable = -math.inf, time.monotonic()
        self._was_suitable = self._has_warned = False

    def close(self) -> None:
        for check in self._checks.values():
            check.cancel()

    def update(self) -> None:
        """Update ``threads`` if `POLL_INTERVAL` has passed. New workers are checked in the background.

        Raises `NergError` without a suitable worker for too long.
        """
        if time.monotonic() - self._updated < POLL_INTERVAL:
            return
        try:
            connected = self._client.sync(self._client.scheduler.ncores, callback_timeout=MESSAGE_DELAY)
        except (TimeoutError, asyncio.TimeoutError):
            if self._client.status != "running":
                raise asyncio.CancelledError from None
            self._check_wait("the scheduler does not answer")
            return
        finally:
            self._updated = time.monotonic()
        for address in self._checks.keys() - connected.keys():
            self._checks.pop(address).cancel()
            self._faults.pop(address, None)
        for address in connected:
            check = self._checks.get(address)
            if check is None or (check.done() and check.exception() is not None):
                # New, or the connection failed.
                find_fault = self._find_fault(address)
                self._checks[address] = asyncio.run_coroutine_threadsafe(find_fault, self._client.loop.asyncio_loop)
            elif check.done() and check.result() and address not in self._faults:
                self._faults[address] = check.result()
                self._warn(f"the worker {address} is not used: {check.result()}")
        checked = [address for address in connected if self._checks[address].done()]
        self.threads = {address: connected[address] for address in checked if address not in self._faults}
        if self.threads:
            self._last_suitable, self._was_suitable, self._has_warned = time.monotonic(), True, False
        elif len(checked) < len(connected):
            self._check_wait(f"{len(connected) - len(checked)} of {len(connected)} workers have not answered yet")
        elif connected:
            self._check_wait("none of the connected workers is suitable")
        else:
            self._check_wait("no worker is connected")

    async def _find_fault(self, address: str) -> str:
        """Return why the worker cannot run parts; "" if it can. Raises ``OSError`` if it does not answer."""

        async def call() -> None:
            digests.update(await self._client.run(compute_code_digest, workers=[address]))

        digests: dict[str, str] = {}
        versions = await self._client.scheduler.broadcast(msg={"op": "versions"}, workers=[address])
        fault = await _find_fault(versions[address], call)
        if not fault and digests[address] != self._code_digest:
            return f"it has another version of nerg_mi ({digests[address]} instead of {self._code_digest})"
        return fault

    def _check_wait(self, reason: str) -> None:
        """Report ``reason``, why there is no suitable worker, after a while; raise `NergError` after the limit."""
        waited, start = time.monotonic() - self._last_suitable, f'"nerg worker {self._client.scheduler.address}"'
        if waited >= MESSAGE_DELAY and len(self._faults) == len(self._checks) > 0 and not self._was_suitable:
            faults = "; ".join(f"{address}: {fault}" for address, fault in list(self._faults.items())[:10])
            raise NergError(
                f"no worker can run this job ({faults}); start workers with {start} in the environment of this nerg_mi"
            )
        if waited >= self._max_wait:
            raise NergError(
                f"{reason}, for {self._max_wait:g} s; start workers with {start}, and start the job again: completed "
                "results are kept"
            )
        if waited >= MESSAGE_DELAY and not self._has_warned:
            self._has_warned = True
            self._warn(f"waiting for workers, for at most {self._max_wait:g} s: {reason}; start workers with {start}")


class _Dispatcher:
    """Sends tasks to suitable workers, with their files after a worker has reported that it lacks them.

    The shared context and the files are Dask futures of one worker. A task is bound to its worker, because Dask would
    also choose unsuitable ones.
    """

    def __init__(self, client: Any, shared: SharedContext, tasks: Sequence[Task], workers: _Workers, threads: int):
        self._client, self._shared, self._workers, self._threads = client, shared, workers, threads
        self._pending, self._running = list(reversed(tasks)), dict[Any, tuple[Task, str]]()
        self._data: dict[tuple[str, str], Any] = {}
        self._without_files: set[str] = set()
        self._failures, self._losses = defaultdict[str, list[str]](list), defaultdict[str, list[str]](list)
        """Workers on which a task has failed, and workers that terminated while it was running, by key."""

    def run(self, store: Store) -> Generator[TaskResult]:
        """Run all tasks and store their outputs."""
        done: dict[Any, tuple[Task, str]] = {}
        while self._pending or self._running or done:
            self._workers.update()
            self._requeue_lost()
            # Workers continue while outputs are transferred.
            self._submit()
            for future, (task, address) in done.items():
                result = self._fetch(future, task, address)
                if result is not None:
                    manifest, content, worker = result
                    store.import_output(task, manifest, content)
                    yield TaskResult(task, manifest, worker)
            done = self._wait()

    def _submit(self) -> None:
        load = Counter(address for _, address in self._running.values())
        free = [address for address, count in self._workers.threads.items() if load[address] < count]
        while self._pending and free:
            task = self._pending.pop()
            # A task that failed on a worker prefers another one.
            address = min(free, key=lambda a: (a in self._failures[task.key], load[a]))
            self._running[self._send(task, address)] = task, address
            load[address] += 1
            if load[address] == self._workers.threads[address]:
                free.remove(address)

    def _send(self, task: Task, address: str) -> Any:
        files: dict[str, Any] = {}
        if address in self._without_files:
            for file in (*self._shared.files, *task.files):
                files[file.sha256] = self._store_on_worker(
                    address, file.sha256, lambda file=file: read_bytes(file.path, "input", file.size)
                )
        # Pickled here, so that the scheduler does not need the modules of a job.
        job = self._store_on_worker(address, "job", lambda: pickle.dumps(self._shared))
        call = _run_on_worker, job, pickle.dumps(task), files, self._threads
        return self._client.submit(*call, workers=[address], pure=False)

    def _store_on_worker(self, address: str, name: str, read: Callable[[], Any]) -> Any:
        if (address, name) not in self._data:
            with warnings.catch_warnings():
                # Suppress Dask's warning about large objects.
                warnings.simplefilter("ignore", UserWarning)
                future = self._client.submit(_identity, read(), workers=[address], pure=False)
            self._data[address, name] = future
        return self._data[address, name]

    def _wait(self) -> dict[Any, tuple[Task, str]]:
        """Wait up to `POLL_INTERVAL` for tasks, and return those that are done."""
        if not self._running:
            time.sleep(POLL_INTERVAL if self._pending else 0.0)
            return {}
        try:
            with self._client.as_current():
                done = import_distributed().wait(list(self._running), POLL_INTERVAL, "FIRST_COMPLETED").done
        except (TimeoutError, asyncio.TimeoutError):
            return {}
        return {future: self._running.pop(future) for future in done}

    def _fetch(
        self, future: Any, task: Task, address: str
    ) -> tuple[ResultManifest, list[tuple[str, bytes]], str] | None:
        """Return the result of a task that is done; None if the task is run again."""
        while True:
            try:
                return future.result(timeout=FETCH_TIMEOUT)
            except (TimeoutError, asyncio.TimeoutError):
                self._workers.update()
                if address not in self._workers.threads:
                    # The worker died with the output.
                    self._requeue(task, address)
                    return None
            except MissingInputFiles:
                self._without_files.add(address)
                self._pending.append(task)
                return None
            except import_distributed().KilledWorker:
                raise self._make_killed_error(task) from None
            except ImportError as error:
                raise NergError(
                    f"the worker {address} cannot run nerg_mi ({format_error(error)}); start workers with nerg worker, "
                    "in the same version"
                ) from error
            except (NergError, RuntimeError):
                self._failures[task.key].append(address)
                if len(self._failures[task.key]) >= MAX_ATTEMPTS:
                    raise
                self._pending.append(task)
                return None

    def _requeue_lost(self) -> None:
        for future, (task, address) in list(self._running.items()):
            if address not in self._workers.threads:
                del self._running[future]
                self._requeue(task, address)
        for address, name in list(self._data):
            if address not in self._workers.threads:
                del self._data[address, name]

    def _requeue(self, task: Task, address: str) -> None:
        self._losses[task.key].append(address)
        if len(self._losses[task.key]) >= MAX_LOSSES:
            raise self._make_killed_error(task)
        self._pending.append(task)

    def _make_killed_error(self, task: Task) -> NergError:
        return NergError(
            f"{task.label} was started by several workers, each of which terminated; run it locally to find the cause"
        )


def _identity(value: Any) -> Any:
    return value


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
_local_shared: list[tuple[bytes, SharedContext]] = []


def _run_on_worker(
    pickled_shared: bytes, pickled_task: bytes, files: Mapping[str, bytes], threads: int
) -> tuple[ResultManifest, list[tuple[str, bytes]], str]:
    """Run a task on this Dask worker.

    Returns the manifest, the files of the output, and the address of the worker. ``files`` maps the SHA-256 of input
    files to their bytes. Raises `MissingInputFiles` if files are missing.
    """
    worker = import_distributed().get_worker()
    scratch = Path(worker.local_directory)
    task: Task = pickle.loads(pickled_task)
    if not _local_shared or _local_shared[0][0] is not pickled_shared:
        shared: SharedContext = pickle.loads(pickled_shared)
        inputs, common = localize_inputs(shared.files, shared.common, files, scratch)
        _local_shared[:] = [(pickled_shared, replace(shared, files=inputs, common=common))]
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


@check_ranges
def run_worker(
    address: str,
    *,
    threads: Annotated[int, Range(0, 1024)] = 0,
    wait: Annotated[float, SECONDS] = 600.0,
    progress: Progress = None,
) -> None:
    """Run parts of jobs for a dask scheduler, one at a time, until the scheduler stops the worker or Ctrl-C is pressed.

    Start one worker per machine or GPU; it uses all of it. Jobs are sent there with --scheduler. The process of a
    worker that dies is started again.

    Parameters
    ----------
    address : str
        Address of the dask scheduler: tcp://HOST:PORT or tls://HOST:PORT.
    threads : int
        Number of CPU threads; 0: one per core.
    wait : float
        Time in seconds to wait for a scheduler that does not answer before the worker ends.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Raises
    ------
    NergError
        No scheduler answers.
    """
    if threads:
        os.environ[THREADS_VARIABLE] = str(threads)
    check_address(address)
    with open_reporter(progress) as reporter:
        warning = describe_exposure(address)
        if warning is not None:
            reporter.warn(warning)
        import_distributed()
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        try:
            asyncio.run(_serve_async(address, wait, reporter.message, make_security(address)))
        except asyncio.CancelledError:
            # The SIGTERM of a batch system stops the worker in the same way as Ctrl-C, including the cleanup.
            raise KeyboardInterrupt from None


async def _wait_for_scheduler(address: str, timeout: float, on_message: WarningCallback, security: Any) -> None:
    """Wait until a scheduler answers; raise ``OSError`` if none does within ``timeout`` seconds."""
    end, has_reported = time.monotonic() + timeout, False
    while True:
        left = end - time.monotonic()
        try:
            return await _probe_scheduler(address, max(min(MESSAGE_DELAY, left), 0.1), security)
        except OSError as error:
            if left <= 0:
                raise
            if not has_reported:
                on_message(
                    f"waiting for a scheduler at {address}, for at most {timeout:g} s: {format_error(error)[:120]}"
                )
                has_reported = True
        await asyncio.sleep(min(POLL_INTERVAL, max(left, 0.0)))


async def _serve_async(address: str, timeout: float, on_message: WarningCallback, security: Any) -> None:
    import dask.config

    serving = asyncio.current_task()
    assert serving is not None
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, serving.cancel)
    # The system limits the memory, this package controls the threads, and a dashboard would open another port.
    settings = {"nthreads": 1, "memory_limit": 0, "dashboard": False, "host": find_local_host(address)}
    settings |= {"dashboard_address": "127.0.0.1:0", "security": security, "death_timeout": timeout}
    settings |= {"silence_logs": logging.CRITICAL}
    with (
        dask.config.set({"distributed.nanny.pre-spawn-environ": {}}),
        tempfile.TemporaryDirectory(prefix="nerg-dask-") as scratch,
    ):
        try:
            await _wait_for_scheduler(address, timeout, on_message, security)
            async with import_distributed().Nanny(address, local_directory=scratch, **settings) as nanny:
                on_message(f"connected to {address}")
                await nanny.finished()
                on_message(f"{address} has stopped; start the worker again when a scheduler is running")
        except (asyncio.TimeoutError, OSError) as error:
            raise NergError(
                f"no scheduler answered at {address} within {timeout:g} s ({format_error(error)[:120]}); start one "
                "with dask scheduler, and start the worker again"
            ) from error
