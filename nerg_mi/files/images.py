"""Images: EXR and PNG input and output, and header checks before a decoder reads the pixels."""

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

# ---- Header checks, so that no decoder allocates more memory than these limits allow ----

MAX_PIXELS = 1 << 27  # maximum number of pixels: 16,384 x 8,192
MAX_DECODED_BYTES = 3 << 27  # maximum size of the decoded values: three 8-bit channels with that many pixels

MAX_EXPANSION = 16
"""Number of pixels, and of decoded bytes, per byte of the file that are always accepted. Photos of 200 million pixels
and large environment maps pass, but a small file that claims as much is rejected."""

MAX_BYTES = 4 << 30  # maximum size of a file in bytes

MAX_JPEG_BYTES = 1 << 29
"""Maximum size of a JPEG file in bytes. It is read completely; a photo of 200 million pixels has a fifth of this."""

MAX_JPEG_SCANS = 100  # maximum number of scans of a progressive JPEG; encoders write ten
_EXR_HEADER_BYTES = 1 << 20
_EXR_TYPE_BYTES = {0: 4, 1: 2, 2: 4}


@dataclass(frozen=True)
class ImageHeader:
    """Header of an image file.

    Attributes
    ----------
    format
        "png", "jpeg", "exr" and so on.
    size
        Width and height in pixels.
    decoded_bytes
        Size of all decoded values in bytes.
    """

    format: str
    size: tuple[int, int]
    decoded_bytes: int


def check_image(
    path: str | os.PathLike, file_kind: str = "image", max_pixels: int = MAX_PIXELS, max_bytes: int = MAX_BYTES
) -> ImageHeader:
    """Read the header of the image ``path`` and check its limits.

    Parameters
    ----------
    path
        The image file.
    file_kind
        Name of the kind of file in error messages.
    max_pixels
        Maximum number of pixels, of three bytes each. Images up to `MAX_EXPANSION` times the size of their file are
        always accepted.
    max_bytes
        Maximum size of the file in bytes.

    Raises
    ------
    NergError
        If the header is damaged or exceeds a limit.
    """
    with open_file(path, file_kind, max_bytes=max_bytes) as file:
        length = os.fstat(file.fileno()).st_size
        header = _read_header(file, length)
    width, height = header.size
    if not (width > 0 and height > 0):
        raise NergError(f'the {file_kind} "{path}" has {width} x {height} pixels; use an image that is not empty')
    pixel_limit, byte_limit = (
        max(limit, MAX_EXPANSION * length) for limit in (max_pixels, max_pixels * MAX_DECODED_BYTES // MAX_PIXELS)
    )
    if width * height > pixel_limit or header.decoded_bytes > byte_limit:
        raise NergError(
            f'the {file_kind} "{path}" has {width:,} x {height:,} pixels, {header.decoded_bytes:,} bytes; the limits '
            "for a "
            f"file of {length:,} bytes are {pixel_limit:,} pixels and {byte_limit:,} bytes; reduce its size"
        )
    return header


def _read_header(file, length: int) -> ImageHeader:
    """Raise ``ValueError``, ``struct.error`` or ``EOFError`` for a damaged header."""
    start = file.read(32)
    if start.startswith(b"\x89PNG\r\n\x1a\n"):
        return _read_png_header(start)
    if start.startswith(b"\xff\xd8"):
        return _read_jpeg_header(file, length)
    if start.startswith(b"\x76\x2f\x31\x01"):
        return _read_exr_header(file, length)
    if start.startswith(b"BM"):
        width, height, _, bits = struct.unpack_from("<iiHH", start, 18)
        return ImageHeader("bmp", (width, abs(height)), width * abs(height) * max(3, ceil(bits / 8)))
    if re.match(rb"P[3-6Ff]\s", start):
        return _read_pnm_header(file)
    if start.startswith(b"#?"):
        file.seek(0)
        match = re.search(rb"-Y (\d{1,9}) \+X (\d{1,9})", file.read(1 << 16))
        if match is None:
            raise ValueError("its header contains no size")
        height, width = map(int, match.groups())
        return ImageHeader("hdr", (width, height), 12 * width * height)
    raise ValueError("its image format is not supported; supported formats include PNG, JPEG and EXR")


def _read_png_header(start: bytes) -> ImageHeader:
    length, kind, width, height, bits, color = struct.unpack_from(">I4sIIBB", start, 8)
    channels = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}.get(color)
    if length != 13 or kind != b"IHDR" or channels is None or bits not in (1, 2, 4, 8, 16):
        raise ValueError("its header is not a valid PNG header")
    return ImageHeader("png", (width, height), width * height * channels * (2 if bits == 16 else 1))


