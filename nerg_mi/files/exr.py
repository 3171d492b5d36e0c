"""OpenEXR files, written and read by the OpenEXR library.

Mitsuba's own reader brings an older copy of that library, in which overflows are known; its own writer shares Dr.Jit's
thread pool and waits for ever where that has one thread.
"""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.threads import set_thread_count

from .atomic import replacing
from .bounded import reading
from .image_header import check_image


def write_exr(
    path: str | os.PathLike, channels: Mapping[str, np.ndarray], attributes: Mapping[str, str] | None = None
) -> None:
    """Write ``channels`` as a single-part scanline file, compressed without loss, whole or not at all.

    ``channels``: name, such as ``R`` or ``depth.T``, to an array (h, w) of float32, float16 or uint32; rows from the
    top.
    ``attributes``: text for the header. Raises `NergError` where the file cannot be written.
    """
    import OpenEXR

    names = {
        "compression",
        "type",
        "channels",
        "dataWindow",
        "displayWindow",
        "lineOrder",
        "screenWindowCenter",
        "screenWindowWidth",
    }
    taken = names & set(attributes or {})
    if taken:
        raise ValueError(f"the attributes {', '.join(sorted(taken))} belong to the format; give them other names")
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        **{k: str(v) for k, v in (attributes or {}).items()},
    }
    data = {name: np.ascontiguousarray(value) for name, value in channels.items()}
    rows = len(next(iter(data.values())))
    with replacing(path) as temporary:
        try:
            with OpenEXR.File(header, data) as file:
                file.write(str(temporary))
        except RuntimeError as error:
            _raise_if_full(temporary)
            raise NergError(
                f'"{path}" could not be written ({str(error).strip()}); choose another name or folder'
            ) from error
        if not _whole(temporary, rows):
            # The library does not look at what becomes of the last kilobytes, which leave its buffer as the file is
            # closed.
            _raise_if_full(temporary)
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))


def _whole(path: Path, rows: int) -> bool:
    """Whether the last block of a scanline file of so many rows, compressed 16 at a time, ends where the file does."""
    try:
        with path.open("rb") as file:
            file.seek(8)  # magic number and version
            while _name(file):
                _name(file)  # the type of the attribute
                file.seek(struct.unpack("<i", file.read(4))[0], os.SEEK_CUR)
            blocks = -(-rows // 16)
            last = max(struct.unpack(f"<{blocks}Q", file.read(8 * blocks)))
            file.seek(last + 4)  # the block's first row
            return last > 0 and last + 8 + struct.unpack("<i", file.read(4))[0] == path.stat().st_size
    except struct.error:
        return False


def _name(file) -> bytes:
    """The bytes before the next zero."""
    return b"".join(iter(lambda: file.read(1) or b"\0", b"\0"))


def _raise_if_full(path: Path) -> None:
    """Raise the `OSError` for which nothing more fits into ``path``, if there is one: OpenEXR gives no number of it."""
    with path.open("ab") as file:
        file.write(bytes(1 << 16))
        file.flush()
        os.fsync(file.fileno())


def read_exr(path: str | os.PathLike, what: str = "image") -> dict[str, np.ndarray]:
    """The channels of the first part of an EXR file, arrays (h, w) by name: colours before all others of their layer
    (R, G, B, X, Y, Z, A), the rest by name.

    The size is checked in the header first. Raises `NergError` for what is damaged, too large, or stores its colours as
    luminance and two differences.
    """
    import OpenEXR

    check_image(path, what)
    # The library says so of whatever it finds wrong.
    with reading(path, what, also=(RuntimeError, TypeError)), OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: np.ascontiguousarray(channel.pixels) for name, channel in file.channels().items()}
    if {"RY", "BY"} <= set(channels):
        raise NergError(
            f'the {what} "{path}" stores luminance and colour differences (RY, BY); save it with R, G and B'
        )
    if len({c.shape for c in channels.values()}) != 1 or any(c.ndim != 2 for c in channels.values()):
        raise NergError(f'the {what} "{path}" has channels of different sizes; save it with one value a pixel in each')
    return {name: channels[name] for name in sorted(channels, key=_channel_order)}


