"""Readers for the fuzzer, cases in a warm child process that may crash or hang, and the corpus."""

from __future__ import annotations

import base64
import hashlib
import importlib.util
import json
import os
import re
import select
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

# ---- Readers ----


@dataclass(frozen=True)
class Reader:
    """A reader. ``make`` writes a small valid input into an empty folder; ``read`` reads that folder and uses the
    result.

    ``targets``: names of the files that are damaged, each with the kinds of structure that damage may preserve: "json",
    "text", "zip", "gzip", "npy", "safetensors", "png", "boxes" (of MP4). Bytes are always damaged, too. Both functions
    import their modules themselves. ``needs``: an optional package; without it, the reader is skipped. ``is_command``:
    it runs a command, which may write files and import modules.
    """

    name: str
    make: Callable[[Path], None]
    targets: dict[str, tuple[str, ...]]
    read: Callable[[Path], object]
    needs: str | None = None
    is_command: bool = False

    @property
    def installed(self) -> bool:
        return self.needs is None or importlib.util.find_spec(self.needs) is not None


# ---- Cases run in a warm child process; crashes and hangs are detected ----


ROOT = Path(__file__).resolve().parents[2]
BREACHES = ("other exception", "crash", "hang", "executed", "left a file", "memory", "slow", "no sentence")
# A case has 5 s of processor time. The wall-clock limit is longer, because the machine may be busy.
_PATIENCE = 120.0
PYTHON_WORDS = re.compile(
    r"index out of|object has no|not subscriptable|not iterable|not callable|NoneType|Error\b|could not convert s|"
    r"invalid literal|unpack|inhomogeneous|unhashable|must be real number|unsupported operand|not supported between"
)
"""What Python, and no sentence for a user, says about a value of another type or size."""

SPECIAL = ("fifo", "/dev/zero", "/dev/null", "folder", "missing", "loop", "sparse")
"""What may stand at a path in place of a regular file: itself, or a link to it."""


@dataclass(frozen=True)
class Case:
    """A case. ``data``: the bytes of the file ``target`` of the reader ``reader``. ``special``: one of `SPECIAL`
    instead; for "sparse", the file starts with ``data`` and continues with zeros.
    """

    reader: str
    target: str
    data: bytes
    special: str = ""


@dataclass(frozen=True)
class Report:
    """Outcome of a case. ``outcome``: result, refusal, or one of `BREACHES`; ``said``: the message, or what went wrong;
    ``seconds``: processor time; ``memory``: increase of the peak memory in bytes.
    """

    outcome: str
    said: str = ""
    seconds: float = 0.0
    memory: int = 0


class Child:
    """A child process. ``inputs``: folder of the valid inputs by reader; ``names``: names of its readers."""

    def __init__(self, inputs: Path, names: list[str], module: str):
        self._room = tempfile.TemporaryDirectory(prefix="nerg-fuzz-")
        self._errors = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.child", str(inputs), self._room.name, module, *names],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        # The child compiles the kernels of all commands first.
        first = self._line(waits=20)
        if not first or not json.loads(first).get("ready"):
            self.close()
            raise RuntimeError(f"the child did not start: {self.last_words()}")

    def _line(self, waits: int = 2) -> bytes | None:
        """Return the next line; None if none arrives in time, "" if the process has ended."""
        # Waits twice: if the machine was suspended, the first wait ends before the child has had its time.
        for _ in range(waits):
            if select.select([self._process.stdout], [], [], _PATIENCE)[0]:
                return self._process.stdout.readline()
        return None

    def last_words(self) -> str:
        self._errors.seek(0)
        return self._errors.read().decode(errors="replace")[-2000:]

    def run(self, case: Case) -> Report:
        """Run ``case`` and return its outcome. After a crash or a hang, the child cannot be used again."""
        document = {"reader": case.reader, "target": case.target, "special": case.special}
        document["data"] = base64.b64encode(case.data).decode()
        try:
            self._process.stdin.write(json.dumps(document).encode() + b"\n")
            self._process.stdin.flush()
            line = self._line()
        except BrokenPipeError:
            line = b""
        if line is None:
            return Report("hang", f"no answer in {2 * _PATIENCE:.0f} s")
        if not line:
            return Report("crash", f"the process ended with {self._process.wait()}: {self.last_words()[-300:]}")
        return Report(**json.loads(line))

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        self._process.stdin.close()
        self._process.stdout.close()
        self._room.cleanup()


def run_cases(
    cases: Iterable[Case], inputs: Path, names: list[str], module: str = "tests.fuzz.readers"
) -> Iterator[tuple[Case, Report]]:
    """Run the cases and yield each with its report. ``names``: names of readers in the module's ``READERS``."""
    child = None
    try:
        for case in cases:
            child = child or Child(inputs, names, module)
            report = child.run(case)
            yield case, report
            if report.outcome in ("crash", "hang"):
                child.close()
                child = None
    finally:
        if child is not None:
            child.close()


# ---- The corpus: cases that once broke the contract, and handmade ones; the tests replay them ----


CORPUS = Path(__file__).with_name("corpus")


def corpus_name(case: Case) -> str:
    """Return the name of the file in the corpus that contains ``case``; for a case without data, the content of
    the file.
    """
    return f"{_prefix(case.reader, case.target)}-{case.special or hashlib.sha256(case.data).hexdigest()[:12]}"


def _prefix(reader: str, target: str) -> str:
    return f"{reader}-{target}".replace("/", "_").replace(" ", "_")


def corpus(readers: list[Reader]) -> list[Case]:
    """Return all cases of the corpus. Raises `KeyError` for a file of an unknown reader."""
    names = {_prefix(r.name, t): (r.name, t) for r in readers for t in r.targets}
    return [Case(*names[p.name.rsplit("-", 1)[0]], p.read_bytes()) for p in sorted(CORPUS.iterdir())]
