"""What every reader of a file needs against a damaged or hostile one: limits before allocation, and one sentence after.

A reader asks first how large things are, by the bytes that are there and by the limits stated here, and only then makes
room for them. Compressed files: `inflating`; NumPy's: `npy`; pictures: `image_header`.
"""

from __future__ import annotations

import gzip
import json
import lzma
import mmap
import os
import pickle
import re
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

import numpy as np

from nerg_mi.errors import MissingFile, NergError, plain, sentence

JSON_BYTES = 64 << 20
"""A JSON file may have so many bytes: the poses of some 80,000 frames."""

JSON_VALUES = 8_000_000
"""So many values may stand in it: each takes up to 100 bytes of memory."""

JSON_DEPTH = 64
"""So deep may arrays and objects be nested; what this package reads is six deep at most."""

_DAMAGED = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    IndexError,
    OverflowError,
    MemoryError,
    RecursionError,
    NotImplementedError,
    struct.error,
    zlib.error,
    lzma.LZMAError,
    gzip.BadGzipFile,
    zipfile.BadZipFile,
    zipfile.LargeZipFile,
    tokenize.TokenError,
    SyntaxError,
    pickle.UnpicklingError,
)


_REMEDY = "copy it again, or make it anew"


@contextmanager
def reading(
    path: str | os.PathLike, what: str = "file", remedy: str = _REMEDY, also: tuple[type[Exception], ...] = ()
) -> Iterator[None]:
    """Whatever a damaged file makes the block raise, as one `NergError` that names ``path`` and the ``remedy``.

    ``what``: the kind of file, with which the sentence begins ("the depth file"). ``also``: further exceptions that
    only the file can be to blame for. Keep the block to the parse alone: `KeyError` and `IndexError` are taken for the
    file's, and a `TypeError` passes, since it is a mistake of the program's. A `NergError` passes as it is.
    """
    try:
        yield
    except NergError:
        raise
    except FileNotFoundError as error:
        raise MissingFile(f'there is no {what} "{path}"; correct its name') from error
    except (*_DAMAGED, *also) as error:
        raise NergError(f'the {what} "{path}" cannot be read: {_said(error)}; {_remedy(error, remedy)}') from error
    except Exception as error:
        # The library is imported by those who read its files: without it the exception cannot be one of its own.
        if type(error).__name__ != "SafetensorError":
            raise
        raise NergError(f'the {what} "{path}" cannot be read: {_said(error)}; {remedy}') from error


def _said(error: BaseException) -> str:
    if isinstance(error, MemoryError):
        return "it needs more memory than there is"
    if isinstance(error, RecursionError):
        return "it is nested too deep"
    if isinstance(error, EOFError):
        return "it ends too early"
    if isinstance(error, KeyError):
        return f"it lacks {plain(error)}"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror[:1].lower() + error.strerror[1:]
    return plain(sentence(error)).rstrip(".")


def _remedy(error: BaseException, remedy: str) -> str:
    if isinstance(error, PermissionError):
        return "change its permissions"
    if isinstance(error, (IsADirectoryError, NotADirectoryError)):
        return "give the name of a file"
    return remedy


_KINDS = {
    stat.S_IFDIR: ("a folder", "give the name of a file"),
    stat.S_IFIFO: ("a pipe", "write what comes out of it to a file, and give that"),
    stat.S_IFSOCK: ("a socket", "give the name of a file"),
    stat.S_IFCHR: ("a device", "give the name of a file"),
    stat.S_IFBLK: ("a device", "give the name of a file"),
}


