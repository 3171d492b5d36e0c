"""Reading of files within limits: regular files only, bounded sizes of files, archives, lines and arrays."""

from __future__ import annotations

import codecs
import dis
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

from nerg_mi.errors import MissingFile, NergError, format_error, sanitize

# ---- Files and JSON ----
#
# Protection against damaged and malicious files. A reader first compares claimed sizes with the size of the file and
# with the limits of this module, and only then allocates memory. Errors are one sentence. Compressed files and NumPy
# files follow below; image headers are in `nerg_mi.files.images`.

MAX_JSON_BYTES = 64 << 20  # maximum size of a JSON file in bytes: the poses of about 80,000 frames
MAX_JSON_VALUES = 8_000_000  # maximum number of values in a JSON file; each takes up to 100 bytes of memory
MAX_JSON_DEPTH = 64  # maximum nesting depth of a JSON file; the files of this package have at most six levels

_DAMAGE_ERRORS = (
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

_REMEDY = "copy it again, or create it again"


@contextmanager
def translate_read_errors(
    path: str | os.PathLike,
    file_kind: str = "file",
    remedy: str = _REMEDY,
    extra_errors: tuple[type[Exception], ...] = (),
) -> Iterator[None]:
    """Convert the exceptions that a damaged file causes in the block to one `NergError`.

    A `NergError` and a `TypeError` pass unchanged; the latter is a bug. Keep the block limited to the parsing:
    `KeyError` and `IndexError` are attributed to the file.

    Parameters
    ----------
    path
        The file.
    file_kind
        Name of the kind of file; the message begins with it ("the depth file").
    remedy
        End of the message: what the user can do.
    extra_errors
        Further exceptions that only the file can cause.
    """
    try:
        yield
    except NergError as error:
        if reason := find_other_content(path):
            raise NergError(f'the {file_kind} "{path}" {reason}') from error
        raise
    except FileNotFoundError as error:
        raise MissingFile(f'there is no {file_kind} "{path}"; correct its name') from error
    except (*_DAMAGE_ERRORS, *extra_errors) as error:
        reason = f"cannot be read: {_add_remedy(error, remedy)}"
        raise NergError(f'the {file_kind} "{path}" {find_other_content(path) or reason}') from error
    except Exception as error:
        # Compared by name, so that safetensors is not imported here.
        if type(error).__name__ != "SafetensorError":
            raise
        raise NergError(f'the {file_kind} "{path}" cannot be read: {describe_error(error)}; {remedy}') from error


# Beginnings of files of which no reader expects the content, whatever their name says, and their remedies.
_OTHER_CONTENT = {
    b"version https://git-lfs": 'is a pointer of Git LFS; get the file (run "git lfs pull")',
    b"<!doctype html": "is a web page; download the file itself",
    b"<html": "is a web page; download the file itself",
    b"\x1f\x8b": "is compressed with gzip; decompress it",
    b"BZh": "is compressed with bzip2; decompress it",
    b"\xfd7zXZ": "is compressed with xz; decompress it",
    b"\x28\xb5\x2f\xfd": "is compressed with Zstandard; decompress it",
    b"PK\x03\x04": "is a zip archive or an Excel workbook; extract it, or export its table as CSV",
    b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1": "is an Excel workbook; export its table as CSV",
    b"PAR1": "is a Parquet table; give it a name that ends in .parquet",
    b"SQLite format 3": "is a database; export its table as CSV",
    b"%PDF": "is a PDF; export its content in the needed format",
}
# Formats that begin like one of these.
_COMPRESSED_SUFFIXES = (".gz", ".spz", ".npz", ".sog", ".pth", ".pt", ".parquet")


def find_other_content(path: str | os.PathLike) -> str | None:
    """Return what a file that cannot be read is instead, with the remedy; None if that is unknown."""
    if str(path).lower().endswith(_COMPRESSED_SUFFIXES) or not os.path.isfile(path):
        return None
    try:
        with open(path, "rb") as file:
            head = file.read(32).lstrip().lower()
    except OSError:
        return None
    return next((reason for start, reason in _OTHER_CONTENT.items() if head.startswith(start.lower())), None)


# Messages of Python that name a value or a key, and what is said instead.
_VALUE_MESSAGES = (
    (r"could not convert string to float: (.*)", "it has {} in place of a number"),
    (r"invalid literal for int\(\) with base \d+: (.*)", "it has {} in place of a number"),
    (r".*got an unexpected keyword argument '(.*)'", 'it has an unknown entry "{}"'),
    (r".*missing \d+ required (?:positional|keyword-only) arguments?: '(\w+)'.*", 'it lacks "{}"'),
)


def describe_error(error: BaseException) -> str:
    """Return what is wrong with a file whose reading raised ``error``; no message of Python itself, such as "list index
    out of range", which does not name a cause.
    """
    if isinstance(error, MemoryError):
        return "it needs more memory than is available"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, (EOFError, struct.error)):
        return "it is truncated"
    if isinstance(error, zlib.error):
        return "its compressed data are damaged"
    if isinstance(error, UnicodeDecodeError):
        return "it is not UTF-8 text"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror[:1].lower() + error.strerror[1:]
    if isinstance(error, KeyError):
        key = sanitize("".join(map(str, error.args)), 100).rstrip(".")
        # Libraries raise it with a sentence.
        return key if " " in key else f'it lacks "{key}"'
    is_built_in = type(error) in (IndexError, TypeError, AttributeError, OverflowError, ValueError)
    if is_built_in and not _has_raise_statement(error):
        for pattern, sentence in _VALUE_MESSAGES:
            if match := re.fullmatch(pattern, str(error), re.DOTALL):
                return sentence.format(sanitize(match[1], 60))
        if isinstance(error, OverflowError):
            return "a number is too large"
        return "a value is missing, or has another type or size than its format requires"
    return sanitize(format_error(error)).rstrip(".")


