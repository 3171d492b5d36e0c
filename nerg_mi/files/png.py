"""PNG files, whole or absent."""

from __future__ import annotations

import os

from .atomic import write_bytes


def encode_png(bitmap) -> bytes:
    """A Mitsuba bitmap of 8 or 16 bits a channel as the bytes of a PNG file.

    In memory: Mitsuba's file stream does not tell of a disk that is full.
    """
    import mitsuba as mi

    stream = mi.MemoryStream()
    bitmap.write(stream, mi.Bitmap.FileFormat.PNG)
    return stream.raw_buffer()


def write_png(path: str | os.PathLike, bitmap) -> None:
    """Write a Mitsuba bitmap of 8 or 16 bits a channel; see `atomic.replacing`."""
    write_bytes(path, encode_png(bitmap))
