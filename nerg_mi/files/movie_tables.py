"""What the tables of an MP4 or QuickTime file claim, so that FFmpeg makes room for no more samples than its bytes
warrant.

FFmpeg writes a line of its index for each sample that a table tells of, and again for each edit: a few bytes of a table
can tell of billions.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from .bounded import size_of

_CONTAINERS = frozenset(
    b"moov trak mdia minf stbl edts moof traf mvex udta wave tref dinf ilst gmhd".split()  # whose boxes FFmpeg reads
)
# Tables by the bytes of an entry.
_ENTRIES = {b"stts": 8, b"ctts": 8, b"stsc": 12, b"stss": 4, b"stps": 4, b"stco": 4, b"co64": 8, b"elst": 12}
# FFmpeg takes these for what they hold where it finds no header.
_LEFT_OVER = (b"free", b"hoov", b"skip")
_BOXES = 1 << 20


@dataclass
class _Claims:
    samples: int = 0
    edits: int = 0
    boxes: int = 0


def check_movie(path: str | os.PathLike, what: str = "video") -> None:
    """Raise ``ValueError`` where the boxes of ``path`` claim more than its bytes warrant; other kinds of files pass."""
    length = size_of(path, what)
    claims = _Claims()
    with open(path, "rb") as file:
        for kind, start, end in _boxes(file, 0, length, claims):
            _look(file, kind, start, end, claims)
    # Most edits are one, or two of which the first is empty. No sample takes less than a byte.
    if claims.samples * max(1, claims.edits - 1) > length:
        edits = f" in {claims.edits:,} edits" if claims.edits > 1 else ""
        raise ValueError(f"it claims {claims.samples:,} samples{edits} in {length:,} bytes")


def _boxes(file: BinaryIO, start: int, end: int, claims: _Claims) -> Iterator[tuple[bytes, int, int]]:
    """Each box from ``start`` to ``end``, with those within it: its kind, and where its content starts and ends."""
    open_ends = [end]
    while open_ends:
        if start + 8 > open_ends[-1]:
            start = open_ends.pop()
            continue
        claims.boxes += 1
        if claims.boxes > _BOXES:
            raise ValueError(f"it is divided into more than {_BOXES:,} boxes")
        file.seek(start)
        head = file.read(16)
        if len(head) < 8:
            return
        size, kind, content = int.from_bytes(head[:4], "big"), head[4:8], start + 8
        if size == 1 and len(head) == 16:
            size, content = int.from_bytes(head[8:], "big"), start + 16
        stop = open_ends[-1] if size == 0 else min(start + size, open_ends[-1])
        if stop < content:
            # As FFmpeg does: what is damaged ends what it lies in.
            start = open_ends.pop()
            continue
        yield kind, content, stop
        start = stop
        if kind in _CONTAINERS or (kind in _LEFT_OVER and head[12:] in (b"mvhd", b"cmov")):
            open_ends.append(stop)
            start = content
        elif kind == b"meta":
            open_ends.append(stop)
            # Of some, four bytes come before the boxes.
            start = content if head[12:] == b"hdlr" else content + 4


def _look(file: BinaryIO, kind: bytes, start: int, end: int, claims: _Claims) -> None:
    if kind == b"cmov":
        raise ValueError("its header is compressed, which is not read")
    if kind not in _ENTRIES and kind not in (b"stsz", b"trun"):
        return
    # FFmpeg reads on where a box is too short for what begins it.
    file.seek(start)
    head = file.read(12)
    if len(head) < 8:
        return
    flags, count = struct.unpack_from(">II", head)
    if kind == b"trun":
        claims.samples += count
        return
    if kind == b"stsz":
        if len(head) < 12:
            return
        # Of one size for all, no other is told.
        same, count = count, struct.unpack_from(">I", head, 8)[0]
        claims.samples += count
        room, bytes_each = max(0, end - start - 12), 0 if same else 4
    else:
        room, bytes_each = max(0, end - start - 8), 20 if kind == b"elst" and flags >> 24 == 1 else _ENTRIES[kind]
    if count * bytes_each > room:
        raise ValueError(f'its table "{kind.decode()}" claims {count:,} entries, and holds {room // bytes_each:,}')
    if kind == b"elst":
        claims.edits = max(claims.edits, count)