def _has_raise_statement(error: BaseException) -> bool:
    """Return whether a statement ``raise`` of Python code, and not compiled code, raised ``error``."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None:
        return True
    code = trace.tb_frame.f_code.co_code
    return trace.tb_lasti < len(code) and code[trace.tb_lasti] == dis.opmap["RAISE_VARARGS"]


_OWN_REMEDY = re.compile(r"; (convert|export|save) ")


def _add_remedy(error: BaseException, remedy: str) -> str:
    """Return what is wrong with a file whose reading raised ``error``, with the remedy: the error's own if it names
    one."""
    if isinstance(error, PermissionError):
        remedy = "change its permissions"
    if isinstance(error, (IsADirectoryError, NotADirectoryError)):
        remedy = "specify a file"
    text = describe_error(error)
    return text if _OWN_REMEDY.search(text) else f"{text}; {remedy}"


_FILE_KINDS = {
    stat.S_IFDIR: ("a folder", "specify a file"),
    stat.S_IFIFO: ("a pipe", "write its output to a file, and specify that file"),
    stat.S_IFSOCK: ("a socket", "specify a file"),
    stat.S_IFCHR: ("a device", "specify a file"),
    stat.S_IFBLK: ("a device", "specify a file"),
}


def is_count(value: object) -> bool:
    """Return whether ``value``, read from a file, is a non-negative integer below 2^62."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 62


def check_regular_file(path: str | os.PathLike, file_kind: str = "file", max_bytes: int | None = None) -> int:
    """Return the size of the regular file ``path`` in bytes.

    Raises `NergError` for a folder, a device or a pipe, and for a file of more than ``max_bytes``. Reading a pipe may
    block forever, and a device may have no end. Each path is therefore checked before this package or a library opens
    it. Links are followed: ``/dev/stdin`` is accepted if it is a file.
    """
    with translate_read_errors(path, file_kind):
        # The name may contain characters that are invalid in file names, such as a zero byte.
        status = os.stat(path)
    if not stat.S_ISREG(status.st_mode):
        kind, remedy = _FILE_KINDS.get(stat.S_IFMT(status.st_mode), ("not a regular file", "specify a file"))
        raise NergError(f'the {file_kind} "{path}" is {kind}; {remedy}')
    if max_bytes is not None and status.st_size > max_bytes:
        raise NergError(
            f'the {file_kind} "{path}" has {status.st_size:,} bytes; the limit is {max_bytes:,}; use a smaller file'
        )
    return status.st_size


