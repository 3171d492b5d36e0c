"""Who runs the parts of a job: this process, processes of this machine, or the workers of a Dask cluster; and a plan
carried out, whose outputs are taken in its order whatever ran where."""

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

from nerg_mi.errors import NergError, is_user_error, format_error
from nerg_mi.files.atomic import make_folder, create_folder_atomically, write_bytes
from nerg_mi.files.safe_read import read_bytes
from nerg_mi.threads import set_thread_count, limit_threads, get_worker_threads

from .store import ResultManifest, Store, read_contents, make_manifest
from .task import FOLDER_SUFFIX, Checksums, InputFile, Plan, SharedContext, Task, compute_code_digest, compute_value_digest, relocate_paths

MAX_ATTEMPTS = 3
"""So often a part is begun that ends its process, before the job ends with a sentence that names it."""

WORKER_WAIT = 10.0
"""Seconds without any worker after which that is said."""

MAX_PENDING = 200
"""Parts that a cluster is asked for at a time, so that a long plan takes no memory there: more workers are idle."""

WarningCallback = Callable[[str], None]
"""Receives, in a sentence, what goes on differently than it should."""


@dataclass(frozen=True)
class TaskResult:
    """A ``task`` whose output is in the store, whole; ``where``: the process that made it ("" for this one)."""

    task: Task
    manifest: ResultManifest
    worker: str = ""


class Engine(Protocol):
    """Runs tasks and has their outputs in a store. ``run`` gives each as it is done, in any order; closing the
    generator gives up what was begun. A task that cannot be done raises an error that names it."""

    def run(self, shared: SharedContext, tasks: Sequence[Task], store: Store, warn: WarningCallback) -> Generator[TaskResult]: ...


def open_engine(name: str | None, threads: int = 0) -> Engine:
    """The engine ``name``: "local" or None is this process, "local:N" N processes of this machine, "tcp://HOST:PORT" or
    "tls://HOST:PORT" the workers of the Dask scheduler there. ``threads`` of each process but this one; 0: what there
    is. Raises `NergError` for another name, and ``ImportError`` where Dask is missing."""
    if name is None or name == "local":
        return LocalEngine()
    if match := re.fullmatch(r"local:(\d{1,6})", name):
        return ProcessEngine(int(match[1]), threads)
    if "://" not in name:
        raise NergError(
            f'there is no scheduler "{name}": give local, local:N for N processes, tcp://HOST:PORT or tls://HOST:PORT'
        )
    return ClusterEngine(name, threads)


# ---- One task ----


class ChangedInput(NergError):
    """A file has other bytes than when the job was planned: running the task again cannot help."""


class MissingInputFiles(Exception):
    """Some files of a task are not on this machine where they were planned."""


_prepared: list[tuple[Any, Any]] = []


def prepare_once(common: Any, factory: Callable[[], Any]) -> Any:
    """What ``make`` gives, made once for all parts that have ``common``; that of the last one is kept."""
    if not _prepared or _prepared[0][0] is not common:
        _prepared.clear()
        _prepared.append((common, factory()))
    return _prepared[0][1]