def read_exr_text(path: str | os.PathLike, what: str = "image") -> dict[str, str]:
    """The texts in the header of an EXR file by their names: the ``attributes`` of `exr_rows` and of other programs.
    Raises `NergError` for what is damaged."""
    import OpenEXR

    check_image(path, what)
    with reading(path, what, also=(RuntimeError, TypeError)), OpenEXR.File(str(path), header_only=True) as file:
        return {name: value for name, value in file.header().items() if isinstance(value, str)}


def _channel_order(name: str) -> str:
    """What names are sorted by, so that the colours of a layer come in the order that Mitsuba gives them."""
    layer, dot, last = name.rpartition(".")
    place = "rgbxyza".find(last.lower()) if len(last) == 1 else -1
    return name if place < 0 else f"{layer}{dot}{place}"


@contextmanager
def exr_rows(
    path: str | os.PathLike, width: int, height: int, attributes: Mapping[str, str] | None = None
) -> Iterator[Callable[[Mapping[str, np.ndarray]], None]]:
    """A single-part scanline file that is written from the top in pieces, so that it need not lie in memory as a whole.

    Gives a function that writes the next rows, from the name of each channel to an array (rows, width) of float32; the
    names of the first call are those of the file. ``attributes``: text for the header. The file is whole or absent; it
    is absent also where rows are missing at the end. Raises `NergError` where it cannot be written.
    """
    import Imath
    import OpenEXR

    file, rows = None, 0
    with replacing(path) as temporary:

        def write(channels: Mapping[str, np.ndarray]) -> None:
            nonlocal file, rows
            if file is None:
                header = OpenEXR.Header(width, height)
                header["compression"] = Imath.Compression(Imath.Compression.ZIP_COMPRESSION)
                kind = Imath.Channel(Imath.PixelType(Imath.PixelType.FLOAT))
                header["channels"] = dict.fromkeys(channels, kind)
                header.update({key: value.encode() for key, value in (attributes or {}).items()})
                file = OpenEXR.OutputFile(str(temporary), header)
            count = len(next(iter(channels.values())))
            data = {name: np.ascontiguousarray(value, np.float32).tobytes() for name, value in channels.items()}
            try:
                file.writePixels(data, count)
            except (OSError, RuntimeError) as error:
                _raise_if_full(temporary)
                raise NergError(
                    f'"{path}" could not be written ({str(error).strip()}); choose another name or folder'
                ) from error
            rows += count

        try:
            yield write
        finally:
            if file is not None:
                file.close()
        if rows != height:
            raise ValueError(f"{rows} of {height} rows were written")
        if not _whole(temporary, rows):
            _raise_if_full(temporary)
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))


@contextmanager
def threads_for_mitsuba() -> Iterator[None]:
    """Two threads at least, for as long as Mitsuba reads files: with one its EXR reader, too, waits for ever, and a
    scene may hold textures and emitters in that format."""
    import drjit as dr

    threads = dr.thread_count()
    if threads > 1:
        yield
        return
    set_thread_count(2)
    try:
        yield
    finally:
        set_thread_count(threads)


def bitmap_channels(bitmap) -> dict[str, np.ndarray]:
    """The channels of a Mitsuba bitmap as float32 arrays (h, w), by the names that it gives them."""
    import mitsuba as mi

    if bitmap.component_format() != mi.Struct.Type.Float32:
        bitmap = bitmap.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False)
    values = np.array(bitmap)
    values = values[..., None] if values.ndim == 2 else values
    return {field.name: values[..., k] for k, field in enumerate(bitmap.struct_())}


def write_bitmap_exr(path: str | Path, bitmap) -> None:
    """Write a Mitsuba bitmap with all of its channels, as float32, and the text of its metadata."""
    attributes = {key: value for key, value in bitmap.metadata().items() if isinstance(value, (str, int, float))}
    write_exr(path, bitmap_channels(bitmap), {k: str(v) for k, v in attributes.items()})