def is_regular_file(path: Path, file_kind: str = "file") -> bool:
    """Return whether ``path`` is a regular file; false for a folder. Raises `NergError` for a device, a pipe or a
    socket.
    """
    if path.is_file():
        return True
    if path.exists() and not path.is_dir():
        check_regular_file(path, file_kind)
    return False


def resolve_path(path: str | os.PathLike) -> Path:
    """Return ``path`` as an absolute path without links.

    Circular links are kept, so that opening the file reports them. `Path.resolve` raises ``RuntimeError`` for them
    before Python 3.13.
    """
    return Path(os.path.realpath(path))


@contextmanager
def open_file(
    path: str | os.PathLike, file_kind: str = "file", remedy: str = _REMEDY, max_bytes: int | None = None
) -> Iterator[BinaryIO]:
    """Open the regular file ``path`` for reading in the block; see `check_regular_file` and `translate_read_errors`."""
    check_regular_file(path, file_kind, max_bytes)
    with translate_read_errors(path, file_kind, remedy), open(path, "rb") as file:
        yield file


def read_bytes(path: str | os.PathLike, file_kind: str, max_bytes: int) -> bytes:
    """Read the complete regular file ``path``, of at most ``max_bytes``. Use `open_file` for files that may not
    fit in memory.
    """
    with open_file(path, file_kind, max_bytes=max_bytes) as file:
        return file.read()


def read_text(path: str | os.PathLike, file_kind: str, max_bytes: int) -> str:
    """Read the UTF-8 file ``path`` without its byte order mark, if it has one; see `read_bytes`."""
    raw = read_bytes(path, file_kind, max_bytes)
    with translate_read_errors(path, file_kind, "save it as UTF-8"):
        return raw[measure_byte_order_mark(raw[:4], path, file_kind) :].decode()


# The four bytes of UTF-32 begin like UTF-16.
_OTHER_MARKS = {
    codecs.BOM_UTF32_LE: "UTF-32",
    codecs.BOM_UTF32_BE: "UTF-32",
    codecs.BOM_UTF16_LE: "UTF-16",
    codecs.BOM_UTF16_BE: "UTF-16",
}


def measure_byte_order_mark(head: bytes, path: str | os.PathLike, file_kind: str) -> int:
    """Return the number of bytes to skip at the ``head`` of a text file: 3 for the byte order mark of UTF-8, else 0.

    Raises `NergError` for the marks of UTF-16 and UTF-32.
    """
    encoding = next((name for mark, name in _OTHER_MARKS.items() if head.startswith(mark)), None)
    if encoding:
        raise NergError(f'the {file_kind} "{path}" is {encoding} text; save it as UTF-8')
    return len(codecs.BOM_UTF8) if head.startswith(codecs.BOM_UTF8) else 0


def map_bytes(
    path: str | os.PathLike, file_kind: str, max_bytes: int, magic: bytes, remedy: str = _REMEDY
) -> memoryview:
    """Map the regular file ``path``, of at most ``max_bytes``, into memory, so that only accessed parts are read.

    Raises `NergError` for a file that does not begin with ``magic``, after a byte order mark of UTF-8 that some editors
    insert; see `open_file`.
    """
    with open_file(path, file_kind, remedy, max_bytes) as file:
        file.seek(measure_byte_order_mark(file.read(4), path, file_kind))
        if file.read(len(magic)) != magic:
            raise ValueError(f'it does not begin with "{sanitize(magic.decode("latin-1"))}"')
        return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def read_json(path: str | os.PathLike, file_kind: str = "file", max_bytes: int = MAX_JSON_BYTES) -> object:
    """Read the JSON file ``path``. Raises `NergError` for invalid JSON, and for a file that exceeds a limit."""
    return parse_json(read_bytes(path, file_kind, max_bytes), path, file_kind, max_bytes)