def run_task(shared: SharedContext, task: Task, output: Path, checksums: Checksums, threads: int = 0) -> ResultManifest:
    """Have ``task`` write ``output``. ``threads``: of the CPU, 0 for as many as are set.

    Raises `ChangedInput` where a file has other bytes than were planned with, before or after, and `NergError` where
    the job was planned by another version of this package. What the work raises comes with the part's label.
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
    # What was read may have been half of one version and half of another.
    _check_unchanged(files, checksums)
    return make_manifest(task, output, seconds, notes)


def _run_into(store: Store, shared: SharedContext, task: Task, checksums: Checksums, threads: int = 0) -> ResultManifest:
    with store.write_output(task) as output:
        receipt = run_task(shared, task, output, checksums, threads)
    store.add_manifest(receipt)
    return receipt


def _check_unchanged(files: Sequence[InputFile], checksums: Checksums) -> None:
    for file in files:
        if checksums.compute(file.path) != file.sha256:
            raise ChangedInput(
                f'"{file.path}" was changed while the job was running; start it again: what does not depend on this '
                "file is kept"
            )


class LocalEngine:
    """This process: one task after the other, in the thread that asks for it."""

    def run(self, shared: SharedContext, tasks: Sequence[Task], store: Store, warn: WarningCallback) -> Generator[TaskResult]:
        checksums = Checksums()
        for task in tasks:
            yield TaskResult(task, _run_into(store, shared, task, checksums))


# ---- Processes of this machine ----


@contextmanager
def process_pool(count: int, prepare: Callable[..., None], *arguments: Any) -> Iterator[ProcessPoolExecutor]:
    """``count`` processes that call ``prepare(*arguments)`` first. They end at once when the block does, and with this
    process, however that ends; Ctrl-C is for this process alone."""
    # Not forked: threads of libraries would be lost, and with them their locks.
    context = multiprocessing.get_context("spawn")
    listening, held = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(count, context, initializer=_begin, initargs=(listening, prepare, arguments))
    try:
        yield pool
    finally:
        held.close()
        pool.shutdown(wait=True, cancel_futures=True)


def _begin(listening: Any, prepare: Callable[..., None], arguments: Sequence[Any]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_parent() -> None:
        try:
            listening.recv()
        except EOFError:
            os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    prepare(*arguments)


POOL_ENDED_HINT = "if memory was short, use fewer processes; a script needs its own code below if __name__ == '__main__'"
"""What helps where a process of a pool was ended."""


class ProcessEngine:
    """``count`` processes of this machine, each of which runs one task at a time with so many ``threads``; 0: the cores
    are shared out among them.

    One process uses all cores for a picture or a training; more are for tasks that do not, and for memory that a task
    must give back.
    """

    def __init__(self, count: int, threads: int = 0):
        if not 1 <= count <= 1024:
            raise NergError(f"{count} worker processes are not possible; choose 1 to 1024")
        self.count = count
        self.threads = threads or max((os.cpu_count() or 1) // count, 1)

    def run(self, shared: SharedContext, tasks: Sequence[Task], store: Store, warn: WarningCallback) -> Generator[TaskResult]:
        waiting, begun = list(reversed(tasks)), Counter[str]()
        while waiting:
            running: dict[Future, Task] = {}
            try:
                with process_pool(min(self.count, len(waiting)), _set_job, shared, store.folder, self.threads) as pool:
                    while waiting or running:
                        while waiting and len(running) < self.count:
                            running[pool.submit(_make, waiting[-1])] = waiting[-1]
                            waiting.pop()
                        done = wait(running, return_when=FIRST_COMPLETED).done
                        for future in sorted(done, key=lambda f: isinstance(f.exception(), BrokenProcessPool)):
                            receipt, where = future.result()
                            yield TaskResult(running.pop(future), receipt, where)
            except BrokenProcessPool:
                # Which of them ended its process is not to be seen from here.
                lost = list(running.values()) or waiting[-1:]
                waiting += [task for task in running.values() if task not in waiting]
                begun.update(task.key for task in lost)
                names = " or ".join(task.label for task in lost)
                if max(begun[task.key] for task in lost) >= MAX_ATTEMPTS:
                    raise NergError(f"a process was ended at {names}, {MAX_ATTEMPTS} times; {POOL_ENDED_HINT}") from None
                warn(
                    f"a process was ended at {names}, perhaps because memory was short; what it had begun is run again"
                )


_job: list[tuple[SharedContext, Store, int, Checksums]] = []
"""That of this process of a pool."""


def _set_job(shared: SharedContext, folder: Path, threads: int) -> None:
    _job.append((shared, Store(folder), threads, Checksums()))


def _make(task: Task) -> tuple[ResultManifest, str]:
    shared, store, threads, checksums = _job[0]
    return _run_into(store, shared, task, checksums, threads), f"process {os.getpid()}"


# ---- A plan carried out ----


@dataclass
class PlanProgress:
    """How far a plan is: ``done`` of ``total`` tasks, ``reused`` of them from earlier runs; ``seconds`` since the first
    that was missing was begun, and the kinds of ``processors``."""

    total: int
    reused: int = 0
    done: int = 0
    seconds: float = 0.0
    processors: set[str] = field(default_factory=set)

    @property
    def fraction(self) -> float:
        """How much is done, from 0 to 1."""
        return self.done / self.total if self.total else 1.0

    @property
    def remaining_seconds(self) -> float | None:
        """Seconds until the end if the rest goes as fast as what was made in this run; None while nothing was."""
        made = self.done - self.reused
        return self.seconds * (self.total - self.done) / made if made else None

    def format_line(self, with_remaining: bool = True) -> str:
        """For a progress bar: parts done, how fast, and, if this is the ``whole`` job, how long it takes yet."""
        text = f"{self.done} of {self.total} parts"
        if self.remaining_seconds is None:
            return text
        rate = (self.done - self.reused) / max(self.seconds, 1e-9)
        text += f", {rate:.2g} a second" if rate >= 1 else f", {60 * rate:.2g} a minute"
        return f"{text}, {self.remaining_seconds:.0f} s left" if with_remaining else text


@dataclass(frozen=True)
class TaskOutput:
    """What a part has made: the file or folder ``path`` in the store, to be read only, and its ``notes``."""

    path: Path
    notes: Mapping[str, Any]


def run_plan(
    plan: Plan,
    store: Store,
    engine: Engine,
    on_progress: Callable[[PlanProgress], None] = lambda progress: None,
    warn: WarningCallback = lambda text: None,
) -> Iterator[TaskOutput]:
    """Gives the output of each part of ``plan``, in its order, as soon as it and all before it are there.

    What ``store`` holds whole is kept; what is missing or damaged is made by ``engine``. Outputs are combined in one
    order, whatever ran where: sums of floating-point numbers are equal to the bit. Raises `NergError` where a part
    cannot be done; what was done by then is kept, and the same plan goes on from there.
    """
    store.save_plan(plan)
    missing: dict[str, Task] = {}
    whole: set[str] = set()
    counts = Counter(task.key for task in plan.tasks)
    progress = PlanProgress(len(plan.tasks))
    for task in plan.tasks:
        if task.key in whole or task.key in missing:
            continue
        receipt = store.find_valid(task.key, task.suffix)
        if receipt is None:
            missing[task.key] = task
        else:
            whole.add(task.key)
            progress.processors.add(receipt.processor)
    progress.reused = progress.done = sum(counts[key] for key in whole)
    on_progress(progress)
    start = time.perf_counter()
    with closing(engine.run(plan.shared, list(missing.values()), store, warn)) as arriving:
        for task in plan.tasks:
            while task.key not in whole:
                done = next(arriving, None)
                if done is None:
                    raise RuntimeError(f"{task.label} was not run")
                whole.add(done.task.key)
                progress.done += counts[done.task.key]
                progress.seconds = time.perf_counter() - start
                before = len(progress.processors)
                progress.processors.add(done.manifest.processor)
                if before == 1 < len(progress.processors):
                    names = " and ".join(f'"{name}"' for name in sorted(progress.processors))
                    warn(f"parts are made on {names}; equal seeds give equal bytes on equal processors only")
                on_progress(progress)
            receipt = store.read_manifest(task.key)
            if receipt is None:
                raise NergError(f'{task.label} was removed from "{store.folder}" meanwhile; start the job again')
            yield TaskOutput(store.output_path(task.key, task.suffix), receipt.notes)


# ---- Dask ----

_ADDRESS = re.compile(r"(tcp|tls)://(\[[0-9a-fA-F:]+\]|[\w.-]+):(\d{1,5})")

TLS_HINT = (
    "tls:// needs certificates: set DASK_DISTRIBUTED__COMM__TLS__CA_FILE, and __CLIENT__CERT and __CLIENT__KEY "
    "(for workers __WORKER__CERT and __WORKER__KEY) in place of __CA_FILE, or write them into dask's configuration"
)


def import_distributed() -> ModuleType:
    """The module `distributed` of Dask. Raises ``ImportError``, in a sentence, where it is missing."""
    try:
        import distributed
    except ImportError:
        raise ImportError('a cluster needs dask, which is not installed: pip install "nerg-mi[cluster]"') from None
    return distributed


def check_address(address: str) -> None:
    """Raise `NergError` unless ``address`` is one of a scheduler: tcp://HOST:PORT or tls://HOST:PORT."""
    match = _ADDRESS.fullmatch(address)
    if match is None or not 0 < int(match[3]) < 65536:
        raise NergError(f'"{address}" is no address of a scheduler; write tcp://HOST:PORT or tls://HOST:PORT')


