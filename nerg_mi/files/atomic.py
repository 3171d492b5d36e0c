"""Files written whole or not at all, locks of outputs, and checksums."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nerg_mi.errors import NergError

from .safe_read import open_file

# ---- Atomic ----
#
# Output files that are whole or absent: every writer of this package goes through here.
#
# A file is written under another name in the folder of its target, brought to the disk, and then moved into place in
# one step (POSIX rename), so that a reader, a killed process, a full disk or a power cut meets the old file or the new
# one.

_REMEDIES = {
    errno.ENOSPC: "the disk is full; free some space or choose another folder",
    errno.EDQUOT: "your quota is used up; free some space or choose another folder",
    errno.EFBIG: (
        "the file would exceed the largest size that is allowed here; raise the limit or choose a smaller output"
    ),
    errno.EACCES: "you may not write there; choose another folder or change its permissions",
    errno.EPERM: "you may not write there; choose another folder or change its permissions",
    errno.EROFS: "the file system is read-only; choose another folder",
    errno.EISDIR: "it is a folder; choose the name of a file",
    errno.EEXIST: "one of its parents is a file; choose another folder",
    errno.ENOTDIR: "one of its parents is a file; choose another folder",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
}


@contextmanager
def replace_atomically(path: str | os.PathLike) -> Iterator[Path]:
    """The name of a new, empty file to be written, which takes the place of ``path`` when the block ends.

    The name keeps the suffix of ``path``, by which many writers choose a format. Parent folders are made. A link is
    followed, and the permissions of a file that is replaced are kept. If the block raises, the new file is removed and
    the old one is as it was; an `OSError` of the block comes out as a `NergError` that names ``path`` and the remedy.
    """
    with translate_write_errors(path):
        target = Path(os.path.realpath(path))
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        _check_unprotected(target)
        if os.path.exists(path) and not os.path.isfile(path):
            # A pipe or a device, such as /dev/stdout, has nothing to be kept, and must not become a file.
            with tempfile.TemporaryDirectory() as folder:
                temporary = Path(folder, target.name)
                temporary.touch()
                yield temporary
                with temporary.open("rb") as made, open(path, "wb") as out:
                    shutil.copyfileobj(made, out)
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        # In the same folder, since only there a move is one step; hidden, since it is nobody's result.
        temporary = target.with_name(f".{target.stem[:32]}.{os.getpid()}-{secrets.token_hex(4)}.part{target.suffix}")
        # Opened here and not by the writer, so that the permissions are those that the umask gives any other file.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        try:
            yield temporary
            if target.exists():
                os.chmod(temporary, target.stat().st_mode & 0o7777)
            _flush(temporary)
            os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        _flush(target.parent)


@contextmanager
def create_folder_atomically(path: str | os.PathLike) -> Iterator[Path]:
    """The name of a new, empty folder to be filled, which becomes the folder ``path`` when the block ends.

    ``path`` must be absent or an empty folder, see `check_new_folder`. Parent folders are made. If the block raises,
    the new folder is removed with all that is in it; an `OSError` of the block comes out as a `NergError` that names
    ``path`` and the remedy.
    """
    check_new_folder(path)
    with translate_write_errors(path):
        target = Path(os.path.realpath(path))
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = target.with_name(f".{target.name[:32]}.{os.getpid()}-{secrets.token_hex(4)}.part")
        temporary.mkdir()
        try:
            yield temporary
            for found in (*temporary.rglob("*"), temporary):
                _flush(found)
            os.replace(temporary, target)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        _flush(target.parent)


def check_new_folder(path: str | os.PathLike) -> None:
    """Raise `NergError` where no folder ``path`` can be made, or where it is there and holds something: to be asked
    before long work."""
    check_folder(path)
    with translate_write_errors(path):
        if os.path.isdir(path) and any(os.scandir(path)):
            raise NergError(f'the folder "{path}" is there and not empty: choose another name, or remove it first')


def write_bytes(path: str | os.PathLike, *parts: bytes | memoryview) -> None:
    """Write ``parts``, one after the other, to ``path``, whole or not at all; see `replacing`."""
    with replace_atomically(path) as temporary, temporary.open("wb") as out:
        for part in parts:
            out.write(part)


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write ``text`` as UTF-8 to ``path``, whole or not at all; line ends are written as they are. See `replacing`."""
    write_bytes(path, text.encode("utf-8"))


