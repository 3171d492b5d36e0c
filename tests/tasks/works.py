"""Small parts for the tests of the engines, which also run in other processes."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import write_text
from nerg_mi.options import option
from nerg_mi.ranges import ValidatedDataclass
from nerg_mi.tasks.task import FOLDER_SUFFIX, Checksums, Part, Plan, find_inputs, relocate_paths


@dataclass(frozen=True, kw_only=True)
class Settings(ValidatedDataclass):
    """Settings of `write_hash`: its input files, and how it runs."""

    files: tuple[Path, ...] = ()
    seconds: float = option(0.0, "Seconds that a part takes.", changes_result=False)
    letters: str = "abc"


@dataclass(frozen=True)
class Run:
    """Side effects of a part: record the run in the folder ``runs``, and kill its process if the file ``die`` exists.

    The file is removed. The paths are strings, because paths would be inputs.
    """

    number: int
    seconds: float = 0.0
    runs: str = ""
    die: str = ""


def write_hash(common: Settings, value: Run, output: Path) -> None:
    """Write a line with the number and the content of the inputs."""
    if value.runs:
        Path(value.runs, f"{value.number}-{os.getpid()}-{time.time_ns()}").touch()
    if value.die:
        # Another process may remove the file at the same time: the one that removes it is killed.
        with contextlib.suppress(FileNotFoundError):
            Path(value.die).unlink()
            os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(value.seconds + common.seconds)
    text = "".join(path.read_text() for path in common.files)
    write_text(output, hashlib.sha256(f"{value.number} {text}".encode()).hexdigest() + "\n")


def write_mixture(common: Any, value: str, output: Path) -> dict[str, Any] | None:
    """Write the result selected by ``value``."""
    if value == "fault":
        raise TypeError("a mistake of the program")
    if value == "refused":
        raise NergError("the scene has no light; give it one")
    if value == "deadly":
        write_text(output, "half of")
        os.kill(os.getpid(), signal.SIGKILL)
    if value == "threads":
        import drjit as dr

        write_text(output, "")
        return {"threads": dr.thread_count()}
    if value == "plugin":
        import mitsuba as mi

        mi.set_variant("llvm_ad_rgb")
        nerg = mi.load_dict({"type": "scene", "i": {"type": "nerg", "density": {"type": "constvolume"}}}).integrator()
        write_text(output, "")
        return {"plugin": type(nerg).__name__}
    if value.startswith("term "):
        # The sum of the terms depends on their order.
        number = int(value.removeprefix("term "))
        write_text(output, "")
        return {"term": 10.0 ** (number % 17) / 3 * (-1) ** number}
    write_text(output, f"{value}\n")
    return None


def change_input(common: Path, value: Any, output: Path) -> None:
    """Read a file that changes during the read."""
    write_text(output, common.read_text())
    common.write_text("in between")


def read_input(common: None, value: Path, output: Path) -> None:
    write_text(output, value.read_text())


def write_folder(common: Any, value: int, output: Path) -> None:
    """Write two files, one of them in a subfolder."""
    write_text(output / "a.txt", f"{value}\n")
    write_text(output / "below" / "b.txt", "b\n")


def make_plan(count: int, files: tuple[Path, ...] = (), what: str = "p", seconds: float = 0.0, **options: Any) -> Plan:
    """Make ``count`` parts of `write_hash`, each of which reads all ``files``."""
    parts = [Part(Run(k, seconds, **{k: str(v) for k, v in options.items()}), f"part {k}") for k in range(count)]
    return Plan(what, write_hash, Settings(files=files), parts, ".txt")


def make_small_plan(*values: str, what: str = "p") -> Plan:
    """Make parts of `write_mixture`, one for each value."""
    return Plan(what, write_mixture, None, [Part(value, f"the part {value}") for value in values], ".txt")


def read_one(*files: Path) -> Plan:
    """Make a part for each of ``files``, which reads the file."""
    return Plan("p", read_input, None, [Part(file, f"of {file.name}") for file in files], ".txt")


def change_one(file: Path) -> Plan:
    """Make a part that changes the file that it reads."""
    return Plan("p", change_input, file, [Part(None)], ".txt")


def folders(*numbers: int) -> Plan:
    return Plan("p", write_folder, None, [Part(k, f"folder {k}") for k in numbers], FOLDER_SUFFIX)


def expected(number: int, files: tuple[Path, ...] = ()) -> bytes:
    """Return the output of `write_hash`."""
    text = "".join(path.read_text() for path in files)
    return (hashlib.sha256(f"{number} {text}".encode()).hexdigest() + "\n").encode()


def lay_out(value: Any, folder: Path) -> Any:
    """Return ``value`` as on a machine that lacks its files and has received them in ``folder``."""
    inputs = tuple(find_inputs(value, Checksums()).values())
    for file in inputs:
        (folder / file.name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file.path, folder / file.name)
    return relocate_paths(value, inputs, folder)


def count_runs(folder: Path) -> dict[int, int]:
    """Return how often each part was run."""
    counts: dict[int, int] = {}
    for path in folder.iterdir():
        number = int(path.name.partition("-")[0])
        counts[number] = counts.get(number, 0) + 1
    return counts