def describe_exposure(address: str) -> str | None:
    """The sentence of warning for an ``address`` that neither TLS nor this machine's bounds protect; else None."""
    match = _ADDRESS.fullmatch(address)
    if match is None or match[1] == "tls" or _is_loopback(match[2].strip("[]")):
        return None
    return (
        f"nothing protects {address}: anybody who reaches that port, or a worker's, can run code there and here; "
        "use tls://, or a tunnel to 127.0.0.1"
    )


def find_local_host(address: str) -> str:
    """The address of this machine by which the scheduler at ``address`` is reached: the only one where a worker
    listens."""
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
    """What Dask needs for ``address``: its configured certificates for tls://, else None. Raises `NergError` where
    there are none."""
    distributed = import_distributed()
    if not address.startswith("tls://"):
        return None
    security = distributed.Security(require_encryption=True)
    if not security.tls_ca_file:
        raise NergError(TLS_HINT)
    return security


class ClusterEngine:
    """The workers of the Dask scheduler at ``address``, each with ``threads`` at most; 0: with all that it has. Dask
    gives the part of a worker that died to another one, and runs one that failed again. ``patience``: seconds to wait
    for the scheduler. Raises `NergError` for an address that is none."""

    def __init__(self, address: str, threads: int = 0, timeout: float = 10.0):
        check_address(address)
        make_security(address)
        self.address, self.threads, self.timeout = address, threads, timeout

    def run(self, shared: SharedContext, tasks: Sequence[Task], store: Store, warn: WarningCallback) -> Generator[TaskResult]:
        if not tasks:
            return
        distributed = import_distributed()
        danger = describe_exposure(self.address)
        if danger is not None:
            warn(danger)
        with _quiet(), self._client() as client:
            try:
                _wait_for_worker(client, warn)
                sent, waiting, of = _Sent(client, shared), list(reversed(tasks)), dict[Any, Task]()
                running = distributed.as_completed(loop=client.loop)
                while waiting or of:
                    while waiting and len(of) < MAX_PENDING:
                        future = sent.submit(waiting[-1], self.threads)
                        of[future] = waiting.pop()
                        running.add(future)
                    future = next(running)
                    task = of.pop(future)
                    try:
                        receipt, content, where = future.result()
                    except MissingInputFiles:
                        sent.with_files = True
                        waiting.append(task)
                        continue
                    except distributed.KilledWorker:
                        raise NergError(
                            f"{task.label} was begun by several workers, and each of them ended; run it alone to see "
                            "why"
                        ) from None
                    except ImportError as error:
                        raise NergError(
                            f"a worker cannot run nerg_mi ({format_error(error)}); start workers with nerg worker, of the "
                            "same version"
                        ) from error
                    store.import_output(task, receipt, content)
                    yield TaskResult(task, receipt, where)
            except (distributed.CancelledError, distributed.comm.CommClosedError, asyncio.CancelledError):
                raise NergError(
                    f"the scheduler at {self.address} is gone; start one, and the job again: what is done is kept"
                ) from None

    def _client(self) -> Any:
        distributed = import_distributed()
        try:
            return distributed.Client(
                self.address, security=make_security(self.address), timeout=self.timeout, set_as_default=False
            )
        except OSError as error:
            raise NergError(
                f"no scheduler answers at {self.address} ({format_error(error)[:120]}); start one with dask scheduler, and "
                "the job again: what is done is kept"
            ) from error


