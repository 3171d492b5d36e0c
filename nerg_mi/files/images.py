"""Pictures: EXR and PNG in and out, and headers that are checked before a library reads the rest."""

from __future__ import annotations

import errno
import os
import re
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from math import ceil
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.threads import set_thread_count

from .atomic import replace_atomically, write_bytes
from .safe_read import open_file, translate_read_errors

# ---- What a picture's header says of its size, so that no decoder makes room for more than is read here ----

MAX_PIXELS = 1 << 27  # a picture may have so many pixels: 16,384 x 8,192
MAX_DECODED_BYTES = 3 << 27  # its values may take so many bytes: three 8-bit channels of as many pixels

MAX_EXPANSION = 16
"""So many times its file's bytes a picture may take in any case, in pixels as in bytes: photos of 200 million pixels
and large environment maps are no attack, where a small file that claims as much is one."""

MAX_BYTES = 4 << 30  # maximum bytes of a file

MAX_JPEG_BYTES = 1 << 29
"""And so many as JPEG, which is read whole: a photo of 200 million pixels has a fifth of them."""

MAX_JPEG_SCANS = 100  # a progressive JPEG may run over its pixels so many times; encoders make ten
_EXR_HEADER_BYTES = 1 << 20
_EXR_KINDS = {0: 4, 1: 2, 2: 4}


@dataclass(frozen=True)
class ImageHeader:
    """``kind``: "png", "jpeg", "exr" and so on; ``size``: width and height in pixels; ``bytes``: that all of its values
    take once they are decoded."""

    format: str
    size: tuple[int, int]
    decoded_bytes: int


