"""`nerg` in processes that are killed, run as somebody else, or write to a disk that is full."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

from tools.whole_files import part

_LIMIT = 900.0
_NOBODY = 65534


def start(arguments: list[str], log: Path, before=lambda: None) -> int:
    """Begin `nerg` with ``arguments`` in a process of its own, which does ``before()`` first; returns its id.

    It is forked from this one, which has the modules loaded and has not begun anything with them.
    """
    pid = os.fork()
    if pid:
        return pid
    code = 70
    try:
        with open(log, "wb") as out, open(os.devnull, "rb") as nothing:
            for target, stream in ((0, nothing), (1, out), (2, out)):
                os.dup2(stream.fileno(), target)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        from nerg_mi import cli

        before()
        # A column map has spaces in it.
        cli.main([a.replace("~", " ") for a in arguments])
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def wait(pid: int, limit: float = _LIMIT) -> int:
    """Exit code of the process ``pid``, negative for the signal that ended it; it is killed after ``limit`` seconds."""
    end = time.monotonic() + limit
    while time.monotonic() < end:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    raise TimeoutError(f"no end after {limit:.0f} s")


def kill_at(pid: int, seconds: float) -> int:
    """Kill ``pid`` after ``seconds`` unless it has ended; its exit code."""
    with contextlib.suppress(TimeoutError):
        return wait(pid, seconds)
    return -signal.SIGKILL


def kill_while_writing(pid: int, folder: Path, turn: random.Random, skip: int) -> int:
    """Kill ``pid`` within the ``skip``-th write after this, or a few milliseconds later; its exit code."""
    there, seen = set(filter(part, folder.rglob("*"))), 0
    end = time.monotonic() + _LIMIT
    while time.monotonic() < end:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        new = set(filter(part, folder.rglob("*"))) - there
        there |= new
        seen += len(new)
        if seen > skip:
            return kill_at(pid, turn.choice((0, 0.001, 0.003, 0.01)))
        time.sleep(0.0005)
    return kill_at(pid, 0)


@contextlib.contextmanager
def small_disk(folder: Path):
    """``folder`` as a disk of its own with 4 KiB of room (a tmpfs, which only root can mount), with a file "filler"."""
    folder.mkdir(exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256m", "tmpfs", folder], check=True, capture_output=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


def fill(folder: Path) -> None:
    """Leave 4 KiB of room on the disk of ``folder``."""
    with open(folder / "filler", "wb", buffering=0) as out:
        with contextlib.suppress(OSError):
            while out.write(b"\0" * 4096):
                pass
        out.truncate(out.tell() - 4096)


def become_nobody() -> None:
    """Give up root for good, but not the right to read: the interpreter may lie in root's own folder."""
    import ctypes

    libc = ctypes.CDLL(None, use_errno=True)
    keep, read = 8, 1 << 2  # PR_SET_KEEPCAPS, CAP_DAC_READ_SEARCH
    os.setgroups([])
    os.setgid(_NOBODY)
    libc.prctl(keep, 1, 0, 0, 0)
    os.setuid(_NOBODY)
    header, sets = struct.pack("<Ii", 0x20080522, 0), struct.pack("<6I", read, read, 0, 0, 0, 0)
    if libc.capset(header, sets) != 0:
        raise OSError(ctypes.get_errno(), "capset")
