"""Files that a worker reads: its own where they have the same bytes, and otherwise copies that it was sent."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import threading
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import file_sha256, replacing, replacing_folder, write_bytes

from .inputs import Checksums, InputFile
from .task import canonical

CHUNK = 8 << 20
"""Bytes of a file that are sent at a time."""

MOST = 8 << 30
"""A file of more bytes is not sent: share its folder with the workers."""


class KeptInputs:
    """Copies of files by their checksums, in a folder that goes with the process."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="nerg-worker-")
        self.folder = Path(self._folder.name)
        self.checksums = Checksums()
        self._lock = threading.Lock()

    def paths(self, inputs: tuple[InputFile, ...]) -> dict[str, str] | None:
        """Where ``inputs`` are, by their names: where they were planned, if all are there with the same bytes, or laid
        out alike in a folder of their own; None while some have to be sent, see `missing`."""
        if all(self._is_at(file) for file in inputs):
            return {file.name: file.path for file in inputs}
        if self.missing(inputs):
            return None
        names = canonical({file.name: file.sha256 for file in inputs})
        laid = self.folder / "laid" / hashlib.sha256(names.encode()).hexdigest()[:32]
        with self._lock:
            if not laid.exists():
                with replacing_folder(laid) as temporary:
                    for file in inputs:
                        target = temporary / file.name
                        target.parent.mkdir(parents=True, exist_ok=True)
                        os.link(self._copy(file.sha256), target)
        return {file.name: str(laid / file.name) for file in inputs}

    def missing(self, inputs: tuple[InputFile, ...]) -> list[str]:
        """Checksums of those of ``inputs`` of which there is no copy here; those that lie where they were planned are
        copied."""
        out = []
        for file in {f.sha256: f for f in inputs}.values():
            copy = self._copy(file.sha256)
            with self._lock:
                if not copy.exists() and self._is_at(file):
                    with replacing(copy) as temporary:
                        shutil.copyfile(file.path, temporary)
            if not copy.exists():
                out.append(file.sha256)
        return out

    def receive(self, sha256: str, number: int, count: int, data: bytes) -> None:
        """Take the part ``number``, from 0 on, of ``count``, of the file with this checksum. Raises `NergError` where
        the whole has other bytes."""
        parts = [self.folder / "parts" / f"{sha256}.{k}" for k in range(count)]
        write_bytes(parts[number], data)
        if number < count - 1:
            return
        with replacing(self._copy(sha256)) as temporary:
            with temporary.open("wb") as out:
                for part in parts:
                    out.write(part.read_bytes())
                    part.unlink()
            if file_sha256(temporary) != sha256:
                raise NergError("a file arrived with other bytes than it was sent with; start the job again")

    def _copy(self, sha256: str) -> Path:
        return self.folder / "files" / sha256

    def _is_at(self, file: InputFile) -> bool:
        """Whether the file is here where it was planned, with the same bytes."""
        try:
            return os.path.getsize(file.path) == file.size and self.checksums.of(file.path) == file.sha256
        except (OSError, NergError):
            return False
