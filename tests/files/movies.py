"""MP4 files without images, for tests of the readers of their tables."""

from __future__ import annotations

import struct


def make_box(kind: bytes, *content: bytes) -> bytes:
    joined = b"".join(content)
    return struct.pack(">I4s", 8 + len(joined), kind) + joined


def make_box_table(kind: bytes, count: int, entries: bytes = b"", flags: int = 0) -> bytes:
    return make_box(kind, struct.pack(">II", flags, count), entries)


def make_track(*tables: bytes, edits: bytes = b"") -> bytes:
    return make_box(b"trak", make_box(b"edts", edits), make_box(b"mdia", make_box(b"minf", make_box(b"stbl", *tables))))


def make_size_table(same: int, count: int, entries: bytes = b"") -> bytes:
    return make_box(b"stsz", struct.pack(">III", 0, same, count), entries)


def make_clock(kind: bytes, ticks: int, version: int = 0) -> bytes:
    """Make the header of a movie (mvhd) or a track (mdhd) with ``ticks`` per second."""
    return make_box(kind, bytes([version, 0, 0, 0]), bytes(16 if version else 8), struct.pack(">I", ticks), bytes(8))


def make_movie(
    scale: int, ticks: int, *tables: bytes, edits: bytes = b"", kind: bytes = b"vide", version: int = 0
) -> bytes:
    """Make a file with one track of ``kind``, whose edits have ``scale`` ticks per second, and its ``tables``
    ``ticks``.
    """
    handler = make_box(b"hdlr", bytes(8), kind, bytes(13))
    media = make_box(
        b"mdia", make_clock(b"mdhd", ticks, version), handler, make_box(b"minf", make_box(b"stbl", *tables))
    )
    content = make_box(b"trak", make_box(b"edts", edits), media)
    return (
        make_box(b"ftyp", b"isom")
        + make_box(b"mdat", bytes(1000))
        + make_box(b"moov", make_clock(b"mvhd", scale, version), content)
    )
