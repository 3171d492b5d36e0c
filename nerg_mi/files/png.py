"""PNG files, whole or absent, with text in their headers."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Mapping

from .atomic import write_bytes

_HEADER = 33  # bytes of the signature and of the first chunk, IHDR, behind which others may stand


def encode_png(bitmap, text: Mapping[str, str] | None = None) -> bytes:
    """A Mitsuba bitmap of 8 or 16 bits a channel as the bytes of a PNG file; ``text``: what its header says, by
    keywords of Latin letters.

    In memory: Mitsuba's file stream does not tell of a disk that is full.
    """
    import mitsuba as mi

    stream = mi.MemoryStream()
    bitmap.write(stream, mi.Bitmap.FileFormat.PNG)
    data = stream.raw_buffer()
    # Mitsuba would write texts of the bitmap's metadata with quotation marks around them.
    return data[:_HEADER] + b"".join(_chunk(*item) for item in (text or {}).items()) + data[_HEADER:]


def _chunk(keyword: str, text: str) -> bytes:
    """A chunk tEXt, or iTXt for what is not Latin-1 (PNG, third edition, 11.3.3)."""
    key = keyword.encode("latin-1")
    try:
        kind, data = b"tEXt", key + b"\0" + text.encode("latin-1")
    except UnicodeEncodeError:
        # Not compressed, without language and translation.
        kind, data = b"iTXt", key + bytes(5) + text.encode("utf-8")
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def write_png(path: str | os.PathLike, bitmap, text: Mapping[str, str] | None = None) -> None:
    """Write a Mitsuba bitmap of 8 or 16 bits a channel, with ``text``; see `encode_png` and `atomic.replacing`."""
    write_bytes(path, encode_png(bitmap, text))