def check_writable(path: str | os.PathLike, *suffixes: str) -> None:
    """Raise `NergError` where it is plain that no file can be written to ``path``: to be asked before long work.

    A folder in its place, a file in place of a parent, no permission, a suffix that is none of ``suffixes`` (where
    there are any). Nothing is made. A disk that fills meanwhile, or permissions that change, are found by `replacing`.
    """
    if suffixes and Path(path).suffix.lower() not in suffixes:
        raise NergError(f'"{path}" has no format that is written here: let its name end in {" or ".join(suffixes)}')
    with translate_write_errors(path):
        target = Path(os.path.realpath(path))
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        _check_unprotected(target)
        _check_parents(target)


def check_folder(path: str | os.PathLike) -> None:
    """Raise `NergError` where it is plain that no files can be written into the folder ``path``, which need not be
    there yet."""
    with translate_write_errors(path):
        _check_parents(Path(os.path.realpath(path)) / "file")


def make_folder(path: str | os.PathLike) -> Path:
    """Make the folder ``path`` with its parents, if it is not there; raises `NergError` where that cannot be done."""
    with translate_write_errors(path):
        Path(path).mkdir(parents=True, exist_ok=True)
    return Path(path)


@contextmanager
def lock_file(path: str | os.PathLike, busy_message: str) -> Iterator[None]:
    """A block in which nobody else has the lock on the file ``path``, which is made if it is not there.

    Raises `NergError`, which says ``busy``, where somebody has it. The system takes it from a process that is killed.
    """
    with translate_write_errors(path):
        handle = os.open(path, os.O_RDONLY | os.O_CREAT, 0o666)
    try:
        with translate_write_errors(path):
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # Its last owner may have removed it since it was opened.
                if not os.path.exists(path) or not os.path.samestat(os.fstat(handle), os.stat(path)):
                    raise BlockingIOError
            except BlockingIOError as error:
                raise NergError(busy_message) from error
        yield
    finally:
        os.close(handle)


@contextmanager
def reserve_output(path: str | os.PathLike | None) -> Iterator[None]:
    """A block, of long work, in which no other process writes the output ``path``; None: no output.

    Raises `NergError` where one does. A hidden file beside ``path`` is locked meanwhile; a process that is killed
    leaves it, without a lock.
    """
    if path is None:
        yield
        return
    target = Path(os.path.realpath(path))
    lock = target.with_name(f".{target.name}.lock")
    with remove_empty_new_parents(lock):
        make_folder(lock.parent)
        busy = f'"{path}" is being made by another process: wait for its end, or choose another name'
        with lock_file(lock, busy):
            try:
                yield
            finally:
                lock.unlink(missing_ok=True)


@contextmanager
def remove_empty_new_parents(path: str | os.PathLike) -> Iterator[None]:
    """A block after which those parents of ``path`` are removed that were not there before, and are empty."""
    missing = [parent for parent in Path(os.path.realpath(path)).parents if not parent.exists()]
    try:
        yield
    finally:
        for parent in missing:
            try:
                parent.rmdir()
            except OSError:
                break


@contextmanager
def translate_write_errors(path: str | os.PathLike) -> Iterator[None]:
    """An `OSError` of the block as a `NergError` that names ``path`` and says what to do."""
    try:
        yield
    except OSError as error:
        remedy = _REMEDIES.get(error.errno or 0, "choose another folder")
        raise NergError(f'"{path}" could not be written ({error.strerror or error}): {remedy}') from error


def _check_unprotected(target: Path) -> None:
    """Raise `PermissionError` for a file that may not be written: the folder would let it be replaced all the same."""
    if target.exists() and not os.access(target, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(target))


def _check_parents(target: Path) -> None:
    """Raise `OSError` unless ``target``, or first its missing parents, can be made."""
    try:
        os.lstat(target)  # finds a name that is too long, a parent that is a file, or one that may not be entered
    except FileNotFoundError:
        pass
    there = next(p for p in target.parents if p.exists())
    if not there.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(there))
    if not os.access(there, os.W_OK | os.X_OK):
        why = errno.EROFS if os.statvfs(there).f_flag & os.ST_RDONLY else errno.EACCES
        raise OSError(why, os.strerror(why), str(there))


def _flush(path: Path) -> None:
    """Bring a file, or the entries of a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        # Some file systems have no such thing for folders.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(handle)


# ---- Checksums of files, by which a result says what it was made from ----

_BLOCK = 1 << 20


def file_sha256(path: str | os.PathLike) -> str:
    """Hex digest of a file's bytes. Raises `NergError` for what is no ordinary file, or cannot be read."""
    digest = hashlib.sha256()
    with open_file(path) as source:
        while block := source.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()
