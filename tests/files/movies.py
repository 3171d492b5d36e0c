"""Boxes of MP4 files, for tests of what reads their tables: files without pictures."""

from __future__ import annotations

import struct


def box(kind: bytes, *content: bytes) -> bytes:
    joined = b"".join(content)
    return struct.pack(">I4s", 8 + len(joined), kind) + joined


def box_table(kind: bytes, count: int, entries: bytes = b"", flags: int = 0) -> bytes:
    return box(kind, struct.pack(">II", flags, count), entries)


def track(*tables: bytes, edits: bytes = b"") -> bytes:
    return box(b"trak", box(b"edts", edits), box(b"mdia", box(b"minf", box(b"stbl", *tables))))


def sizes(same: int, count: int, entries: bytes = b"") -> bytes:
    return box(b"stsz", struct.pack(">III", 0, same, count), entries)


def clock(kind: bytes, ticks: int, version: int = 0) -> bytes:
    """The header of a movie (mvhd) or of a track (mdhd) of so many ``ticks`` a second."""
    return box(kind, bytes([version, 0, 0, 0]), bytes(16 if version else 8), struct.pack(">I", ticks), bytes(8))


def movie(scale: int, ticks: int, *tables: bytes, edits: bytes = b"", kind: bytes = b"vide", version: int = 0) -> bytes:
    """A file of one track of ``kind``, whose edits count ``scale`` ticks a second, and its ``tables`` ``ticks``."""
    handler = box(b"hdlr", bytes(8), kind, bytes(13))
    media = box(b"mdia", clock(b"mdhd", ticks, version), handler, box(b"minf", box(b"stbl", *tables)))
    whole = box(b"trak", box(b"edts", edits), media)
    return box(b"ftyp", b"isom") + box(b"mdat", bytes(1000)) + box(b"moov", clock(b"mvhd", scale, version), whole)
