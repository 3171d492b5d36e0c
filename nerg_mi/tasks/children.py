"""Processes of one's own that run tasks (`child`), from the side of whoever asks them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.threads import VARIABLE

from .receipt import Receipt
from .task import Task

SECONDS_TO_END = 2.0
"""So long a child may take to end by itself."""


class ChildDied(Exception):
    """The process ended while it ran a task; the message says how."""


class TaskFailed(Exception):
    """The task raised an error; the message is a sentence, ``trace`` where it arose. ``final``: it would again, here or
    elsewhere; ``mendable``: it is the user's to mend, and no mistake of the program."""

    def __init__(self, text: str, trace: str, final: bool, mendable: bool):
        super().__init__(text)
        self.trace, self.final, self.mendable = trace, final, mendable


class Child:
    """A process that runs one task after the other, begun when the first is asked for, and anew after it died.

    ``threads``: of the CPU that it computes with; 0: all. May be asked from several threads, one of which it serves at
    a time.
    """

    def __init__(self, threads: int = 0):
        self._threads = threads
        self._process: subprocess.Popen[str] | None = None
        self._lock = threading.Lock()

    def make(self, task: Task, paths: Mapping[str, str], store: Path, threads: int = 0) -> Receipt:
        """Have ``task`` run on the files ``paths`` by name, its output put into ``store``; with ``threads`` at most,
        where they are fewer than the process has. Raises `ChildDied` and `TaskFailed`."""
        with self._lock:
            process = self._started()
            request = {"task": task.document(), "paths": dict(paths), "store": str(store), "threads": threads}
            assert process.stdin is not None and process.stdout is not None
            try:
                process.stdin.write(json.dumps(request) + "\n")
                process.stdin.flush()
                line = process.stdout.readline()
            except OSError:
                line = ""
            if not line:
                raise ChildDied(self._buried())
        found = json.loads(line)
        if "error" in found:
            kind = found["kind"]
            raise TaskFailed(found["error"], found["trace"], kind == "final", kind != "fault")
        return Receipt(**found["receipt"])

    def close(self) -> None:
        """End the process, whatever it does; what it has not finished is not in the store."""
        process, self._process = self._process, None
        if process is None:
            return
        if process.stdin is not None:
            try:
                process.stdin.close()
            except OSError:
                pass  # it had ended before
        try:
            process.wait(SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()

    @property
    def pid(self) -> int | None:
        """Of the process, where there is one."""
        return None if self._process is None else self._process.pid

    def _started(self) -> subprocess.Popen[str]:
        if self._process is None or self._process.poll() is not None:
            environment = dict(os.environ)
            if self._threads:
                environment[VARIABLE] = str(self._threads)
            # Out of reach of the terminal's Ctrl-C, which is heard by whoever asks.
            self._process = subprocess.Popen(
                [sys.executable, "-m", "nerg_mi.tasks.child"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                encoding="utf-8",
                env=environment,
                start_new_session=True,
            )
        return self._process

    def _buried(self) -> str:
        """How the process ended."""
        process = self._process
        self._process = None
        code = process.wait() if process is not None else 0
        if code < 0:
            name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
            memory = ", as the system does where memory is short" if name == "SIGKILL" else ""
            return f"it was ended by {name}{memory}"
        return f"it ended with exit code {code}"


def failure(task: Task, error: TaskFailed) -> Exception:
    """What the job ends with because of ``error``: the sentence that one machine would have said."""
    if error.mendable:
        return NergError(str(error))
    return RuntimeError(f"{task.label}: {error}\n{error.trace}")
