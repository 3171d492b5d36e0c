"""Clusters of real processes on this machine: a scheduler and workers that tests kill and restart."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

from tests.conftest import ROOT

DEADLINE = 90.0
"""Seconds that anything here may take on a busy machine."""


def free_port() -> int:
    """Return a port of 127.0.0.1 on which no process listens."""
    with socket.socket() as port:
        port.bind(("127.0.0.1", 0))
        return port.getsockname()[1]


class ClusterOfProcesses:
    """A context with a scheduler at ``address`` and workers, which are terminated at its end. ``folder``: for
    their logs.
    """

    def __init__(self, folder: Path):
        self.folder, self.port = folder, free_port()
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.scheduler: subprocess.Popen | None = None
        self.workers: list[subprocess.Popen] = []

    def __enter__(self) -> ClusterOfProcesses:
        self.start_scheduler()
        return self

    def start_scheduler(self) -> None:
        code = "from distributed.cli.dask_scheduler import main; main()"
        where = ("--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard")
        self.scheduler = self._start("scheduler", "-c", code, *where)
        until = time.monotonic() + DEADLINE
        while time.monotonic() < until:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.1)
        raise TimeoutError("the scheduler did not start")

    def start_worker(self) -> subprocess.Popen:
        """Start another worker with `nerg worker`; it may not be connected yet when this returns."""
        code = "from nerg_mi.cli import main; main()"
        number = len(self.workers)
        line = ("-c", code, "worker", self.address, "--threads", "1")
        self.workers.append(self._start(f"worker{number}", *line))
        return self.workers[-1]

    def start_plain_worker(self, prelude: str) -> subprocess.Popen:
        """Start a worker with `dask worker` in a process that first runs the code ``prelude``."""
        code = f"{prelude}\nfrom distributed.cli.dask_worker import main; main()"
        line = ("-c", code, self.address, "--host", "127.0.0.1", "--nthreads", "1", "--no-nanny", "--no-dashboard")
        self.workers.append(self._start(f"worker{len(self.workers)}", *line))
        return self.workers[-1]

    def kill_scheduler(self) -> None:
        assert self.scheduler is not None
        self.scheduler.kill()
        self.scheduler.wait()

    def log(self, name: str) -> str:
        """Return the log of the scheduler or a worker."""
        return (self.folder / f"{name}.log").read_text()

    def _start(self, name: str, *line: str) -> subprocess.Popen:
        with (self.folder / f"{name}.log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, *line],
                stdout=log,
                stderr=log,
                stdin=subprocess.DEVNULL,
                cwd=self.folder,
                env={**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(self.folder)},
            )

    def __exit__(self, *error) -> None:
        for process in [*self.workers, self.scheduler]:
            if process is not None and process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
                process.wait()


def wait_until(condition, what: str) -> None:
    """Wait until ``condition()`` is true; fail the test after `DEADLINE`."""
    until = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < until, what
        time.sleep(0.05)