def parse_json(
    raw: bytes | memoryview | str, path: str | os.PathLike, file_kind: str = "file", max_bytes: int = MAX_JSON_BYTES
) -> object:
    """Parse the JSON text ``raw`` of the file ``path``.

    Raises `NergError` for invalid JSON, for an object with a key twice, for text of more than ``max_bytes``, nested
    deeper than `MAX_JSON_DEPTH`, or with more than `MAX_JSON_VALUES` values. Integers of more than 300 digits
    become floats.
    """
    if len(raw) > max_bytes:
        raise NergError(
            f'the {file_kind} "{path}" contains a JSON document of {len(raw):,} bytes; the limit is {max_bytes:,}; '
            "use a smaller file"
        )
    with translate_read_errors(path, file_kind, "correct it, or create it again"):
        if not isinstance(raw, str):
            raw = bytes(raw)
            raw = raw.decode(json.detect_encoding(raw))
        _check_json(raw, path, file_kind)
        try:
            return json.loads(raw, parse_int=_parse_integer, object_pairs_hook=_make_object)
        except json.JSONDecodeError as error:
            raise NergError(
                f'the {file_kind} "{path}" is not valid JSON: {sanitize(error)}; correct it, or create it again'
            ) from error


def _make_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make an object. Of a key that occurs twice, Python would silently use the last value."""
    values = dict(pairs)
    if len(values) < len(pairs):
        names = [name for name, _ in pairs]
        repeated = next(name for name in names if names.count(name) > 1)
        raise ValueError(f'it has the key "{sanitize(repeated, 40)}" twice in one object')
    return values


def _parse_integer(digits: str) -> int | float:
    """Parse an integer; infinite if it exceeds the range of a float, so that every range rejects it."""
    return int(digits) if len(digits) <= 300 else float(digits)


# An unterminated string matches up to the end, so that the scan is linear in the length of the text.
_STRING = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"?', re.DOTALL)


def _check_json(text: str, path, file_kind: str) -> None:
    brackets_opened = text.count("[") + text.count("{")
    if brackets_opened <= MAX_JSON_DEPTH and text.count(",") <= MAX_JSON_VALUES // 2:
        return
    structure = np.frombuffer(_STRING.sub("", text).encode("ascii", "ignore"), np.uint8)
    is_opening, is_closing = (structure == 0x5B) | (structure == 0x7B), (structure == 0x5D) | (structure == 0x7D)
    values = int(is_opening.sum()) + int((structure == 0x2C).sum())
    if values > MAX_JSON_VALUES:
        raise NergError(
            f'the {file_kind} "{path}" contains more than {MAX_JSON_VALUES:,} values, the limit; use a smaller file'
        )
    brackets = np.where(is_opening, 1, -1)[is_opening | is_closing]
    depth = int(np.cumsum(brackets, dtype=np.int64).max(initial=0))
    if depth > MAX_JSON_DEPTH:
        raise NergError(
            f'the {file_kind} "{path}" is nested {depth:,} levels deep; the limit is {MAX_JSON_DEPTH}; create it again'
        )


# ---- Compressed files, whose inflated size is limited by the size of the file ----
#
# Deflate expands one byte to up to 1,032 bytes. The inflated size may be 100 times the size of the compressed file, and
# is always allowed up to `MIN_INFLATION_LIMIT`, because an array of zeros is legitimate.

MAX_INFLATION_RATIO = 100  # maximum ratio of the inflated size to the compressed size
MIN_INFLATION_LIMIT = 256 << 20  # inflated size in bytes that is always allowed
MAX_DIRECTORY_BYTES = 8 << 20  # maximum size of the member list of a zip archive in bytes: about 100,000 members
_CHUNK = 1 << 20
_GZIP = 16 + zlib.MAX_WBITS
# Maximum number of consecutive gzip bytes without output: the header with names, and zeros that pad a tape block.
_MAX_IDLE_BYTES = 1 << 24
# Maximum expansion of one byte of a deflate stream, rounded up.
_MAX_DEFLATE_RATIO = 1100


def compute_inflation_limit(compressed: int) -> int:
    """Return the maximum inflated size of ``compressed`` bytes."""
    return max(MIN_INFLATION_LIMIT, MAX_INFLATION_RATIO * compressed)


class _BoundedStream(io.RawIOBase):
    """A stream that raises an error after more than ``max_bytes``."""

    def __init__(self, stream, max_bytes: int, path, file_kind: str):
        self._stream, self._max_bytes, self._path, self._file_kind = stream, max_bytes, path, file_kind
        self._bytes_read = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:
        with translate_read_errors(self._path, self._file_kind):
            data = self._stream.read(min(len(buffer), _CHUNK))
        self._bytes_read += len(data)
        if self._bytes_read > self._max_bytes:
            raise _make_size_error(self._path, self._file_kind, self._max_bytes)
        buffer[: len(data)] = data
        return len(data)


class _GzipMembers(io.RawIOBase):
    """The concatenated contents of the members of the open gzip ``file`` (RFC 1952); zeros may follow each member.

    Python's own reader skips zeros and member names byte by byte, even if there are gigabytes of them.
    """

    def __init__(self, file):
        self._file, self._input, self._is_at_end, self._idle_bytes = file, b"", False, 0
        self._inflater = zlib.decompressobj(_GZIP)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:
        while True:
            if not self._input and not self._is_at_end:
                self._input = self._file.read(_CHUNK)
                self._is_at_end = not self._input
                self._idle_bytes += len(self._input)
            if self._idle_bytes > _MAX_IDLE_BYTES:
                raise ValueError(f"it has more than {_MAX_IDLE_BYTES:,} consecutive bytes without content")
            if self._inflater.eof:
                self._input = self._input.lstrip(b"\0")
                if not self._input:
                    if self._is_at_end:
                        return 0
                    continue
                self._inflater = zlib.decompressobj(_GZIP)
            data = self._inflater.decompress(self._input, len(buffer))
            self._input = self._inflater.unused_data if self._inflater.eof else self._inflater.unconsumed_tail
            if data:
                self._idle_bytes = 0
                buffer[: len(data)] = data
                return len(data)
            if self._is_at_end and not self._inflater.eof:
                raise EOFError


def _make_size_error(path, file_kind: str, max_bytes: int) -> NergError:
    return NergError(
        f'the {file_kind} "{path}" inflates to more than {max_bytes:,} bytes, the limit for its size; '
        "decompress it first"
    )


@contextmanager
def open_gzip(
    path: str | os.PathLike, file_kind: str = "file", max_bytes: int | None = None
) -> Iterator[io.BufferedReader]:
    """Open the gzip file ``path`` as a stream of its inflated bytes.

    Opening and reading raise `NergError` if the file is damaged, or inflates to more than ``max_bytes`` (default:
    `compute_inflation_limit`).
    """
    max_bytes = compute_inflation_limit(check_regular_file(path, file_kind)) if max_bytes is None else max_bytes
    with translate_read_errors(path, file_kind):
        file = open(path, "rb")
    with file:
        yield io.BufferedReader(_BoundedStream(_GzipMembers(file), max_bytes, path, file_kind), _CHUNK)


@contextmanager
def open_zip(
    path: str | os.PathLike, file_kind: str = "file", max_bytes: int | None = None
) -> Iterator[zipfile.ZipFile]:
    """Open the zip archive ``path``, whose members claim at most ``max_bytes`` in total (default:
    `compute_inflation_limit`).

    Raises `NergError` for an archive that is damaged, encrypted, or too large. Read the members with `read_member` or
    `read_into`, which do not trust the claimed sizes.
    """
    size = check_regular_file(path, file_kind)
    max_bytes = compute_inflation_limit(size) if max_bytes is None else max_bytes
    with translate_read_errors(path, file_kind):
        directory_bytes = _count_directory_bytes(path, size)
    if directory_bytes > MAX_DIRECTORY_BYTES:
        raise NergError(
            f'the {file_kind} "{path}" has a member list of {directory_bytes:,} bytes; the limit is '
            f"{MAX_DIRECTORY_BYTES:,}; "
            "use an archive with fewer members"
        )
    with translate_read_errors(path, file_kind):
        archive = zipfile.ZipFile(path)
    with archive:
        members = archive.infolist()
        if len({m.filename for m in members}) != len(members):
            raise NergError(f'the {file_kind} "{path}" contains two members with the same name; create it again')
        if any(m.flag_bits & 1 for m in members):
            raise NergError(f'the {file_kind} "{path}" is encrypted; save it without a password')
        if sum(m.file_size for m in members) > max_bytes:
            raise _make_size_error(path, file_kind, max_bytes)
        yield archive


def read_member(archive: zipfile.ZipFile, name: str, path: str | os.PathLike, file_kind: str = "file") -> bytearray:
    """Read the member ``name`` of an archive of `open_zip`."""
    stream, size = open_member(archive, name, path, file_kind)
    out = bytearray(size)
    with stream:
        read_into(stream, memoryview(out), path, file_kind)
    return out


def open_member(
    archive: zipfile.ZipFile, name: str, path: str | os.PathLike, file_kind: str = "file"
) -> tuple[IO[bytes], int]:
    """Open the member ``name``. Returns ``(stream, size)``, where size is the claimed size.

    Raises `NergError` if the member extends beyond the end of the file, or its compressed bytes cannot inflate to the
    claimed size.
    """
    with translate_read_errors(path, file_kind):
        info = archive.getinfo(name)
        stream = archive.open(info)
        file: Any = archive.fp
        archive_bytes = os.fstat(file.fileno()).st_size
    member = f'the member "{sanitize(info.filename)}"'
    if info.header_offset + info.compress_size > archive_bytes:
        stream.close()
        raise NergError(f'the {file_kind} "{path}" is truncated: {member} extends beyond its end; copy the file again')
    if info.file_size > _MAX_DEFLATE_RATIO * info.compress_size + _MAX_DEFLATE_RATIO:
        stream.close()
        raise NergError(
            f'{member} of the {file_kind} "{path}" claims {info.file_size:,} bytes, but its {info.compress_size:,} '
            "compressed bytes cannot inflate to that size; copy the file again"
        )
    return stream, info.file_size


def read_into(stream, out: memoryview, path: str | os.PathLike, file_kind: str = "file") -> None:
    """Fill ``out`` (bytes) from ``stream`` in chunks. A single large read would make zlib allocate space for the
    entire output.
    """
    position = 0
    with translate_read_errors(path, file_kind):
        while position < len(out):
            data = stream.read(min(_CHUNK, len(out) - position))
            if not data:
                raise EOFError
            out[position : position + len(data)] = data
            position += len(data)
        # The checksum of a member is verified at its end.
        stream.read(1)


def _count_directory_bytes(path, size: int) -> int:
    """Return the size of the member list of a zip archive, which Python's reader loads completely.

    Raises ``BadZipFile`` if the file is not a zip archive, or if the list does not end where the end records begin:
    other readers could then find a different list.
    """
    with open(path, "rb") as file:
        start = max(0, size - 65557 - 20)
        file.seek(start)
        tail = file.read()
        end = tail.rfind(b"PK\5\6")
        if end < 0 or len(tail) < end + 22:
            raise zipfile.BadZipFile("it is not a zip archive, or is truncated")
        (length, offset), records_offset = struct.unpack_from("<II", tail, end + 12), start + end
        if end >= 20 and tail[end - 20 : end - 16] == b"PK\6\7":
            # Zip64: some readers find the larger record through the locator, others directly before the locator.
            records_offset -= 76
            file.seek(max(records_offset, 0))
            zip64_record = file.read(56)
            if zip64_record[:4] != b"PK\6\6" or struct.unpack_from("<Q", tail, end - 12)[0] != records_offset:
                raise zipfile.BadZipFile("its end record is not at the stated position")
            length, offset = struct.unpack_from("<QQ", zip64_record, 40)
    if offset + length != records_offset:
        raise zipfile.BadZipFile("its member list is not at the stated position")
    return length


# ---- Lines of large text files ----
#
# Lines are read in blocks, from plain or gzip files, so that memory stays bounded.

MAX_LINE_LENGTH = 1 << 20  # maximum length of a line of a tracking file; HoloLens 2 writes 17,000 characters
_BLOCK_CHARACTERS = 1 << 24
_LINE_BLOCKS_CHUNK = 1 << 22

BadLineCallback = Callable[[int, str], None]
"""Callback for an unreadable line: its number, from 1, and the reason. Without a callback, readers raise
`NergError`."""


def read_line_blocks(path: str | os.PathLike, file_kind: str, max_lines: int) -> Generator[list[str], None, None]:
    """Read the lines of a UTF-8 file, or of one whose byte order mark states another encoding (as Excel's Unicode
    text), with their line ends, in blocks. The mark is skipped. A file whose name ends in ``.gz`` is decompressed.

    Parameters
    ----------
    path
        The file.
    file_kind
        Name of the kind of file in error messages.
    max_lines
        Maximum number of lines in a block. A block has at most about 16 million characters.

    Raises
    ------
    NergError
        For a file that is damaged or not UTF-8, and for a line of more than `MAX_LINE_LENGTH` characters.
    """
    decoder, remainder, pending, count, characters = None, "", [], 0, 0
    with _open_plain_or_gzip(path, file_kind) as source:
        is_at_end = False
        while not is_at_end:
            with translate_read_errors(path, file_kind):
                data = source.read(_LINE_BLOCKS_CHUNK)
            is_at_end = not data
            if decoder is None:
                encoding = next((name for mark, name in _OTHER_MARKS.items() if data.startswith(mark)), "utf-8-sig")
                decoder = codecs.getincrementaldecoder(encoding)()
            try:
                text = remainder + decoder.decode(data, final=is_at_end)
            except UnicodeDecodeError as error:
                reason = f"is not {error.encoding.upper()} text ({error.reason}); save it as UTF-8"
                raise NergError(f'the {file_kind} "{path}" {find_other_content(path) or reason}') from error
            # Split at \n, \r or \r\n, but not at the other characters at which str.splitlines splits.
            lines = io.StringIO(text, newline="").readlines()
            # The last line may continue in the next chunk, or end in the \r of a \r\n.
            remainder = "" if is_at_end or not lines else lines.pop()
            if max(map(len, [*lines, remainder])) > MAX_LINE_LENGTH:
                index = next(k for k, line in enumerate([*lines, remainder]) if len(line) > MAX_LINE_LENGTH)
                raise NergError(
                    f'line {count + len(pending) + index + 1} of the {file_kind} "{path}" has more than '
                    f"{MAX_LINE_LENGTH:,} "
                    "characters, the limit; is it a text file?"
                )
            pending += lines
            characters += len(text) - len(remainder)
            while len(pending) >= max_lines or (pending and (is_at_end or characters >= _BLOCK_CHARACTERS)):
                block, pending = pending[:max_lines], pending[max_lines:]
                count += len(block)
                characters = sum(map(len, pending))
                yield block


@contextmanager
def _open_plain_or_gzip(path: str | os.PathLike, file_kind: str) -> Iterator[IO[bytes]]:
    if str(path).lower().endswith(".gz"):
        with open_gzip(path, file_kind) as source:
            yield source
        return
    check_regular_file(path, file_kind)
    with translate_read_errors(path, file_kind):
        source = open(path, "rb")
    with source:
        yield source


# ---- NumPy files ----
#
# The header of an .npy or .npz file is compared with the available bytes before an array is allocated.

MAX_NPY_HEADER_BYTES = 10_000  # maximum size of the header of an array in bytes


class NpzReader:
    """The arrays of an open .npz archive. Each array is read on access.

    ``names`` lists the arrays. ``archive[name]`` raises `KeyError` for an unknown name, and `NergError` for an array
    that is damaged or contains Python objects.
    """

    def __init__(self, archive: zipfile.ZipFile, path: str | os.PathLike, file_kind: str):
        self._archive, self._path, self._file_kind = archive, path, file_kind
        self._members = {n.removesuffix(".npy"): n for n in archive.namelist()}

    @property
    def names(self) -> list[str]:
        return list(self._members)

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def __getitem__(self, name: str) -> np.ndarray:
        """Read the array ``name``."""
        member, array_kind = self._members[name], f'array "{sanitize(name)}" of the {self._file_kind}'
        stream, size = open_member(self._archive, member, self._path, self._file_kind)
        with stream:
            return _read_array(stream, size, self._path, array_kind)

    def read_header(self, name: str) -> tuple[tuple[int, ...], np.dtype]:
        """Return the shape and the dtype of the array ``name``, from its header."""
        member, array_kind = self._members[name], f'array "{sanitize(name)}" of the {self._file_kind}'
        stream, size = open_member(self._archive, member, self._path, self._file_kind)
        with stream:
            shape, _, dtype = _read_npy_header(stream, size, self._path, array_kind)
        return shape, dtype


@contextmanager
def open_npz(path: str | os.PathLike, file_kind: str = "file", max_bytes: int | None = None) -> Iterator[NpzReader]:
    """Open the .npz archive ``path``.

    Raises `NergError` if it is damaged, or inflates to more than ``max_bytes`` (default: `compute_inflation_limit`).
    """
    with open_zip(path, file_kind, max_bytes) as archive:
        yield NpzReader(archive, path, file_kind)


def read_npz(path: str | os.PathLike, file_kind: str = "file", max_bytes: int | None = None) -> dict[str, np.ndarray]:
    """Read all arrays of the .npz archive ``path`` by name; see `open_npz`."""
    with open_npz(path, file_kind, max_bytes) as archive:
        return {name: archive[name] for name in archive.names}


def read_npy(path: str | os.PathLike, file_kind: str = "file") -> np.ndarray:
    """Read the array in the .npy file ``path``.

    Raises `NergError` if the file is damaged, claims more data than it has, or contains Python objects, whose loading
    would run code.
    """
    size = check_regular_file(path, file_kind)
    with translate_read_errors(path, file_kind):
        stream = open(path, "rb")
    with stream:
        return _read_array(stream, size, path, file_kind)


def _read_array(stream, size: int, path, file_kind: str) -> np.ndarray:
    shape, is_fortran_order, dtype = _read_npy_header(stream, size, path, file_kind)
    with translate_read_errors(path, file_kind):
        out = np.empty(math.prod(shape), dtype)
        if out.size:
            read_into(stream, out.view(np.uint8).data, path, file_kind)
        return out.reshape(shape[::-1]).T if is_fortran_order else out.reshape(shape)


def _read_npy_header(stream, size: int, path, file_kind: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Read the shape, whether the array is in Fortran order, and the dtype. The stream is then at the first number."""
    with translate_read_errors(path, file_kind, extra_errors=(TypeError,)):
        version = np.lib.format.read_magic(stream)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
        if read is None:
            raise NergError(
                f'the {file_kind} "{path}" has format version {version[0]}.{version[1]}; versions 1.0 and 2.0 are '
                "supported; "
                "save it again with numpy.save"
            )
        shape, is_fortran_order, dtype = read(stream, max_header_size=MAX_NPY_HEADER_BYTES)
        header_bytes = stream.tell()
    if dtype.hasobject:
        raise NergError(
            f'the {file_kind} "{path}" contains Python objects, which are not loaded because they can run code; save '
            "it as numbers"
        )
    if any(n < 0 for n in shape) or len(shape) > 32 or (dtype.itemsize == 0 and math.prod(shape)):
        raise NergError(
            f'the {file_kind} "{path}" claims the shape {sanitize(shape)} of {sanitize(dtype)}, which is invalid; '
            "create it again"
        )
    needed, available = math.prod(shape) * dtype.itemsize, size - header_bytes
    if needed > available:
        raise NergError(
            f'the {file_kind} "{path}" claims the shape {sanitize(shape)} of {sanitize(dtype)}, {needed:,} bytes, '
            f"but has {available:,} bytes; copy it again, or create it again"
        )
    return shape, is_fortran_order, dtype