def is_count(value: object) -> bool:
    """Whether ``value``, read from a file, is a whole number from 0 on that 64 bits hold with room to add."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 62


def size_of(path: str | os.PathLike, what: str = "file", most: int | None = None) -> int:
    """Bytes of the ordinary file ``path``; `NergError` for a folder, a device or a pipe, and beyond ``most`` bytes.

    A pipe may keep its reader waiting for ever, and a device may have no end. So every path is checked by this before
    it is opened, here or by a library. A link counts as what it leads to: ``/dev/stdin`` is read where it is a file.
    """
    with reading(path, what):
        # A name may hold what no file's can, such as a zero byte.
        found = os.stat(path)
    if not stat.S_ISREG(found.st_mode):
        kind, remedy = _KINDS.get(stat.S_IFMT(found.st_mode), ("no ordinary file", "give the name of a file"))
        raise NergError(f'the {what} "{path}" is {kind}; {remedy}')
    if most is not None and found.st_size > most:
        raise NergError(
            f'the {what} "{path}" has {found.st_size:,} bytes, more than the {most:,} that are read; give a smaller one'
        )
    return found.st_size


@contextmanager
def open_file(
    path: str | os.PathLike, what: str = "file", remedy: str = _REMEDY, most: int | None = None
) -> Iterator[BinaryIO]:
    """The ordinary file ``path``, open to be read in the block; see `size_of`, and `reading` for errors of the
    block."""
    size_of(path, what, most)
    with reading(path, what, remedy), open(path, "rb") as file:
        yield file


def read_bytes(path: str | os.PathLike, what: str, most: int) -> bytes:
    """The bytes of the ordinary file ``path``, at most ``most``; see `size_of`. All of them are held: read what may be
    larger than its reader can hold by `open_file`."""
    with open_file(path, what, most=most) as file:
        return file.read()


def map_bytes(path: str | os.PathLike, what: str, most: int, start: bytes, remedy: str = _REMEDY) -> memoryview:
    """The bytes of the ordinary file ``path``, at most ``most``, each read when it is used: what is not used takes no
    memory. `NergError` for a file that does not begin with ``start``; see `open_file`."""
    with open_file(path, what, remedy, most) as file:
        if file.read(len(start)) != start:
            raise ValueError(f'it does not begin with "{plain(start.decode("latin-1"))}", as such a file does')
        return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def read_json(path: str | os.PathLike, what: str = "file", most: int = JSON_BYTES) -> object:
    """The JSON document ``path``. `NergError` for what is none, is larger than ``most`` bytes or is nested too deep."""
    return parse_json(read_bytes(path, what, most), path, what, most)


def parse_json(
    raw: bytes | memoryview | str, path: str | os.PathLike, what: str = "file", most: int = JSON_BYTES
) -> object:
    """The JSON document ``raw``, which stood in ``path``. `NergError` for what is none, is nested deeper than
    `JSON_DEPTH` or holds more than `JSON_VALUES` values. Integers of hundreds of digits are floats."""
    if len(raw) > most:
        raise NergError(
            f'the {what} "{path}" holds a JSON document of {len(raw):,} bytes, more than the {most:,} that are read; '
            "give a smaller one"
        )
    with reading(path, what, "correct it, or make it anew"):
        if not isinstance(raw, str):
            raw = bytes(raw)
            raw = raw.decode(json.detect_encoding(raw))
        _check_json(raw, path, what)
        try:
            return json.loads(raw, parse_int=_integer)
        except json.JSONDecodeError as error:
            raise NergError(
                f'the {what} "{path}" is not valid JSON: {plain(error)}; correct it, or make it anew'
            ) from error


def _integer(digits: str) -> int | float:
    """An integer; infinite where no float can hold it, which every range refuses."""
    return int(digits) if len(digits) <= 300 else float(digits)


# An unfinished string runs to the end, so that each character is looked at once.
_STRING = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"?', re.DOTALL)


def _check_json(text: str, path, what: str) -> None:
    opened = text.count("[") + text.count("{")
    if opened <= JSON_DEPTH and text.count(",") <= JSON_VALUES // 2:
        return
    bare = np.frombuffer(_STRING.sub("", text).encode("ascii", "ignore"), np.uint8)
    up, down = (bare == 0x5B) | (bare == 0x7B), (bare == 0x5D) | (bare == 0x7D)
    values = int(up.sum()) + int((bare == 0x2C).sum())
    if values > JSON_VALUES:
        raise NergError(
            f'the {what} "{path}" holds more than the {JSON_VALUES:,} values that are read; give a smaller one'
        )
    brackets = np.where(up, 1, -1)[up | down]
    depth = int(np.cumsum(brackets, dtype=np.int64).max(initial=0))
    if depth > JSON_DEPTH:
        raise NergError(
            f'the {what} "{path}" is nested {depth:,} deep, and at most {JSON_DEPTH} deep is read; make it anew'
        )
