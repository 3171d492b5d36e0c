"""Readers as the fuzzer sees them, cases in a warm child process that may crash or hang, and the corpus."""

from __future__ import annotations

import base64
import hashlib
import importlib.util
import json
import os
import select
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

# ---- What a reader is to the fuzzer ----


@dataclass(frozen=True)
class Reader:
    """``make`` writes a small valid input into an empty folder; ``read`` reads that folder and uses what it gets.

    ``targets``: the files in it that are damaged, by name, each with the kinds of structure that damage may keep, of
    "json", "text", "zip", "gzip", "npy", "safetensors", "png", "boxes" (of MP4); bytes are damaged in any case. Both
    functions import what they need themselves. ``needs``: a package that may be missing, without which there is no
    such reader. ``is_command``: it runs a command, which may write files and load what it needs.
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


# ---- Runs cases in a warm child process, and sees it crash or hang ----


ROOT = Path(__file__).resolve().parents[2]
BREACHES = ("other exception", "crash", "hang", "executed", "left a file", "memory", "slow", "no sentence")
# A case has 5 s of the processor's time; the machine may be busy, and a hang is a hang.
_PATIENCE = 60.0
SPECIAL = ("fifo", "/dev/zero", "/dev/null", "folder", "missing", "loop", "sparse")
"""What may stand at a path in place of a regular file: itself, or a link to it."""


@dataclass(frozen=True)
class Case:
    """``data``: the bytes of the file ``target`` of the reader ``reader``, or ``special``: one of `SPECIAL` instead, of
    which "sparse" begins with ``data`` and goes on with zeros."""

    reader: str
    target: str
    data: bytes
    special: str = ""


@dataclass(frozen=True)
class Report:
    """``outcome``: result, refusal, or one of `BREACHES`; ``said``: the sentence, or what went wrong; ``seconds``: of
    the processor; ``memory``: bytes more at the peak than before."""

    outcome: str
    said: str = ""
    seconds: float = 0.0
    memory: int = 0


class Child:
    """One process; ``inputs``: folder of the valid inputs by reader; ``names``: of the readers that it will be asked
    for.
    """

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
        first = self._line()
        if not first or not json.loads(first).get("ready"):
            self.close()
            raise RuntimeError(f"the child did not start: {self.last_words()}")

    def _line(self) -> bytes | None:
        """The next line; None when none comes, "" when the process has ended."""
        # Twice: where the machine stood still, the first wait is over before the child has had its time.
        for _ in range(2):
            if select.select([self._process.stdout], [], [], _PATIENCE)[0]:
                return self._process.stdout.readline()
        return None

    def last_words(self) -> str:
        self._errors.seek(0)
        return self._errors.read().decode(errors="replace")[-2000:]

    def run(self, case: Case) -> Report:
        """The outcome of ``case``; after a crash or a hang the child is of no more use."""
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
    """Each case with its report; ``names``: of the readers, which the module's ``READERS`` holds."""
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


# ---- The corpus: cases that once broke the contract, and some made by hand, which the tests replay ----


CORPUS = Path(__file__).with_name("corpus")


def kept(case: Case) -> str:
    """Name of the file in the corpus that holds ``case``; of one without data, what stands in its place."""
    return f"{_prefix(case.reader, case.target)}-{case.special or hashlib.sha256(case.data).hexdigest()[:12]}"


def _prefix(reader: str, target: str) -> str:
    return f"{reader}-{target}".replace("/", "_").replace(" ", "_")


def corpus(readers: list[Reader]) -> list[Case]:
    """All cases that are kept. Raises `KeyError` for a file of a reader that there is not."""
    known = {_prefix(r.name, t): (r.name, t) for r in readers for t in r.targets}
    return [Case(*known[p.name.rsplit("-", 1)[0]], p.read_bytes()) for p in sorted(CORPUS.iterdir())]