def _read_jpeg_header(file, length: int) -> ImageHeader:
    if length > MAX_JPEG_BYTES:
        raise ValueError(f"it has {length:,} bytes; the limit for JPEG is {MAX_JPEG_BYTES:,}")
    file.seek(0)
    data = file.read()
    position = 2
    while position + 4 <= length:
        if data[position] != 0xFF:
            raise ValueError(f"byte {position} of its header is damaged")
        marker = data[position + 1]
        if marker == 0xFF or 0xD0 <= marker <= 0xD8 or marker == 1:
            position += 1 if marker == 0xFF else 2
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            bits, height, width, channels = struct.unpack_from(">BHHB", data, position + 4)
            if _count_jpeg_scans(data, position) > MAX_JPEG_SCANS:
                raise ValueError(f"it has more than {MAX_JPEG_SCANS} scans")
            return ImageHeader("jpeg", (width, height), width * height * max(channels, 1) * (1 if bits == 8 else 2))
        if marker in (0xD9, 0xDA):
            break
        position += 2 + struct.unpack_from(">H", data, position + 2)[0]
    raise ValueError("its header contains no size")


# In the entropy-coded data, a byte 0xff is followed by a zero byte or by one of eight markers without a segment.
_SEGMENT = re.compile(rb"\xff([^\x00\x01\xff\xd0-\xd8])", re.DOTALL)


def _count_jpeg_scans(data: bytes, position: int) -> int:
    """Count the scans of the JPEG ``data`` from ``position``.

    Other segments, such as EXIF data, and the bytes after the end of the image, where telephones append a video, may
    contain any bytes and are not counted.
    """
    count = 0
    while match := _SEGMENT.search(data, position):
        kind, position = match[1][0], match.end()
        if kind == 0xD9:
            break
        count += kind == 0xDA
        position += int.from_bytes(data[position : position + 2], "big")
    return count


def _read_pnm_header(file) -> ImageHeader:
    file.seek(0)
    text = re.sub(rb"#[^\n]*\n", b" ", file.read(4096))
    match = re.match(rb"(P[3-6Ff])\s+(\d{1,9})\s+(\d{1,9})\s", text)
    if match is None:
        raise ValueError("its header contains no size")
    width, height = int(match[2]), int(match[3])
    return ImageHeader("pnm", (width, height), width * height * {b"PF": 12, b"Pf": 4}.get(match[1], 6))


def _read_exr_header(file, length: int) -> ImageHeader:
    """Read the size of the first part, and the decoded bytes of all parts."""
    file.seek(4)
    flags = struct.unpack("<I", file.read(4))[0]
    if flags & 0x800:
        raise ValueError("it contains deep pixels, which are not supported")
    total, first, is_multipart = 0, None, bool(flags & 0x1000)
    while True:
        attributes = _read_exr_attributes(file, length)
        if is_multipart and not attributes:
            break
        left, top, right, bottom = struct.unpack("<4i", attributes[b"dataWindow"])
        width, height = right - left + 1, bottom - top + 1
        if width <= 0 or height <= 0:
            raise ValueError(f"its data window has {width} x {height} pixels")
        total += width * height * _count_exr_pixel_bytes(attributes[b"channels"])
        first = first or (width, height)
        if not is_multipart:
            break
    if first is None:
        raise ValueError("it has no parts")
    return ImageHeader("exr", first, total)


def _read_exr_attributes(file, length: int) -> dict[bytes, bytes]:
    out = {}
    while name := _read_exr_name(file):
        _read_exr_name(file)
        size = struct.unpack("<i", file.read(4))[0]
        if not 0 <= size <= length - file.tell() or file.tell() + size > _EXR_HEADER_BYTES:
            raise ValueError(f'the attribute "{sanitize(name.decode("latin1"))}" of its header claims {size:,} bytes')
        out[name] = file.read(size)
    return out


def _read_exr_name(file) -> bytes:
    out = bytearray()
    while (c := file.read(1)) != b"\0":
        if not c:
            raise EOFError
        out += c
        if len(out) > 255:
            raise ValueError("a name in its header is longer than 255 bytes")
    return bytes(out)


def _count_exr_pixel_bytes(channels: bytes) -> int:
    """Return the bytes of one pixel from the channel list (name, type, linearity, and sampling distances)."""
    at, total = 0, 0
    while at < len(channels) and channels[at]:
        at = channels.index(b"\0", at) + 1
        kind, _, dx, dy = struct.unpack_from("<iIii", channels, at)
        if kind not in _EXR_TYPE_BYTES or (dx, dy) != (1, 1):
            raise ValueError("it has channels with an unsupported type or resolution")
        total += _EXR_TYPE_BYTES[kind]
        at += 16
    if not total:
        raise ValueError("it has no channels")
    return total


