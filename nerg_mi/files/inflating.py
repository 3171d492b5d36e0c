"""Compressed files, inflated only as far as their own size warrants.

Deflate makes up to 1,032 bytes of one. What is inflated may be 100 times the compressed file, and `FREE` bytes in any
case, for an array of zeros is no attack.
"""

from __future__ import annotations

import io
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

from nerg_mi.errors import NergError

from .bounded import plain, reading, size_of

RATIO = 100
"""So many times its own size may a compressed file inflate to."""

FREE = 256 << 20
"""So many bytes it may inflate to whatever its size."""

DIRECTORY_BYTES = 8 << 20
"""A zip archive's list of members may have so many bytes: some 100,000 members."""

_CHUNK = 1 << 20
_GZIP = 16 + zlib.MAX_WBITS
# Bytes of a gzip file without any that come out: its header with names, and zeros that fill up a tape's block.
_IDLE = 1 << 24
# The most that one byte of a deflate stream can stand for, rounded up.
_DEFLATE = 1100


def inflated_limit(compressed: int) -> int:
    """How many bytes may come out of ``compressed`` bytes."""
    return max(FREE, RATIO * compressed)


class _Bounded(io.RawIOBase):
    """A stream that stops where more comes out of it than ``most`` bytes."""

    def __init__(self, stream, most: int, path, what: str):
        self._stream, self._most, self._path, self._what = stream, most, path, what
        self._taken = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:
        with reading(self._path, self._what):
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
def open_gzip(path: str | os.PathLike, what: str = "file", most: int | None = None) -> Iterator[io.BufferedReader]:
    """The inflated bytes of the gzip file ``path``, as a stream. `NergError`, also from reading it: where it is damaged
    or more than ``most`` bytes (default: `inflated_limit`) come out."""
    most = inflated_limit(size_of(path, what)) if most is None else most
    with reading(path, what):
        file = open(path, "rb")
    with file:
        yield io.BufferedReader(_Bounded(_Members(file), most, path, what), _CHUNK)


@contextmanager
def open_zip(path: str | os.PathLike, what: str = "file", most: int | None = None) -> Iterator[zipfile.ZipFile]:
    """The zip archive ``path``, whose members claim no more than ``most`` bytes together (default: `inflated_limit`).

    `NergError` for one that is damaged, encrypted, or too large. Read its members by `read_member` or `member_into`,
    which do not trust what a member claims.
    """
    size = size_of(path, what)
    most = inflated_limit(size) if most is None else most
    with reading(path, what):
        listed = _directory_bytes(path, size)
    if listed > DIRECTORY_BYTES:
        raise NergError(
            f'the {what} "{path}" lists members over {listed:,} bytes, more than the {DIRECTORY_BYTES:,} that are '
            "read; give one with fewer members"
        )
    with reading(path, what):
        archive = zipfile.ZipFile(path)
    with archive:
        members = archive.infolist()
        if len({m.filename for m in members}) != len(members):
            raise NergError(f'the {what} "{path}" holds two members of one name; make it anew')
        if any(m.flag_bits & 1 for m in members):
            raise NergError(f'the {what} "{path}" is encrypted; give it without a password')
        if sum(m.file_size for m in members) > most:
            raise _too_large(path, what, most)
        yield archive


def read_member(archive: zipfile.ZipFile, name: str, path: str | os.PathLike, what: str = "file") -> bytearray:
    """The bytes of the member ``name`` of an archive of `open_zip`."""
    stream, size = open_member(archive, name, path, what)
    out = bytearray(size)
    with stream:
        member_into(stream, memoryview(out), path, what)
    return out


def open_member(
    archive: zipfile.ZipFile, name: str, path: str | os.PathLike, what: str = "file"
) -> tuple[IO[bytes], int]:
    """``(stream, size)`` of the member ``name``: the size is what it claims, where its compressed bytes can come to so
    much.
    """
    with reading(path, what):
        info = archive.getinfo(name)
        stream = archive.open(info)
        file: Any = archive.fp
        whole = os.fstat(file.fileno()).st_size
    if info.file_size > _DEFLATE * info.compress_size + _DEFLATE or info.header_offset + info.compress_size > whole:
        stream.close()
        raise NergError(
            f'the member "{plain(info.filename)}" of the {what} "{path}" claims {info.file_size:,} bytes, to which the '
            f"{min(info.compress_size, whole):,} that are there do not inflate; copy the file again"
        )
    return stream, info.file_size


def member_into(stream, out: memoryview, path: str | os.PathLike, what: str = "file") -> None:
    """Fill ``out`` (bytes) from ``stream``, in pieces: asked for all at once, zlib makes room for all that it finds."""
    at = 0
    with reading(path, what):
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
    none.
    """
    with open(path, "rb") as file:
        start = max(0, size - 65557 - 20)
        file.seek(start)
        tail = file.read()
        end = tail.rfind(b"PK\5\6")
        if end < 0 or len(tail) < end + 22:
            raise zipfile.BadZipFile("it is not a zip archive, or not a whole one")
        claims = [struct.unpack_from("<I", tail, end + 12)[0]]
        if end >= 20 and tail[end - 20 : end - 16] == b"PK\6\7":
            # Zip64: the locator says where the wider record is, but some readers take the bytes right before it.
            for at in (struct.unpack_from("<Q", tail, end - 12)[0], start + end - 76):
                if 0 <= at <= size - 56:
                    file.seek(at)
                    wide = file.read(56)
                    if wide[:4] == b"PK\6\6":
                        claims.append(struct.unpack_from("<Q", wide, 40)[0])
    # All ones in the narrow record stand for the wide one.
    return max(claims[1:] if claims[0] == 0xFFFFFFFF and len(claims) > 1 else claims)
