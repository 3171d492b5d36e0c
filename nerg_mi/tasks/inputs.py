"""The files that a task reads: known by their bytes, and checked again wherever the task is run."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import file_sha256

Signature = tuple[int, int, int, int]
"""Device, inode, bytes and time of change (ns) of a file: while they stay, its bytes are taken to be the same."""


@dataclass(frozen=True)
class InputFile:
    """A file that a task reads.

    ``name``: what the task calls it, a relative path with slashes, in which nothing of the machine is left but how the
    inputs lie to each other; ``sha256``: hex digest of its bytes; ``size``: their number; ``path``: where it is on the
    machine that planned the task, which is no part of the task's key.
    """

    name: str
    sha256: str
    size: int
    path: str

    def __post_init__(self) -> None:
        parts = PurePosixPath(self.name).parts
        if not parts or ".." in parts or PurePosixPath(self.name).is_absolute() or "\\" in self.name:
            raise ValueError(f'an input is called "{self.name}", and it needs a relative path that goes down only')

    def document(self) -> dict[str, Any]:
        return asdict(self)


class Checksums:
    """SHA-256 of files, each computed once while the file stays what it is."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[Signature, str]] = {}

    def of(self, path: str | os.PathLike) -> str:
        """Hex digest of the file ``path``. Raises `NergError` for what cannot be read."""
        name = os.path.abspath(path)
        signature = signature_of(name)
        found = self._known.get(name)
        if found is None or signature is None or found[0] != signature:
            digest = file_sha256(name)
            # A file that changes meanwhile is read again when it is asked for again.
            if signature is None or signature_of(name) != signature:
                return digest
            found = self._known[name] = (signature, digest)
        return found[1]


def signature_of(path: str | os.PathLike) -> Signature | None:
    """What tells whether the file ``path`` was changed; None where there is none."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def read_inputs(
    paths: Iterable[str | os.PathLike], checksums: Checksums | None = None, below: str = ""
) -> tuple[InputFile, ...]:
    """The files ``paths`` as inputs, called by their paths below the folder that they have in common, so that they can
    be laid out alike elsewhere. ``below``: a folder in which all of them are said to lie, apart from other inputs of
    the task. Raises `NergError` for a file that cannot be read."""
    checksums = checksums or Checksums()
    whole = list(dict.fromkeys(os.path.abspath(path) for path in paths))
    if not whole:
        return ()
    above = os.path.commonpath([os.path.dirname(path) for path in whole])
    return tuple(
        InputFile(
            PurePosixPath(below, Path(path).relative_to(above).as_posix()).as_posix(),
            checksums.of(path),
            os.path.getsize(path),
            path,
        )
        for path in whole
    )


def read_input(name: str, path: str | os.PathLike, checksums: Checksums | None = None) -> InputFile:
    """The file ``path`` as an input that the task calls ``name``. Raises `NergError` for one that cannot be read."""
    path = os.path.abspath(path)
    return InputFile(name, (checksums or Checksums()).of(path), os.path.getsize(path), path)


def name_of(path: str | os.PathLike, inputs: Iterable[InputFile]) -> str:
    """What the file ``path`` is called among ``inputs``. Raises ``KeyError`` for one that is not among them."""
    return {file.path: file.name for file in inputs}[os.path.abspath(path)]


def check_unchanged(inputs: Iterable[InputFile], paths: Mapping[str, Path], checksums: Checksums) -> None:
    """Raise `ChangedInput` unless each of ``inputs``, at ``paths`` by its name, has the bytes that it was planned
    with."""
    for file in inputs:
        if checksums.of(paths[file.name]) != file.sha256:
            raise ChangedInput(
                f'"{paths[file.name]}" was changed while the job was running; start it again: what does not depend on '
                "this file is kept"
            )


class ChangedInput(NergError):
    """A file is not what it was when the task was planned: running the task again cannot help."""
