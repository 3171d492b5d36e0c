"""Receipts: what a store says of each output that it holds, by which the output is verified before it is used again."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import file_sha256, write_text
from nerg_mi.files.safe_read import is_count, read_json

from .task import FORMAT, Task

BYTES = 8 << 20
"""A receipt may have so many bytes: parameters of a task are not meant for arrays."""

_HEX = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Receipt:
    """That of the output of the task ``key``: ``size`` in bytes and ``sha256`` (of a folder `digest_of`), the
    ``seconds`` that it took, the ``processor`` that made it, the ``notes`` of whoever made it, and what it was made of,
    as `task.Task` has it."""

    key: str
    size: int
    sha256: str
    seconds: float
    processor: str
    notes: Mapping[str, Any]
    label: str
    suffix: str
    function: str
    parameters: Mapping[str, Any]
    inputs: Mapping[str, str]
    versions: Mapping[str, str]


def receipt_for(task: Task, output: Path, seconds: float, processor: str, notes: Mapping[str, Any]) -> Receipt:
    """The receipt of ``output``, which ``task`` made in so many ``seconds``, with ``notes``."""
    size, sha256 = digest_of(output)
    inputs = {file.name: file.sha256 for file in task.inputs}
    about = (task.label, task.suffix, task.function, task.parameters, inputs, task.versions)
    return Receipt(task.key, size, sha256, seconds, processor, notes, *about)


def write_receipt(path: Path, receipt: Receipt) -> None:
    """Write ``receipt``, whole or not at all."""
    write_text(path, json.dumps({"format": FORMAT, **asdict(receipt)}, sort_keys=True, indent=1) + "\n")


def read_receipt(path: str | os.PathLike) -> Receipt:
    """The receipt in the file ``path``. Raises `NergError` for one that is damaged or of another version."""
    found = read_json(path, "receipt", BYTES)
    names = {f.name for f in fields(Receipt)}
    if not isinstance(found, dict) or set(found) != names | {"format"} or found.pop("format") != FORMAT:
        raise NergError(f'the receipt "{path}" is none of this version; remove it, and its output is made anew')
    kinds = {name: dict if name in ("notes", "parameters", "inputs", "versions") else str for name in names}
    whole = all(isinstance(found[n], kind) for n, kind in kinds.items() if n not in ("size", "seconds"))
    numbers = is_count(found["size"]) and isinstance(found["seconds"], (int, float)) and found["seconds"] >= 0
    if not (whole and numbers and _HEX.fullmatch(found["sha256"]) and _HEX.fullmatch(found["key"])):
        raise NergError(f'the receipt "{path}" is damaged; remove it, and its output is made anew')
    return Receipt(**found)


def digest_of(output: Path) -> tuple[int, str]:
    """Bytes of an output and their SHA-256 (hex); of a folder the sum, and that of its files' names and digests. Raises
    `NergError` where it cannot be read."""
    if not output.is_dir():
        return os.stat(output).st_size if output.exists() else 0, file_sha256(output)
    digest, size = hashlib.sha256(), 0
    for file in files_in(output):
        digest.update(f"{file.relative_to(output).as_posix()}\0{file_sha256(file)}\n".encode())
        size += file.stat().st_size
    return size, digest.hexdigest()


def files_in(folder: Path) -> list[Path]:
    """All files below ``folder``, in an order that does not depend on the machine."""
    return sorted((p for p in folder.rglob("*") if p.is_file()), key=lambda p: p.relative_to(folder).as_posix())