# ---- OpenEXR files, written and read by the OpenEXR library ----
#
# Mitsuba's reader uses an older version of that library with known overflows. Mitsuba's writer shares the thread pool
# of Dr.Jit, and blocks forever if the pool has only one thread.

_RESERVED_ATTRIBUTES = set(
    "compression type channels dataWindow displayWindow lineOrder screenWindowCenter screenWindowWidth".split()
)


def write_exr(
    path: str | os.PathLike, channels: Mapping[str, np.ndarray], attributes: Mapping[str, str] | None = None
) -> None:
    """Write a single-part scanline file with lossless compression, atomically.

    Parameters
    ----------
    path
        The file.
    channels
        Name, such as ``R`` or ``depth.T``, to an array (h, w) of float32, float16 or uint32; the first row is the top
        row.
    attributes
        Text attributes for the header.

    Raises
    ------
    NergError
        If the file cannot be written.
    """
    import OpenEXR

    reserved = _RESERVED_ATTRIBUTES & set(attributes or {})
    if reserved:
        raise ValueError(f"the attributes {', '.join(sorted(reserved))} are reserved by the format; choose other names")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(attributes or {})}
    data = {name: np.ascontiguousarray(value) for name, value in channels.items()}
    rows = len(next(iter(data.values())))
    with replace_atomically(path) as temporary:
        with _translate_exr_errors(path, temporary), OpenEXR.File(header, data) as file:
            file.write(str(temporary))
        _check_complete(path, temporary, rows)


@contextmanager
def _translate_exr_errors(path: str | os.PathLike, temporary: Path) -> Iterator[None]:
    """Convert errors of the OpenEXR library on the file ``temporary`` to a `NergError` that names the target
    ``path``.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        _raise_if_full(temporary)
        raise NergError(
            f'"{path}" could not be written ({str(error).strip()}); choose another name or folder'
        ) from error


def _check_complete(path: str | os.PathLike, temporary: Path, rows: int) -> None:
    """Raise `OSError` if the file is truncated. OpenEXR does not check whether the last kilobytes, which it writes when
    it closes the file, were written successfully.
    """
    if not _is_complete(temporary, rows):
        _raise_if_full(temporary)
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))


def _is_complete(path: Path, rows: int) -> bool:
    """Return whether the last block of a scanline file with ``rows`` rows, 16 per block, ends at the end of the
    file.
    """
    try:
        with path.open("rb") as file:
            file.seek(8)  # magic number and version
            while _read_exr_name(file):
                _read_exr_name(file)  # the type of the attribute
                file.seek(struct.unpack("<i", file.read(4))[0], os.SEEK_CUR)
            blocks = -(-rows // 16)
            last = max(struct.unpack(f"<{blocks}Q", file.read(8 * blocks)))
            file.seek(last + 4)  # the block's first row
            return last > 0 and last + 8 + struct.unpack("<i", file.read(4))[0] == path.stat().st_size
    except (struct.error, EOFError):
        return False


def _raise_if_full(path: Path) -> None:
    """Raise the `OSError` that prevents further writes to ``path``, if there is one. OpenEXR does not report the
    error code.
    """
    with path.open("ab") as file:
        file.write(bytes(1 << 16))
        file.flush()
        os.fsync(file.fileno())


def read_exr(path: str | os.PathLike, file_kind: str = "image") -> dict[str, np.ndarray]:
    """Read the channels of the first part of an EXR file as arrays (h, w) by name.

    The colour channels of a layer come first (R, G, B, X, Y, Z, A), followed by the others in alphabetical order. The
    size is checked in the header before the pixels are read. Raises `NergError` for a file that is damaged, too large,
    or stores luminance and colour differences.
    """
    import OpenEXR

    check_image(path, file_kind)
    # The library raises these types for all errors in a file.
    with (
        translate_read_errors(path, file_kind, extra_errors=(RuntimeError, TypeError)),
        OpenEXR.File(str(path), separate_channels=True) as file,
    ):
        channels = {name: np.ascontiguousarray(channel.pixels) for name, channel in file.channels().items()}
    if {"RY", "BY"} <= set(channels):
        raise NergError(
            f'the {file_kind} "{path}" stores luminance and colour differences (RY, BY); save it with R, G and B'
        )
    if len({c.shape for c in channels.values()}) != 1 or any(c.ndim != 2 for c in channels.values()):
        raise NergError(
            f'the {file_kind} "{path}" has channels of different resolutions; save it with one value per pixel in '
            "each channel"
        )
    return {name: channels[name] for name in sorted(channels, key=_get_channel_order)}


def read_exr_attributes(path: str | os.PathLike, file_kind: str = "image") -> dict[str, str]:
    """Read the text attributes in the header of an EXR file. Raises `NergError` for a damaged file."""
    import OpenEXR

    check_image(path, file_kind)
    with (
        translate_read_errors(path, file_kind, extra_errors=(RuntimeError, TypeError)),
        OpenEXR.File(str(path), header_only=True) as file,
    ):
        return {name: value for name, value in file.header().items() if isinstance(value, str)}


def _get_channel_order(name: str) -> str:
    """Return the sort key of a channel name, which sorts the colours of a layer in the order of Mitsuba."""
    layer, dot, last = name.rpartition(".")
    place = "rgbxyza".find(last.lower()) if len(last) == 1 else -1
    return name if place < 0 else f"{layer}{dot}{place}"


@contextmanager
def open_exr_writer(
    path: str | os.PathLike, width: int, height: int, attributes: Mapping[str, str] | None = None
) -> Iterator[Callable[[Mapping[str, np.ndarray]], None]]:
    """Write a single-part scanline file in pieces from the top, atomically, without keeping it in memory.

    Parameters
    ----------
    path
        The file.
    width, height
        Image size in pixels.
    attributes
        Text attributes for the header.

    Yields
    ------
    callable
        Function that writes the next rows, given as name of each channel to an array (rows, width) of float32. The
        first call determines the channels of the file.

    Raises
    ------
    NergError
        If the file cannot be written.
    ValueError
        If rows are missing at the end. The file is then not created.
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
            with _translate_exr_errors(path, temporary):
                file.writePixels(data, count)
            rows += count

        try:
            yield write
        finally:
            if file is not None:
                file.close()
        if rows != height:
            raise ValueError(f"{rows} of {height} rows were written")
        _check_complete(path, temporary, rows)