class _Sent:
    """What tasks are asked for with: the job, and its files once a worker was seen that has not got them. Both are
    results of tasks of Dask's, which it makes again where the worker that holds them died."""

    def __init__(self, client: Any, shared: SharedContext):
        self.client, self.with_files = client, False
        self._held: dict[str, Any] = {}
        self._shared = shared
        self._job = self._hold("job", shared)
        # Tasks go where what they need is: to all workers, and not to the one that has it first.
        client.replicate([self._job])

    def submit(self, task: Task, threads: int) -> Any:
        """The future of `_perform` for ``task``."""
        files: dict[str, Any] = {}
        if self.with_files:
            for file in (*self._shared.files, *task.files):
                files[file.sha256] = self._hold(
                    file.sha256, lambda file=file: read_bytes(file.path, "input", file.size)
                )
        return self.client.submit(_perform, self._job, task, files, threads, pure=False, retries=MAX_ATTEMPTS - 1)

    def _hold(self, name: str, value: Any) -> Any:
        if name not in self._held:
            with warnings.catch_warnings():
                # That it is large is no mistake.
                warnings.simplefilter("ignore", UserWarning)
                self._held[name] = self.client.submit(_same, value() if callable(value) else value, pure=False)
        return self._held[name]


def _same(value: Any) -> Any:
    return value


def _wait_for_worker(client: Any, warn: WarningCallback) -> None:
    try:
        client.wait_for_workers(1, timeout=WORKER_WAIT)
    except TimeoutError:
        warn(f'no worker is there; start some with "nerg worker {client.scheduler.address}"')


