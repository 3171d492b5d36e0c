"""Atomic writing of files and folders, locks on outputs, and checksums."""

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

# ---- Atomic output ----
#
# All writers of this package use these functions. A file is written under a temporary name in the folder of its target,
# flushed to the disk, and renamed in one step (POSIX rename). After a crash, a full disk or a power failure, either the
# complete old file or the complete new file exists.

_REMEDIES = {
    errno.ENOSPC: "the disk is full; free some space or choose another folder",
    errno.EDQUOT: "the disk quota is exceeded; free some space or choose another folder",
    errno.EFBIG: ("the file would exceed the maximum file size; raise the limit or choose a smaller output"),
    errno.EACCES: "permission denied; choose another folder or change its permissions",
    errno.EPERM: "permission denied; choose another folder or change its permissions",
    errno.EROFS: "the file system is read-only; choose another folder",
    errno.EISDIR: "it is a folder; specify a file name",
    errno.EEXIST: "one of its parents is a file; choose another folder",
    errno.ENOTDIR: "one of its parents is a file; choose another folder",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter name",
}


@contextmanager
def replace_atomically(path: str | os.PathLike) -> Iterator[Path]:
    """Write a file atomically: yield the path of a new empty file, which replaces ``path`` at the end of the block.

    The temporary name keeps the suffix of ``path``, because many writers derive the format from it. Parent folders are
    created. A symbolic link is followed, and a replaced file keeps its permissions. If the block raises, the new file
    is removed and the old one is unchanged. An `OSError` in the block becomes a `NergError` with ``path`` and the
    remedy.
    """
    with translate_write_errors(path):
        target = Path(os.path.realpath(path))
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        _check_unprotected(target)
        if os.path.exists(path) and not os.path.isfile(path):
            # A pipe or a device, such as /dev/stdout, has no content to protect and must not be replaced by a file.
            with tempfile.TemporaryDirectory() as folder:
                temporary = Path(folder, target.name)
                temporary.touch()
                yield temporary
                with temporary.open("rb") as source, open(path, "wb") as out:
                    shutil.copyfileobj(source, out)
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        # In the same folder, because a rename is atomic only within a file system. Hidden, because it is not an output.
        temporary = target.with_name(f".{target.stem[:32]}.{os.getpid()}-{secrets.token_hex(4)}.part{target.suffix}")
        # Created here and not by the writer, so that the umask determines the permissions.
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
    """Create a folder atomically: yield the path of a new empty folder, which becomes ``path`` at the end of the block.

    ``path`` must not exist or must be an empty folder, see `check_new_folder`. Parent folders are created. If the block
    raises, the new folder is removed with its contents. An `OSError` in the block becomes a `NergError` with ``path``
    and the remedy.
    """
    check_new_folder(path)
    with translate_write_errors(path):
        target = Path(os.path.realpath(path))
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = target.with_name(f".{target.name[:32]}.{os.getpid()}-{secrets.token_hex(4)}.part")
        temporary.mkdir()
        try:
            yield temporary
            for entry in (*temporary.rglob("*"), temporary):
                _flush(entry)
            os.replace(temporary, target)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        _flush(target.parent)


def check_new_folder(path: str | os.PathLike) -> None:
    """Raise `NergError` if the folder ``path`` cannot be created, or exists and is not empty. Call this before
    long work.
    """
    check_folder(path)
    with translate_write_errors(path):
        if os.path.isdir(path) and any(os.scandir(path)):
            raise NergError(f'the folder "{path}" exists and is not empty: choose another name, or remove it first')