@contextmanager
def ensure_two_threads() -> Iterator[None]:
    """Use at least two threads in the block, in which Mitsuba reads files.

    Mitsuba's EXR reader blocks forever with one thread, and a scene may contain textures and emitters in that format.
    """
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
    """Return the channels of a Mitsuba bitmap as float32 arrays (h, w) by name."""
    import mitsuba as mi

    if bitmap.component_format() != mi.Struct.Type.Float32:
        bitmap = bitmap.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False)
    values = np.array(bitmap)
    values = values[..., None] if values.ndim == 2 else values
    return {field.name: values[..., k] for k, field in enumerate(bitmap.struct_())}


def write_bitmap_exr(path: str | Path, bitmap) -> None:
    """Write a Mitsuba bitmap with all channels as float32, and its text metadata."""
    attributes = {k: str(v) for k, v in bitmap.metadata().items() if isinstance(v, (str, int, float))}
    write_exr(path, split_bitmap_channels(bitmap), attributes)


# ---- PNG files with text metadata ----

_PNG_HEADER_BYTES = 33  # bytes of the signature and of the first chunk, IHDR; other chunks may follow


def encode_png(bitmap, metadata: Mapping[str, str] | None = None) -> bytes:
    """Encode a Mitsuba bitmap with 8 or 16 bits per channel as a PNG file in memory.

    Parameters
    ----------
    bitmap
        The bitmap.
    metadata
        Text of the header by keyword (Latin letters).

    Notes
    -----
    The file is encoded in memory because Mitsuba's file stream does not report a full disk.
    """
    import mitsuba as mi

    stream = mi.MemoryStream()
    bitmap.write(stream, mi.Bitmap.FileFormat.PNG)
    data = stream.raw_buffer()
    # Mitsuba would write the metadata of the bitmap in quotation marks.
    return (
        data[:_PNG_HEADER_BYTES]
        + b"".join(_make_text_chunk(*item) for item in (metadata or {}).items())
        + data[_PNG_HEADER_BYTES:]
    )


def _make_text_chunk(keyword: str, text: str) -> bytes:
    """Make a tEXt chunk, or an iTXt chunk for text beyond Latin-1 (PNG, third edition, 11.3.3)."""
    key = keyword.encode("latin-1")
    try:
        kind, data = b"tEXt", key + b"\0" + text.encode("latin-1")
    except UnicodeEncodeError:
        # Uncompressed, without a language and a translated keyword.
        kind, data = b"iTXt", key + bytes(5) + text.encode("utf-8")
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def write_png(path: str | os.PathLike, bitmap, metadata: Mapping[str, str] | None = None) -> None:
    """Write a Mitsuba bitmap with 8 or 16 bits per channel and ``metadata`` atomically; see `encode_png`."""
    write_bytes(path, encode_png(bitmap, metadata))