def check_image(
    path: str | os.PathLike, file_kind: str = "image", max_pixels: int = MAX_PIXELS, max_bytes: int = MAX_BYTES
) -> ImageHeader:
    """The header of the picture ``path``; `NergError` where it is damaged, beyond ``most`` pixels of three bytes and
    beyond `WARRANTED` times its file, or where the file has more than ``most_bytes``."""
    with open_file(path, file_kind, max_bytes=max_bytes) as file:
        length = os.fstat(file.fileno()).st_size
        header = _header(file, length)
    width, height = header.size
    if not (width > 0 and height > 0):
        raise NergError(f'the {file_kind} "{path}" has {width} x {height} pixels; give one that shows something')
    pixels, decoded = (max(limit, MAX_EXPANSION * length) for limit in (max_pixels, max_pixels * MAX_DECODED_BYTES // MAX_PIXELS))
    if width * height > pixels or header.decoded_bytes > decoded:
        raise NergError(
            f'the {file_kind} "{path}" has {width:,} x {height:,} pixels, {header.decoded_bytes:,} bytes, and at most '
            f"{pixels:,} pixels and {decoded:,} bytes are read of a file of {length:,}; make it smaller"
        )
    return header


def _header(file, length: int) -> ImageHeader:
    """Raises ``ValueError``, ``struct.error`` and ``EOFError`` for what is damaged."""
    start = file.read(32)
    if start.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png(start)
    if start.startswith(b"\xff\xd8"):
        return _jpeg(file, length)
    if start.startswith(b"\x76\x2f\x31\x01"):
        return _exr(file, length)
    if start.startswith(b"BM"):
        width, height, _, bits = struct.unpack_from("<iiHH", start, 18)
        return ImageHeader("bmp", (width, abs(height)), width * abs(height) * max(3, ceil(bits / 8)))
    if re.match(rb"P[3-6Ff]\s", start):
        return _plain(file)
    if start.startswith(b"#?"):
        file.seek(0)
        found = re.search(rb"-Y (\d{1,9}) \+X (\d{1,9})", file.read(1 << 16))
        if found is None:
            raise ValueError("its header names no size")
        height, width = map(int, found.groups())
        return ImageHeader("hdr", (width, height), 12 * width * height)
    raise ValueError("it is no picture of a kind that is read, such as PNG, JPEG or EXR")


def _png(start: bytes) -> ImageHeader:
    length, kind, width, height, bits, color = struct.unpack_from(">I4sIIBB", start, 8)
    channels = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}.get(color)
    if length != 13 or kind != b"IHDR" or channels is None or bits not in (1, 2, 4, 8, 16):
        raise ValueError("its header is not one of a PNG")
    return ImageHeader("png", (width, height), width * height * channels * (2 if bits == 16 else 1))


def _jpeg(file, length: int) -> ImageHeader:
    if length > MAX_JPEG_BYTES:
        raise ValueError(f"it has {length:,} bytes, more than the {MAX_JPEG_BYTES:,} of JPEG that are read")
    file.seek(0)
    data = file.read()
    at = 2
    while at + 4 <= length:
        if data[at] != 0xFF:
            raise ValueError(f"byte {at} of its header is damaged")
        marker = data[at + 1]
        if marker == 0xFF or 0xD0 <= marker <= 0xD8 or marker == 1:
            at += 1 if marker == 0xFF else 2
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            bits, height, width, channels = struct.unpack_from(">BHHB", data, at + 4)
            if _scans(data, at) > MAX_JPEG_SCANS:
                raise ValueError(f"it runs over its pixels more than {MAX_JPEG_SCANS} times")
            return ImageHeader("jpeg", (width, height), width * height * max(channels, 1) * (1 if bits == 8 else 2))
        if marker in (0xD9, 0xDA):
            break
        at += 2 + struct.unpack_from(">H", data, at + 2)[0]
    raise ValueError("its header names no size")


# In the coded pixels a byte of ones is followed by a zero, or by one of eight marks that have no segment.
_SEGMENT = re.compile(rb"\xff([^\x00\x01\xff\xd0-\xd8])", re.DOTALL)


def _scans(data: bytes, at: int) -> int:
    """How many scans the JPEG ``data`` has from ``at`` on. What lies in its other segments, such as notes, and behind
    its end, such as the film that telephones append, may hold any bytes and is none."""
    count = 0
    while found := _SEGMENT.search(data, at):
        kind, at = found[1][0], found.end()
        if kind == 0xD9:
            break
        count += kind == 0xDA
        at += int.from_bytes(data[at : at + 2], "big")
    return count


def _plain(file) -> ImageHeader:
    file.seek(0)
    text = re.sub(rb"#[^\n]*\n", b" ", file.read(4096))
    found = re.match(rb"(P[3-6Ff])\s+(\d{1,9})\s+(\d{1,9})\s", text)
    if found is None:
        raise ValueError("its header names no size")
    width, height = int(found[2]), int(found[3])
    return ImageHeader("pnm", (width, height), width * height * {b"PF": 12, b"Pf": 4}.get(found[1], 6))


def _exr(file, length: int) -> ImageHeader:
    """The size of the first part, and the bytes of all parts."""
    file.seek(4)
    flags = struct.unpack("<I", file.read(4))[0]
    if flags & 0x800:
        raise ValueError("it holds deep pixels, which are not read")
    total, first, many = 0, None, bool(flags & 0x1000)
    while True:
        attributes = _exr_attributes(file, length)
        if many and not attributes:
            break
        left, top, right, bottom = struct.unpack("<4i", attributes[b"dataWindow"])
        width, height = right - left + 1, bottom - top + 1
        if width <= 0 or height <= 0:
            raise ValueError(f"its data window has {width} x {height} pixels")
        total += width * height * _exr_pixel_bytes(attributes[b"channels"])
        first = first or (width, height)
        if not many:
            break
    if first is None:
        raise ValueError("it has no parts")
    return ImageHeader("exr", first, total)


def _exr_attributes(file, length: int) -> dict[bytes, bytes]:
    out = {}
    while name := _exr_name(file):
        _exr_name(file)
        size = struct.unpack("<i", file.read(4))[0]
        if not 0 <= size <= length - file.tell() or file.tell() + size > _EXR_HEADER_BYTES:
            raise ValueError(f'the attribute "{sanitize(name.decode("latin1"))}" of its header claims {size:,} bytes')
        out[name] = file.read(size)
    return out


def _exr_name(file) -> bytes:
    out = bytearray()
    while (c := file.read(1)) != b"\0":
        if not c:
            raise EOFError
        out += c
        if len(out) > 255:
            raise ValueError("a name in its header is longer than 255 bytes")
    return bytes(out)


def _exr_pixel_bytes(channels: bytes) -> int:
    """Bytes of one pixel, by the list of channels: name, kind, linearity, and how far apart samples lie."""
    at, total = 0, 0
    while at < len(channels) and channels[at]:
        at = channels.index(b"\0", at) + 1
        kind, _, dx, dy = struct.unpack_from("<iIii", channels, at)
        if kind not in _EXR_KINDS or (dx, dy) != (1, 1):
            raise ValueError("it has channels of other kinds or sizes than are read")
        total += _EXR_KINDS[kind]
        at += 16
    if not total:
        raise ValueError("it has no channels")
    return total


# ---- OpenEXR files, written and read by the OpenEXR library ----
#
# Mitsuba's own reader brings an older copy of that library, in which overflows are known; its own writer shares
# Dr.Jit's thread pool and waits for ever where that has one thread.

_OF_THE_FORMAT = set(
    "compression type channels dataWindow displayWindow lineOrder screenWindowCenter screenWindowWidth".split()
)


def write_exr(
    path: str | os.PathLike, channels: Mapping[str, np.ndarray], attributes: Mapping[str, str] | None = None
) -> None:
    """Write ``channels`` as a single-part scanline file, compressed without loss, whole or not at all.

    ``channels``: name, such as ``R`` or ``depth.T``, to an array (h, w) of float32, float16 or uint32; rows from the
    top.
    ``attributes``: text for the header. Raises `NergError` where the file cannot be written.
    """
    import OpenEXR

    taken = _OF_THE_FORMAT & set(attributes or {})
    if taken:
        raise ValueError(f"the attributes {', '.join(sorted(taken))} belong to the format; give them other names")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(attributes or {})}
    data = {name: np.ascontiguousarray(value) for name, value in channels.items()}
    rows = len(next(iter(data.values())))
    with replace_atomically(path) as temporary:
        with _writing(path, temporary), OpenEXR.File(header, data) as file:
            file.write(str(temporary))
        _check_whole(path, temporary, rows)