def write_bytes(path: str | os.PathLike, *parts: bytes | memoryview) -> None:
    """Write the concatenation of ``parts`` to ``path`` atomically; see `replace_atomically`."""
    with replace_atomically(path) as temporary, temporary.open("wb") as out:
        for part in parts:
            out.write(part)


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write ``text`` as UTF-8 to ``path`` atomically, without converting line ends; see `replace_atomically`."""
    write_bytes(path, text.encode("utf-8"))


def check_writable(path: str | os.PathLike, *suffixes: str) -> None:
    """Raise `NergError` if the file ``path`` evidently cannot be written. Call this before long work.

    Detects a folder at ``path``, a file at the path of a parent folder, missing permissions, and a suffix that is not
    one of ``suffixes`` (if any are specified). Creates nothing. A disk that fills up later, or permissions that change
    later, are reported by `replace_atomically`.
    """
    if suffixes and Path(path).suffix.lower() not in suffixes:
        raise NergError(
            f'the format of "{path}" is not supported: choose a file name that ends in {" or ".join(suffixes)}'
        )
    with translate_write_errors(path):
        target = Path(os.path.realpath(path))
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        _check_unprotected(target)
        _check_parents(target)


def check_folder(path: str | os.PathLike) -> None:
    """Raise `NergError` if files evidently cannot be written into the folder ``path``, which may not exist yet."""
    with translate_write_errors(path):
        _check_parents(Path(os.path.realpath(path)) / "file")


def make_folder(path: str | os.PathLike) -> Path:
    """Create the folder ``path`` and its parents if they do not exist. Raises `NergError` if that fails."""
    with translate_write_errors(path):
        Path(path).mkdir(parents=True, exist_ok=True)
    return Path(path)


@contextmanager
def lock_file(path: str | os.PathLike, busy_message: str) -> Iterator[None]:
    """Hold an exclusive lock on the file ``path`` for the duration of the block. Creates the file if it does not exist.

    Raises `NergError` with the text ``busy_message`` if another process holds the lock. The operating system releases
    the lock of a process that is killed.
    """
    with translate_write_errors(path):
        handle = os.open(path, os.O_RDONLY | os.O_CREAT, 0o666)
    try:
        with translate_write_errors(path):
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # The previous owner may have removed the file after it was opened here.
                if not os.path.exists(path) or not os.path.samestat(os.fstat(handle), os.stat(path)):
                    raise BlockingIOError
            except BlockingIOError as error:
                raise NergError(busy_message) from error
        yield
    finally:
        os.close(handle)


@contextmanager
def reserve_output(path: str | os.PathLike | None) -> Iterator[None]:
    """Prevent other processes from writing the output ``path`` for the duration of the block. None: no output.

    Raises `NergError` if another process writes it. The lock is a hidden file next to ``path``; a killed process leaves
    the file, but without the lock.
    """
    if path is None:
        yield
        return
    target = Path(os.path.realpath(path))
    lock = target.with_name(f".{target.name}.lock")
    with remove_empty_new_parents(lock):
        make_folder(lock.parent)
        busy = f'another process is writing "{path}": wait until it has finished, or choose another name'
        with lock_file(lock, busy):
            try:
                yield
            finally:
                lock.unlink(missing_ok=True)


@contextmanager
def remove_empty_new_parents(path: str | os.PathLike) -> Iterator[None]:
    """Remove the parents of ``path`` after the block if the block created them and left them empty."""
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
    """Convert an `OSError` of the block to a `NergError` that names ``path`` and the remedy."""
    try:
        yield
    except OSError as error:
        remedy = _REMEDIES.get(error.errno or 0, "choose another folder")
        raise NergError(f'"{path}" could not be written ({error.strerror or error}): {remedy}') from error


def _check_unprotected(target: Path) -> None:
    """Raise `PermissionError` for a write-protected file, because a rename in its folder would replace it anyway."""
    if target.exists() and not os.access(target, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(target))


def _check_parents(target: Path) -> None:
    """Raise `OSError` unless ``target`` and its missing parents can be created."""
    try:
        os.lstat(
            target
        )  # detects a name that is too long, a parent that is a file, and a parent without search permission
    except FileNotFoundError:
        pass
    existing = next(p for p in target.parents if p.exists())
    if not existing.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(existing))
    if not os.access(existing, os.W_OK | os.X_OK):
        code = errno.EROFS if os.statvfs(existing).f_flag & os.ST_RDONLY else errno.EACCES
        raise OSError(code, os.strerror(code), str(existing))


def _flush(path: Path) -> None:
    """Flush a file, or the entries of a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        # Some file systems do not support this for folders.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(handle)


# ---- Checksums of files, recorded in the provenance of results ----

_BLOCK = 1 << 20


def file_sha256(path: str | os.PathLike) -> str:
    """Return the SHA-256 (hex) of a file's bytes. Raises `NergError` if it is not a regular file or cannot be read."""
    digest = hashlib.sha256()
    with open_file(path) as source:
        while block := source.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()