@contextmanager
def _quiet() -> Iterator[None]:
    """What Dask logs of connections is said in sentences of ours."""
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before):
            logger.setLevel(level)


# ---- What runs on a worker of Dask's ----

_checksums = Checksums()
_here: list[tuple[SharedContext, SharedContext]] = []


def _perform(
    shared: SharedContext, task: Task, files: Mapping[str, bytes], threads: int
) -> tuple[ResultManifest, list[tuple[str, bytes]], str]:
    """The receipt and the files of a task's output, and the address of this worker. ``files``: bytes by their SHA-256.
    Raises `FilesElsewhere` where some are missing."""
    worker = import_distributed().get_worker()
    scratch = Path(worker.local_directory)
    if not _here or _here[0][0] is not shared:
        inputs, common = localize_inputs(shared.files, shared.common, files, scratch)
        _here[:] = [(shared, replace(shared, files=inputs, common=common))]
    inputs, value = localize_inputs(task.files, task.value, files, scratch)
    task = replace(task, files=inputs, value=value)
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        output = Path(folder, f"output{task.suffix.rstrip(FOLDER_SUFFIX)}")
        if task.suffix == FOLDER_SUFFIX:
            make_folder(output)
        try:
            receipt = run_task(_here[0][1], task, output, _checksums, limit_threads(get_worker_threads(), threads))
        except RuntimeError as error:
            # A cause is not sent, and without it nobody finds the mistake.
            raise RuntimeError(f"{error}\n{traceback.format_exc()}") from None
        return receipt, read_contents(output), worker.address


def localize_inputs(
    inputs: tuple[InputFile, ...], value: Any, files: Mapping[str, bytes], scratch: Path
) -> tuple[tuple[InputFile, ...], Any]:
    """``inputs`` and ``value`` with paths as they are on this machine: where they were planned, if the same bytes lie
    there, or laid out alike below ``scratch``."""
    if all(_checksums.is_unchanged(file) for file in inputs):
        return inputs, value
    if not all(file.sha256 in files for file in inputs):
        raise MissingInputFiles
    folder = scratch / f"nerg-{compute_value_digest([[file.name, file.sha256] for file in inputs])[:32]}"
    if not folder.exists():
        with create_folder_atomically(folder) as temporary:
            for file in inputs:
                write_bytes(temporary / file.name, files[file.sha256])
    here = tuple(replace(file, path=str(folder / file.name)) for file in inputs)
    return here, relocate_paths(value, inputs, folder)


def run_dask_worker(address: str, timeout: float, on_message: WarningCallback, name: str | None = None) -> None:
    """Be a worker of the Dask scheduler at ``address`` until that ends it, or Ctrl-C does: one of Dask's, with one
    thread, whose process is started again where it died.

    ``patience``: seconds to wait for a scheduler; ``tell`` hears of that. ``name``: by which the scheduler knows it,
    which no other may have. Raises `NergError` where none came.
    """
    check_address(address)
    import_distributed()
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        asyncio.run(_serve(address, timeout, on_message, name, make_security(address)))
    except asyncio.CancelledError:
        # A batch system's SIGTERM ends it as Ctrl-C does, with nothing left behind.
        raise KeyboardInterrupt from None


async def _serve(address: str, patience: float, tell: WarningCallback, name: str | None, security: Any) -> None:
    import dask.config

    serving = asyncio.current_task()
    assert serving is not None
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, serving.cancel)
    # Memory is bounded by the system; a dashboard would be one more open port, and threads are counted by us.
    settings = {"nthreads": 1, "memory_limit": 0, "dashboard": False, "host": find_local_host(address), "name": name}
    settings |= {"dashboard_address": "127.0.0.1:0", "security": security, "death_timeout": patience}
    settings |= {"silence_logs": logging.CRITICAL}
    with (
        dask.config.set({"distributed.nanny.pre-spawn-environ": {}}),
        tempfile.TemporaryDirectory(prefix="nerg-dask-") as scratch,
    ):
        try:
            async with import_distributed().Nanny(address, local_directory=scratch, **settings) as nanny:
                tell(f"works for {address}")
                await nanny.finished()
                tell(f"{address} is gone; start the worker again once there is a scheduler")
        except (asyncio.TimeoutError, OSError) as error:
            raise NergError(
                f"no scheduler has answered at {address} for {patience:g} s; start one with dask scheduler, and the "
                "worker again"
            ) from error
