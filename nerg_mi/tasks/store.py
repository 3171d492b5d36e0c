"""The folder in which outputs of tasks are kept, each named by its task's key, whole or absent, verified before use."""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import check_folder, make_folder, replacing, replacing_folder, write_bytes, writing

from .inputs import InputFile
from .receipt import Receipt, digest_of, read_receipt, write_receipt
from .task import FOLDER, Task

PLANS = "plans"
HELD = "held"
_RECEIPT = ".receipt.json"


class Store:
    """Outputs and their receipts below ``folder``, which is made when the first is written.

    Any number of processes may write into it at once, on one machine or on many that share the folder: equal tasks have
    equal outputs, and each takes its place in one step. Raises `NergError` where nothing can be written there.
    """

    def __init__(self, folder: str | os.PathLike):
        check_folder(folder)
        self.folder = Path(os.path.abspath(folder))

    def output(self, key: str, suffix: str) -> Path:
        """Where the output of the task ``key`` is, or will be."""
        return self.folder / key[:2] / f"{key}{'' if suffix == FOLDER else suffix}"

    def receipt_file(self, key: str) -> Path:
        """Where its receipt is, or will be."""
        return self.folder / key[:2] / f"{key}{_RECEIPT}"

    def receipt(self, key: str) -> Receipt | None:
        """The receipt of the task ``key``; None where there is none, or it is damaged."""
        file = self.receipt_file(key)
        if not file.exists():
            return None
        try:
            found = read_receipt(file)
        except NergError:
            # What cannot be verified counts as not made, and is made anew.
            return None
        return found if found.key == key else None

    def find(self, key: str, suffix: str) -> Receipt | None:
        """The receipt of an output that is there and has the bytes that it had when it was made; None otherwise."""
        receipt, output = self.receipt(key), self.output(key, suffix)
        if receipt is None or not output.exists():
            return None
        try:
            whole = digest_of(output) == (receipt.size, receipt.sha256)
        except NergError:
            return None
        return receipt if whole else None

    @contextmanager
    def writing(self, task: Task) -> Iterator[Path]:
        """The name of a new file, or folder, that becomes the output of ``task`` when the block ends."""
        output = self.output(task.key, task.suffix)
        if task.suffix != FOLDER:
            with replacing(output) as temporary:
                yield temporary
            return
        # Whoever comes here found no whole one.
        shutil.rmtree(output, ignore_errors=True)
        with replacing_folder(output) as temporary:
            yield temporary

    def add(self, receipt: Receipt) -> None:
        """Write the ``receipt`` of an output that is in its place: from now on it counts as made."""
        write_receipt(self.receipt_file(receipt.key), receipt)

    def put(self, task: Task, receipt: Receipt, content: Sequence[tuple[str, bytes]]) -> None:
        """Write an output that was made elsewhere: its files' names and bytes, one without a name for a file. Raises
        `NergError` where the bytes are not those of the ``receipt``."""
        with self.writing(task) as temporary:
            for name, data in content:
                write_bytes(temporary / name if name else temporary, data)
            if digest_of(temporary) != (receipt.size, receipt.sha256):
                raise NergError(f"{task.label} arrived with other bytes than it was sent with; start the job again")
        self.add(receipt)

    def hold(self, name: str, content: bytes) -> InputFile:
        """What a job has made in memory as an input called ``name``: a file of the store named by its bytes, which is
        the same when the job is started again. Equal contents are one file."""
        sha256 = hashlib.sha256(content).hexdigest()
        path = self.folder / HELD / f"{sha256}{Path(name).suffix}"
        if not path.is_file() or digest_of(path) != (len(content), sha256):
            write_bytes(path, content)
        return InputFile(name, sha256, len(content), str(path))

    def held(self, older: float) -> list[Path]:
        """All files that jobs hold here and that were written ``older`` seconds ago or earlier."""
        return [p for p in sorted(self.folder.glob(f"{HELD}/*")) if time.time() - p.lstat().st_mtime > older]

    def remove(self, key: str, suffix: str) -> None:
        """Remove an output with its receipt, the receipt first."""
        with writing(self.folder):
            self.receipt_file(key).unlink(missing_ok=True)
            output = self.output(key, suffix)
            shutil.rmtree(output) if output.is_dir() else output.unlink(missing_ok=True)

    def receipts(self) -> Iterator[Receipt]:
        """All receipts that can be read, by their keys."""
        for file in sorted(self.folder.glob(f"[0-9a-f][0-9a-f]/*{_RECEIPT}")):
            found = self.receipt(file.name.removesuffix(_RECEIPT))
            if found is not None:
                yield found

    def leftovers(self, older: float) -> list[Path]:
        """What workers that died have left unfinished: hidden files and folders that nobody has written to for
        ``older`` seconds, and outputs without a receipt."""
        known = {receipt.key for receipt in self.receipts()}
        found = []
        for path in sorted(self.folder.glob("[0-9a-f][0-9a-f]/*")):
            key = path.name.removesuffix(_RECEIPT).partition(".")[0]
            if key not in known and time.time() - path.lstat().st_mtime > older:
                found.append(path)
        return found

    @contextmanager
    def probe(self) -> Iterator[str]:
        """A file in the store for as long as the block lasts: its name, which is also what it holds. Who sees it there
        shares the folder."""
        make_folder(self.folder)
        name = f".probe-{secrets.token_hex(16)}"
        write_bytes(self.folder / name, name.encode())
        try:
            yield name
        finally:
            (self.folder / name).unlink(missing_ok=True)


def shares(folder: Path, probe: str) -> bool:
    """Whether this process sees, and may write to, the store that holds the file ``probe``."""
    try:
        return (folder / probe).read_bytes() == probe.encode() and os.access(folder, os.W_OK)
    except OSError:
        return False
