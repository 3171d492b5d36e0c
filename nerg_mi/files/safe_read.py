"""Files read within bounds: regular files only, limits on bytes, archives, lines and arrays."""

from __future__ import annotations

import codecs
import gzip
import io
import json
import lzma
import math
import mmap
import os
import pickle
import re
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np

from nerg_mi.errors import MissingFile, NergError, sanitize, format_error

# ---- Bounded ----
#
# What every reader of a file needs against a damaged or hostile one: limits before allocation, and one sentence after.
#
# A reader asks first how large things are, by the bytes that are there and by the limits stated here, and only then
# makes room for them. Compressed files and NumPy's follow below; headers of pictures: `nerg_mi.files.images`.

MAX_JSON_BYTES = 64 << 20  # a JSON file may have so many bytes: the poses of some 80,000 frames
MAX_JSON_VALUES = 8_000_000  # so many values may stand in it: each takes up to 100 bytes of memory
MAX_JSON_DEPTH = 64  # so deep may arrays and objects be nested; what this package reads is six deep at most

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
def translate_read_errors(
    path: str | os.PathLike, file_kind: str = "file", remedy: str = _REMEDY, extra_errors: tuple[type[Exception], ...] = ()
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
        raise MissingFile(f'there is no {file_kind} "{path}"; correct its name') from error
    except (*_DAMAGED, *extra_errors) as error:
        raise NergError(f'the {file_kind} "{path}" cannot be read: {_said(error)}; {_remedy(error, remedy)}') from error
    except Exception as error:
        # The library is imported by those who read its files: without it the exception cannot be one of its own.
        if type(error).__name__ != "SafetensorError":
            raise
        raise NergError(f'the {file_kind} "{path}" cannot be read: {_said(error)}; {remedy}') from error


def _said(error: BaseException) -> str:
    if isinstance(error, MemoryError):
        return "it needs more memory than there is"
    if isinstance(error, RecursionError):
        return "it is nested too deep"
    if isinstance(error, EOFError):
        return "it ends too early"
    if isinstance(error, KeyError):
        return f"it lacks {sanitize(error)}"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror[:1].lower() + error.strerror[1:]
    return sanitize(format_error(error)).rstrip(".")


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


def check_regular_file(path: str | os.PathLike, file_kind: str = "file", max_bytes: int | None = None) -> int:
    """Bytes of the ordinary file ``path``; `NergError` for a folder, a device or a pipe, and beyond ``most`` bytes.

    A pipe may keep its reader waiting for ever, and a device may have no end. So every path is checked by this before
    it is opened, here or by a library. A link counts as what it leads to: ``/dev/stdin`` is read where it is a file.
    """
    with translate_read_errors(path, file_kind):
        # A name may hold what no file's can, such as a zero byte.
        found = os.stat(path)
    if not stat.S_ISREG(found.st_mode):
        kind, remedy = _KINDS.get(stat.S_IFMT(found.st_mode), ("no ordinary file", "give the name of a file"))
        raise NergError(f'the {file_kind} "{path}" is {kind}; {remedy}')
    if max_bytes is not None and found.st_size > max_bytes:
        raise NergError(
            f'the {file_kind} "{path}" has {found.st_size:,} bytes, more than the {max_bytes:,} that are read; give a smaller one'
        )
    return found.st_size


def is_regular_file(path: Path, file_kind: str = "file") -> bool:
    """Whether there is an ordinary file ``path``; a folder is none. `NergError` for a device, a pipe or a socket, which
    is no missing file."""
    if path.is_file():
        return True
    if path.exists() and not path.is_dir():
        check_regular_file(path, file_kind)
    return False


def resolve_path(path: str | os.PathLike) -> Path:
    """``path``, absolute and without links. Links that lead in a circle stay: what opens them says so, where
    `Path.resolve` of Python before 3.13 raises a ``RuntimeError``."""
    return Path(os.path.realpath(path))


@contextmanager
def open_file(
    path: str | os.PathLike, file_kind: str = "file", remedy: str = _REMEDY, max_bytes: int | None = None
) -> Iterator[BinaryIO]:
    """The ordinary file ``path``, open to be read in the block; see `size_of`, and `reading` for errors of the
    block."""
    check_regular_file(path, file_kind, max_bytes)
    with translate_read_errors(path, file_kind, remedy), open(path, "rb") as file:
        yield file


def read_bytes(path: str | os.PathLike, file_kind: str, max_bytes: int) -> bytes:
    """The bytes of the ordinary file ``path``, at most ``most``; see `size_of`. All of them are held: read what may be
    larger than its reader can hold by `open_file`."""
    with open_file(path, file_kind, max_bytes=max_bytes) as file:
        return file.read()


def map_bytes(path: str | os.PathLike, file_kind: str, max_bytes: int, magic: bytes, remedy: str = _REMEDY) -> memoryview:
    """The bytes of the ordinary file ``path``, at most ``most``, each read when it is used: what is not used takes no
    memory. `NergError` for a file that does not begin with ``start``; see `open_file`."""
    with open_file(path, file_kind, remedy, max_bytes) as file:
        if file.read(len(magic)) != magic:
            raise ValueError(f'it does not begin with "{sanitize(magic.decode("latin-1"))}", as such a file does')
        return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def read_json(path: str | os.PathLike, file_kind: str = "file", max_bytes: int = MAX_JSON_BYTES) -> object:
    """The JSON document ``path``. `NergError` for what is none, is larger than ``most`` bytes or is nested too deep."""
    return parse_json(read_bytes(path, file_kind, max_bytes), path, file_kind, max_bytes)


def parse_json(
    raw: bytes | memoryview | str, path: str | os.PathLike, file_kind: str = "file", max_bytes: int = MAX_JSON_BYTES
) -> object:
    """The JSON document ``raw``, which stood in ``path``. `NergError` for what is none, is nested deeper than
    `JSON_DEPTH` or holds more than `JSON_VALUES` values. Integers of hundreds of digits are floats."""
    if len(raw) > max_bytes:
        raise NergError(
            f'the {file_kind} "{path}" holds a JSON document of {len(raw):,} bytes, more than the {max_bytes:,} that are read; '
            "give a smaller one"
        )
    with translate_read_errors(path, file_kind, "correct it, or make it anew"):
        if not isinstance(raw, str):
            raw = bytes(raw)
            raw = raw.decode(json.detect_encoding(raw))
        _check_json(raw, path, file_kind)
        try:
            return json.loads(raw, parse_int=_integer)
        except json.JSONDecodeError as error:
            raise NergError(
                f'the {file_kind} "{path}" is not valid JSON: {sanitize(error)}; correct it, or make it anew'
            ) from error


def _integer(digits: str) -> int | float:
    """An integer; infinite where no float can hold it, which every range refuses."""
    return int(digits) if len(digits) <= 300 else float(digits)


# An unfinished string runs to the end, so that each character is looked at once.
_STRING = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"?', re.DOTALL)


def _check_json(text: str, path, what: str) -> None:
    opened = text.count("[") + text.count("{")
    if opened <= MAX_JSON_DEPTH and text.count(",") <= MAX_JSON_VALUES // 2:
        return
    bare = np.frombuffer(_STRING.sub("", text).encode("ascii", "ignore"), np.uint8)
    up, down = (bare == 0x5B) | (bare == 0x7B), (bare == 0x5D) | (bare == 0x7D)
    values = int(up.sum()) + int((bare == 0x2C).sum())
    if values > MAX_JSON_VALUES:
        raise NergError(
            f'the {what} "{path}" holds more than the {MAX_JSON_VALUES:,} values that are read; give a smaller one'
        )
    brackets = np.where(up, 1, -1)[up | down]
    depth = int(np.cumsum(brackets, dtype=np.int64).max(initial=0))
    if depth > MAX_JSON_DEPTH:
        raise NergError(
            f'the {what} "{path}" is nested {depth:,} deep, and at most {MAX_JSON_DEPTH} deep is read; make it anew'
        )


# ---- Compressed files, inflated only as far as their own size warrants ----
#
# Deflate makes up to 1,032 bytes of one. What is inflated may be 100 times the compressed file, and `FREE` bytes in any
# case, for an array of zeros is no attack.

MAX_INFLATION_RATIO = 100  # so many times its own size may a compressed file inflate to
MIN_INFLATION_LIMIT = 256 << 20  # so many bytes it may inflate to whatever its size
MAX_DIRECTORY_BYTES = 8 << 20  # a zip archive's list of members may have so many bytes: some 100,000 members
_CHUNK = 1 << 20
_GZIP = 16 + zlib.MAX_WBITS
# Bytes of a gzip file without any that come out: its header with names, and zeros that fill up a tape's block.
_IDLE = 1 << 24
# The most that one byte of a deflate stream can stand for, rounded up.
_DEFLATE = 1100


def compute_inflation_limit(compressed: int) -> int:
    """How many bytes may come out of ``compressed`` bytes."""
    return max(MIN_INFLATION_LIMIT, MAX_INFLATION_RATIO * compressed)


class _Bounded(io.RawIOBase):
    """A stream that stops where more comes out of it than ``most`` bytes."""

    def __init__(self, stream, most: int, path, what: str):
        self._stream, self._most, self._path, self._what = stream, most, path, what
        self._taken = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:
        with translate_read_errors(self._path, self._what):
            data = self._stream.read(min(len(buffer), _CHUNK))
        self._taken += len(data)
        if self._taken > self._most:
            raise _too_large(self._path, self._what, self._most)
        buffer[: len(data)] = data
        return len(data)


class _Members(io.RawIOBase):
    """What the members of the open gzip ``file`` inflate to, one after the other (RFC 1952); zeros may follow each.

    Python's own reader takes zeros and the names of members byte by byte, gigabytes of them as well.
    """

    def __init__(self, file):
        self._file, self._input, self._ended, self._idle = file, b"", False, 0
        self._inflater = zlib.decompressobj(_GZIP)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:
        while True:
            if not self._input and not self._ended:
                self._input = self._file.read(_CHUNK)
                self._ended = not self._input
                self._idle += len(self._input)
            if self._idle > _IDLE:
                raise ValueError(f"it has {_IDLE:,} bytes and more that nothing comes out of")
            if self._inflater.eof:
                self._input = self._input.lstrip(b"\0")
                if not self._input:
                    if self._ended:
                        return 0
                    continue
                self._inflater = zlib.decompressobj(_GZIP)
            data = self._inflater.decompress(self._input, len(buffer))
            self._input = self._inflater.unused_data if self._inflater.eof else self._inflater.unconsumed_tail
            if data:
                self._idle = 0
                buffer[: len(data)] = data
                return len(data)
            if self._ended and not self._inflater.eof:
                raise EOFError


def _too_large(path, what: str, most: int) -> NergError:
    return NergError(
        f'the {what} "{path}" inflates to more than {most:,} bytes, which its size does not warrant; '
        "give it uncompressed"
    )


@contextmanager
def open_gzip(path: str | os.PathLike, file_kind: str = "file", max_bytes: int | None = None) -> Iterator[io.BufferedReader]:
    """The inflated bytes of the gzip file ``path``, as a stream. `NergError`, also from reading it: where it is damaged
    or more than ``most`` bytes (default: `inflated_limit`) come out."""
    max_bytes = compute_inflation_limit(check_regular_file(path, file_kind)) if max_bytes is None else max_bytes
    with translate_read_errors(path, file_kind):
        file = open(path, "rb")
    with file:
        yield io.BufferedReader(_Bounded(_Members(file), max_bytes, path, file_kind), _CHUNK)


@contextmanager
def open_zip(path: str | os.PathLike, file_kind: str = "file", max_bytes: int | None = None) -> Iterator[zipfile.ZipFile]:
    """The zip archive ``path``, whose members claim no more than ``most`` bytes together (default: `inflated_limit`).

    `NergError` for one that is damaged, encrypted, or too large. Read its members by `read_member` or `member_into`,
    which do not trust what a member claims.
    """
    size = check_regular_file(path, file_kind)
    max_bytes = compute_inflation_limit(size) if max_bytes is None else max_bytes
    with translate_read_errors(path, file_kind):
        listed = _directory_bytes(path, size)
    if listed > MAX_DIRECTORY_BYTES:
        raise NergError(
            f'the {file_kind} "{path}" lists members over {listed:,} bytes, more than the {MAX_DIRECTORY_BYTES:,} that are '
            "read; give one with fewer members"
        )
    with translate_read_errors(path, file_kind):
        archive = zipfile.ZipFile(path)
    with archive:
        members = archive.infolist()
        if len({m.filename for m in members}) != len(members):
            raise NergError(f'the {file_kind} "{path}" holds two members of one name; make it anew')
        if any(m.flag_bits & 1 for m in members):
            raise NergError(f'the {file_kind} "{path}" is encrypted; give it without a password')
        if sum(m.file_size for m in members) > max_bytes:
            raise _too_large(path, file_kind, max_bytes)
        yield archive


def read_member(archive: zipfile.ZipFile, name: str, path: str | os.PathLike, file_kind: str = "file") -> bytearray:
    """The bytes of the member ``name`` of an archive of `open_zip`."""
    stream, size = open_member(archive, name, path, file_kind)
    out = bytearray(size)
    with stream:
        read_into(stream, memoryview(out), path, file_kind)
    return out


def open_member(
    archive: zipfile.ZipFile, name: str, path: str | os.PathLike, file_kind: str = "file"
) -> tuple[IO[bytes], int]:
    """``(stream, size)`` of the member ``name``: the size is what it claims, where its compressed bytes can come to so
    much.
    """
    with translate_read_errors(path, file_kind):
        info = archive.getinfo(name)
        stream = archive.open(info)
        file: Any = archive.fp
        whole = os.fstat(file.fileno()).st_size
    if info.file_size > _DEFLATE * info.compress_size + _DEFLATE or info.header_offset + info.compress_size > whole:
        stream.close()
        raise NergError(
            f'the member "{sanitize(info.filename)}" of the {file_kind} "{path}" claims {info.file_size:,} bytes, to which the '
            f"{min(info.compress_size, whole):,} that are there do not inflate; copy the file again"
        )
    return stream, info.file_size


def read_into(stream, out: memoryview, path: str | os.PathLike, file_kind: str = "file") -> None:
    """Fill ``out`` (bytes) from ``stream``, in pieces: asked for all at once, zlib makes room for all that it finds."""
    at = 0
    with translate_read_errors(path, file_kind):
        while at < len(out):
            data = stream.read(min(_CHUNK, len(out) - at))
            if not data:
                raise EOFError
            out[at : at + len(data)] = data
            at += len(data)
        # Only at its end does a member's checksum tell.
        stream.read(1)


def _directory_bytes(path, size: int) -> int:
    """Bytes of a zip archive's list of members, which Python's reader takes in whole. Raises ``BadZipFile`` for what is
    none, and for one in which other readers may find another list: it ends where the records of its end begin.
    """
    with open(path, "rb") as file:
        start = max(0, size - 65557 - 20)
        file.seek(start)
        tail = file.read()
        end = tail.rfind(b"PK\5\6")
        if end < 0 or len(tail) < end + 22:
            raise zipfile.BadZipFile("it is not a zip archive, or not a whole one")
        (length, place), records = struct.unpack_from("<II", tail, end + 12), start + end
        if end >= 20 and tail[end - 20 : end - 16] == b"PK\6\7":
            # Zip64: some readers take the wider record where the locator says it is, others the bytes before it.
            records -= 76
            file.seek(max(records, 0))
            wide = file.read(56)
            if wide[:4] != b"PK\6\6" or struct.unpack_from("<Q", tail, end - 12)[0] != records:
                raise zipfile.BadZipFile("its end is not where it says")
            length, place = struct.unpack_from("<QQ", wide, 40)
    if place + length != records:
        raise zipfile.BadZipFile("its list of members is not where it says")
    return length


# ---- Line blocks ----
#
# Lines of large text files, plain or gzip, in blocks: memory stays bounded whatever the file holds.

MAX_LINE_LENGTH = 1 << 20  # a line of a tracking file may be so long: HoloLens 2 writes 17,000 characters
_BLOCK_CHARACTERS = 1 << 24
_LINE_BLOCKS_CHUNK = 1 << 22

BadLineCallback = Callable[[int, str], None]
"""Told of a line that cannot be read: its number, from 1, and why. Readers that are given none raise `NergError`."""


def read_line_blocks(path: str | os.PathLike, file_kind: str, max_lines: int) -> Generator[list[str], None, None]:
    """Lines of the UTF-8 file ``path`` (inflated where its name ends in ``.gz``) with their ends, in blocks of at most
    ``most`` lines and some 16 million characters.

    ``what``: the kind of file, for messages. Raises `NergError` for a file that is damaged or no UTF-8 text, and for a
    line of more than `LINE_CHARACTERS`.
    """
    decoder, rest, found, count, characters = codecs.getincrementaldecoder("utf-8")(), "", [], 0, 0
    with _opened(path, file_kind) as source:
        ended = False
        while not ended:
            with translate_read_errors(path, file_kind):
                data = source.read(_LINE_BLOCKS_CHUNK)
            ended = not data
            try:
                text = rest + decoder.decode(data, final=ended)
            except UnicodeDecodeError as error:
                raise NergError(f'the {file_kind} "{path}" is no UTF-8 text ({error.reason}); save it as UTF-8') from error
            # As files are split: at \n, \r or both, and not at the many other characters that end lines elsewhere.
            lines = io.StringIO(text, newline="").readlines()
            # The last line may go on, or end in the \r of a \r\n.
            rest = "" if ended or not lines else lines.pop()
            if max(map(len, [*lines, rest])) > MAX_LINE_LENGTH:
                at = next(k for k, line in enumerate([*lines, rest]) if len(line) > MAX_LINE_LENGTH)
                raise NergError(
                    f'line {count + len(found) + at + 1} of the {file_kind} "{path}" has more than the {MAX_LINE_LENGTH:,} '
                    "characters that are read; is it a text file?"
                )
            found += lines
            characters += len(text) - len(rest)
            while len(found) >= max_lines or (found and (ended or characters >= _BLOCK_CHARACTERS)):
                block, found = found[:max_lines], found[max_lines:]
                count += len(block)
                characters = sum(map(len, found))
                yield block


@contextmanager
def _opened(path: str | os.PathLike, what: str) -> Iterator[IO[bytes]]:
    if str(path).lower().endswith(".gz"):
        with open_gzip(path, what) as source:
            yield source
        return
    check_regular_file(path, what)
    with translate_read_errors(path, what):
        source = open(path, "rb")
    with source:
        yield source


# ---- Npy ----
#
# NumPy's files, .npy and .npz: what a header claims is compared with the bytes that are there before an array is
# made.

MAX_NPY_HEADER_BYTES = 10_000  # the header of an array may have so many bytes


class NpzReader:
    """The arrays of an open .npz archive, each read when it is asked for.

    ``names``: of the arrays. ``archive[name]`` raises `KeyError` for a name that is not among them, and `NergError` for
    an array that is damaged or holds Python objects.
    """

    def __init__(self, archive: zipfile.ZipFile, path: str | os.PathLike, what: str):
        self._archive, self._path, self._what = archive, path, what
        self._members = {n.removesuffix(".npy"): n for n in archive.namelist()}

    @property
    def names(self) -> list[str]:
        return list(self._members)

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def __getitem__(self, name: str) -> np.ndarray:
        """The array ``name``."""
        member, what = self._members[name], f'array "{sanitize(name)}" of the {self._what}'
        stream, size = open_member(self._archive, member, self._path, self._what)
        with stream:
            return _array(stream, size, self._path, what)

    def read_header(self, name: str) -> tuple[tuple[int, ...], np.dtype]:
        """Shape and type of the array ``name``, from its header."""
        member, what = self._members[name], f'array "{sanitize(name)}" of the {self._what}'
        stream, size = open_member(self._archive, member, self._path, self._what)
        with stream:
            shape, _, dtype = _header(stream, size, self._path, what)
        return shape, dtype


@contextmanager
def open_npz(path: str | os.PathLike, file_kind: str = "file", max_bytes: int | None = None) -> Iterator[NpzReader]:
    """The arrays of the .npz archive ``path``; `NergError` for one that is damaged, or inflates to more than ``most``
    bytes (default: `safe_read.inflated_limit`)."""
    with open_zip(path, file_kind, max_bytes) as archive:
        yield NpzReader(archive, path, file_kind)


def read_npz(path: str | os.PathLike, file_kind: str = "file", max_bytes: int | None = None) -> dict[str, np.ndarray]:
    """All arrays of the .npz archive ``path`` by name; see `open_npz`."""
    with open_npz(path, file_kind, max_bytes) as archive:
        return {name: archive[name] for name in archive.names}


def read_npy(path: str | os.PathLike, file_kind: str = "file") -> np.ndarray:
    """The array in the .npy file ``path``. `NergError` for one that is damaged, claims more than the file holds, or
    holds Python objects, which only running code could make."""
    size = check_regular_file(path, file_kind)
    with translate_read_errors(path, file_kind):
        stream = open(path, "rb")
    with stream:
        return _array(stream, size, path, file_kind)


def _array(stream, size: int, path, what: str) -> np.ndarray:
    shape, columns_first, dtype = _header(stream, size, path, what)
    with translate_read_errors(path, what):
        out = np.empty(math.prod(shape), dtype)
        if out.size:
            read_into(stream, out.view(np.uint8).data, path, what)
        return out.reshape(shape[::-1]).T if columns_first else out.reshape(shape)


def _header(stream, size: int, path, what: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether the first index runs fastest, and type; the stream then stands at the first number."""
    with translate_read_errors(path, what, extra_errors=(TypeError,)):
        version = np.lib.format.read_magic(stream)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
        if read is None:
            raise NergError(
                f'the {what} "{path}" is of version {version[0]}.{version[1]} of the format, and 1.0 and 2.0 are read; '
                "write it again with numpy.save"
            )
        shape, columns_first, dtype = read(stream, max_header_size=MAX_NPY_HEADER_BYTES)
        taken = stream.tell()
    if dtype.hasobject:
        raise NergError(
            f'the {what} "{path}" holds Python objects, which are not read: they can run code; save it as numbers'
        )
    if any(n < 0 for n in shape) or len(shape) > 32 or (dtype.itemsize == 0 and math.prod(shape)):
        raise NergError(
            f'the {what} "{path}" claims the shape {sanitize(shape)} of {sanitize(dtype)}, which is none; make it anew'
        )
    need, there = math.prod(shape) * dtype.itemsize, size - taken
    if need > there:
        raise NergError(
            f'the {what} "{path}" claims the shape {sanitize(shape)} of {sanitize(dtype)}, {need:,} bytes, '
            f"and has {there:,}; copy it again, or make it anew"
        )
    return shape, columns_first, dtype
