"""Small tasks that the tests of the engine run, in processes of their own as well."""

from __future__ import annotations

import hashlib
import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import write_text
from nerg_mi.tasks.inputs import read_input
from nerg_mi.tasks.task import Task
from nerg_mi.threads import threads_of_worker


def hashed(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> None:
    """A line of parameters and inputs, after ``seconds``; it dies where the file ``die`` is, which it takes along.
    Each run is noted in the folder ``runs``."""
    if runs := parameters.get("runs"):
        Path(runs, f"{parameters['number']}-{os.getpid()}-{time.time_ns()}").touch()
    die = parameters.get("die")
    if die and Path(die).exists():
        Path(die).unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(parameters.get("seconds", 0))
    text = "".join(f"{name} {path.read_text()}" for name, path in sorted(inputs.items()))
    if parameters.get("prints"):
        print("what tasks print is in nobody's way")
    write_text(output, hashlib.sha256(f"{parameters['number']} {text}".encode()).hexdigest() + "\n")


def folder(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> None:
    """Two files, one of them in a folder."""
    write_text(output / "a.txt", f"{parameters['number']}\n")
    write_text(output / "below" / "b.txt", "b\n")


def refused(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> None:
    raise NergError("the scene has no light; give it one")


def mistaken(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> None:
    raise TypeError("a mistake of the program")


def deadly(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> None:
    write_text(output, "half of")
    os.kill(os.getpid(), signal.SIGKILL)


def tasks(count: int, files: Mapping[str, Path] = {}, **parameters: Any) -> list[Task]:
    """So many of `hashed`, of which each reads all ``files``."""
    inputs = tuple(read_input(name, path) for name, path in files.items())
    return [
        Task(f"{__name__}:hashed", {"number": k, **parameters}, inputs, ".txt", label=f"part {k}") for k in range(count)
    ]


def expected(number: int, files: Mapping[str, Path] = {}) -> bytes:
    """What `hashed` writes."""
    text = "".join(f"{name} {path.read_text()}" for name, path in sorted(files.items()))
    return (hashlib.sha256(f"{number} {text}".encode()).hexdigest() + "\n").encode()


def runs_of(folder: Path) -> dict[int, int]:
    """How often each part was run."""
    found: dict[int, int] = {}
    for path in folder.iterdir():
        number = int(path.name.partition("-")[0])
        found[number] = found.get(number, 0) + 1
    return found


def term(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> dict[str, float]:
    """A number whose sums depend on their order, as a note."""
    write_text(output, "")
    return {"term": 10.0 ** (parameters["number"] % 17) / 3 * (-1) ** parameters["number"]}


def changes(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> None:
    """Reads a file that changes meanwhile."""
    write_text(output, inputs["a"].read_text())
    inputs["a"].write_text("in between")


def threads(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> None:
    """How many threads this process may compute with."""
    write_text(output, str(threads_of_worker()))
