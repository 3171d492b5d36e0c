"""What a picture's header says of its size, so that no decoder makes room for more than is read here."""

from __future__ import annotations

import os
import re
import struct
from dataclasses import dataclass
from math import ceil

from nerg_mi.errors import NergError

from .bounded import open_file, plain

PIXELS = 1 << 27
"""A picture may have so many pixels: 16,384 x 8,192."""

DECODED_BYTES = 3 << 27
"""Its values may take so many bytes: three 8-bit channels of as many pixels."""

WARRANTED = 16
"""So many times its file's bytes a picture may take in any case, in pixels as in bytes: photos of 200 million pixels
and large environment maps are no attack, where a small file that claims as much is one."""

BYTES = 4 << 30
"""A file may have so many bytes."""

JPEG_BYTES = 1 << 29
"""And so many as JPEG, which is read whole: a photo of 200 million pixels has a fifth of them."""

SCANS = 100
"""A progressive JPEG may run over its pixels so many times; encoders make ten."""

_EXR_HEADER_BYTES = 1 << 20
_EXR_KINDS = {0: 4, 1: 2, 2: 4}


@dataclass(frozen=True)
class ImageHeader:
    """``kind``: "png", "jpeg", "exr" and so on; ``size``: width and height in pixels; ``bytes``: that all of its values
    take once they are decoded."""

    kind: str
    size: tuple[int, int]
    bytes: int


def check_image(
    path: str | os.PathLike, what: str = "image", most: int = PIXELS, most_bytes: int = BYTES
) -> ImageHeader:
    """The header of the picture ``path``; `NergError` where it is damaged, beyond ``most`` pixels of three bytes and
    beyond `WARRANTED` times its file, or where the file has more than ``most_bytes``."""
    with open_file(path, what, most=most_bytes) as file:
        length = os.fstat(file.fileno()).st_size
        header = _header(file, length)
    width, height = header.size
    if not (width > 0 and height > 0):
        raise NergError(f'the {what} "{path}" has {width} x {height} pixels; give one that shows something')
    pixels, decoded = (max(limit, WARRANTED * length) for limit in (most, most * DECODED_BYTES // PIXELS))
    if width * height > pixels or header.bytes > decoded:
        raise NergError(
            f'the {what} "{path}" has {width:,} x {height:,} pixels, {header.bytes:,} bytes, and at most '
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
    if length > JPEG_BYTES:
        raise ValueError(f"it has {length:,} bytes, more than the {JPEG_BYTES:,} of JPEG that are read")
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
            if _scans(data, at) > SCANS:
                raise ValueError(f"it runs over its pixels more than {SCANS} times")
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
            raise ValueError(f'the attribute "{plain(name.decode("latin1"))}" of its header claims {size:,} bytes')
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