@contextmanager
def _writing(path: str | os.PathLike, temporary: Path) -> Iterator[None]:
    """What the library says of the file ``temporary``, which is to become ``path``, as one sentence."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        _raise_if_full(temporary)
        raise NergError(
            f'"{path}" could not be written ({str(error).strip()}); choose another name or folder'
        ) from error


def _check_whole(path: str | os.PathLike, temporary: Path, rows: int) -> None:
    """Raise `OSError` for a file that is cut off: the library does not look at what becomes of the last kilobytes,
    which leave its buffer as the file is closed."""
    if not _whole(temporary, rows):
        _raise_if_full(temporary)
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))


def _whole(path: Path, rows: int) -> bool:
    """Whether the last block of a scanline file of so many rows, compressed 16 at a time, ends where the file does."""
    try:
        with path.open("rb") as file:
            file.seek(8)  # magic number and version
            while _exr_name(file):
                _exr_name(file)  # the type of the attribute
                file.seek(struct.unpack("<i", file.read(4))[0], os.SEEK_CUR)
            blocks = -(-rows // 16)
            last = max(struct.unpack(f"<{blocks}Q", file.read(8 * blocks)))
            file.seek(last + 4)  # the block's first row
            return last > 0 and last + 8 + struct.unpack("<i", file.read(4))[0] == path.stat().st_size
    except (struct.error, EOFError):
        return False


def _raise_if_full(path: Path) -> None:
    """Raise the `OSError` for which nothing more fits into ``path``, if there is one: OpenEXR gives no number of it."""
    with path.open("ab") as file:
        file.write(bytes(1 << 16))
        file.flush()
        os.fsync(file.fileno())


def read_exr(path: str | os.PathLike, file_kind: str = "image") -> dict[str, np.ndarray]:
    """The channels of the first part of an EXR file, arrays (h, w) by name: colours before all others of their layer
    (R, G, B, X, Y, Z, A), the rest by name.

    The size is checked in the header first. Raises `NergError` for what is damaged, too large, or stores its colours as
    luminance and two differences.
    """
    import OpenEXR

    check_image(path, file_kind)
    # The library says so of whatever it finds wrong.
    with translate_read_errors(path, file_kind, extra_errors=(RuntimeError, TypeError)), OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: np.ascontiguousarray(channel.pixels) for name, channel in file.channels().items()}
    if {"RY", "BY"} <= set(channels):
        raise NergError(
            f'the {file_kind} "{path}" stores luminance and colour differences (RY, BY); save it with R, G and B'
        )
    if len({c.shape for c in channels.values()}) != 1 or any(c.ndim != 2 for c in channels.values()):
        raise NergError(f'the {file_kind} "{path}" has channels of different sizes; save it with one value a pixel in each')
    return {name: channels[name] for name in sorted(channels, key=_channel_order)}


def read_exr_attributes(path: str | os.PathLike, file_kind: str = "image") -> dict[str, str]:
    """The texts in the header of an EXR file by their names: the ``attributes`` of `exr_rows` and of other programs.
    Raises `NergError` for what is damaged."""
    import OpenEXR

    check_image(path, file_kind)
    with translate_read_errors(path, file_kind, extra_errors=(RuntimeError, TypeError)), OpenEXR.File(str(path), header_only=True) as file:
        return {name: value for name, value in file.header().items() if isinstance(value, str)}


def _channel_order(name: str) -> str:
    """What names are sorted by, so that the colours of a layer come in the order that Mitsuba gives them."""
    layer, dot, last = name.rpartition(".")
    place = "rgbxyza".find(last.lower()) if len(last) == 1 else -1
    return name if place < 0 else f"{layer}{dot}{place}"


@contextmanager
def open_exr_writer(
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
    with replace_atomically(path) as temporary:

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
            with _writing(path, temporary):
                file.writePixels(data, count)
            rows += count

        try:
            yield write
        finally:
            if file is not None:
                file.close()
        if rows != height:
            raise ValueError(f"{rows} of {height} rows were written")
        _check_whole(path, temporary, rows)


@contextmanager
def ensure_two_threads() -> Iterator[None]:
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


def split_bitmap_channels(bitmap) -> dict[str, np.ndarray]:
    """The channels of a Mitsuba bitmap as float32 arrays (h, w), by the names that it gives them."""
    import mitsuba as mi

    if bitmap.component_format() != mi.Struct.Type.Float32:
        bitmap = bitmap.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False)
    values = np.array(bitmap)
    values = values[..., None] if values.ndim == 2 else values
    return {field.name: values[..., k] for k, field in enumerate(bitmap.struct_())}


def write_bitmap_exr(path: str | Path, bitmap) -> None:
    """Write a Mitsuba bitmap with all of its channels, as float32, and the text of its metadata."""
    attributes = {k: str(v) for k, v in bitmap.metadata().items() if isinstance(v, (str, int, float))}
    write_exr(path, split_bitmap_channels(bitmap), attributes)


# ---- PNG files, whole or absent, with text in their headers ----

_HEADER = 33  # bytes of the signature and of the first chunk, IHDR, behind which others may stand


def encode_png(bitmap, metadata: Mapping[str, str] | None = None) -> bytes:
    """A Mitsuba bitmap of 8 or 16 bits a channel as the bytes of a PNG file; ``text``: what its header says, by
    keywords of Latin letters.

    In memory: Mitsuba's file stream does not tell of a disk that is full.
    """
    import mitsuba as mi

    stream = mi.MemoryStream()
    bitmap.write(stream, mi.Bitmap.FileFormat.PNG)
    data = stream.raw_buffer()
    # Mitsuba would write texts of the bitmap's metadata with quotation marks around them.
    return data[:_HEADER] + b"".join(_chunk(*item) for item in (metadata or {}).items()) + data[_HEADER:]


def _chunk(keyword: str, text: str) -> bytes:
    """A chunk tEXt, or iTXt for what is not Latin-1 (PNG, third edition, 11.3.3)."""
    key = keyword.encode("latin-1")
    try:
        kind, data = b"tEXt", key + b"\0" + text.encode("latin-1")
    except UnicodeEncodeError:
        # Not compressed, without language and translation.
        kind, data = b"iTXt", key + bytes(5) + text.encode("utf-8")
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def write_png(path: str | os.PathLike, bitmap, metadata: Mapping[str, str] | None = None) -> None:
    """Write a Mitsuba bitmap of 8 or 16 bits a channel, with ``text``; see `encode_png` and `atomic.replacing`."""
    write_bytes(path, encode_png(bitmap, metadata))
