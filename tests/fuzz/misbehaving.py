"""Readers that break the contract, each named by its breach, to test that breaches are detected."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import time
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from tests.fuzz.watch import Reader


def _make(folder: Path) -> None:
    (folder / "a.bin").write_bytes(b"sound")


def _reader(name: str, does) -> Reader:
    def read(folder: Path) -> object:
        return does(folder) if (folder / "a.bin").read_bytes() != b"sound" else None

    return Reader(name, _make, {"a.bin": ()}, read)


def _raise(error: Exception):
    raise error


def _swallowed(what) -> None:
    """Ignore an exception, as a careless reader does."""
    try:
        what()
    except Exception:
        pass


def _busy() -> None:
    until = time.thread_time() + 5.2
    while time.thread_time() < until:
        pass


class _Canary:
    def __reduce__(self):
        return os.system, ("true",)


READERS = [
    _reader("result", lambda folder: 1),
    _reader("refusal", lambda folder: _raise(NergError('the file "a.bin" cannot be read; copy it again'))),
    _reader("no sentence", lambda folder: _raise(NergError("two\nlines of it"))),
    _reader("other exception", lambda folder: _raise(KeyError("frames"))),
    _reader("other exception: exit", lambda folder: _raise(SystemExit(1))),
    _reader("executed: shell", lambda folder: _swallowed(lambda: os.system("true"))),
    _reader("executed: process", lambda folder: _swallowed(lambda: subprocess.run(["true"]))),
    _reader("executed: pickle", lambda folder: _swallowed(lambda: pickle.loads(pickle.dumps(_Canary())))),
    _reader("executed: code", lambda folder: _swallowed(lambda: exec("1"))),
    _reader("executed: writing", lambda folder: _swallowed(lambda: (folder / "b.part").write_bytes(b"half"))),
    _reader("memory", lambda folder: np.ones(1200 << 20, np.uint8).sum()),
    _reader(
        "memory: refused",
        lambda folder: _raise(NergError("the file cannot be read: it needs more memory than is available")),
    ),
    _reader("slow", lambda folder: _busy()),
    _reader("crash", lambda folder: signal.raise_signal(signal.SIGSEGV)),
    _reader("result: after a crash", lambda folder: 1),
]
