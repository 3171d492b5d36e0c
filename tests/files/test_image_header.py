"""Sizes of pictures, read from their headers."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files import images
from nerg_mi.files.images import check_image, write_exr
from tests.pictures import mitsuba_bitmap


def png(width: int, height: int, bits: int = 8, color: int = 2, data: bytes = b"") -> bytes:
    chunk = lambda kind, body: struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    head = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.exr", "a.bmp", "a.ppm", "a.pfm", "a.hdr"])
def test_sizes_of_what_mitsuba_writes(rgb, tmp_path, name):
    values = np.full((5, 7, 3), 0.5, np.float32)
    bitmap = rgb.Bitmap(values)
    if name in ("a.png", "a.jpg", "a.bmp", "a.ppm"):
        bitmap = rgb.Bitmap((values * 255).astype(np.uint8))
    if name == "a.exr":
        write_exr(tmp_path / name, dict.fromkeys("RGB", values[..., 0]))
    elif name == "a.bmp":
        head = struct.pack("<2sIIIIiiHHIIiiII", b"BM", 174, 0, 54, 40, 7, 5, 1, 24, 0, 120, 0, 0, 0, 0)
        (tmp_path / name).write_bytes(head + bytes(120))
    else:
        bitmap.write(str(tmp_path / name))
    header = check_image(tmp_path / name)
    assert header.size == (7, 5) and header.bytes >= 105
    assert list(mitsuba_bitmap(tmp_path / name).size()) == [7, 5]


def test_exr_counts_the_bytes_of_all_channels(tmp_path):
    write_exr(
        tmp_path / "a.exr", {"R": np.zeros((2, 3), np.float32), "depth.T": np.zeros((2, 3), np.float16)}, {"note": "x"}
    )
    assert check_image(tmp_path / "a.exr").bytes == 36


@pytest.mark.parametrize("size, bits, color", [((30000, 30000), 1, 0), ((1 << 31, 1), 8, 2), ((16000, 8000), 16, 6)])
def test_large_pictures_in_small_files_are_refused(tmp_path, size, bits, color):
    (tmp_path / "a.png").write_bytes(png(*size, bits, color))
    with pytest.raises(NergError, match='the mask ".*a.png" has .* make it smaller'):
        check_image(tmp_path / "a.png", "mask")


def test_a_large_picture_in_a_large_file_is_read(tmp_path):
    raw = png(16384, 12288)
    (tmp_path / "a.png").write_bytes(raw)
    with pytest.raises(NergError, match="make it smaller"):
        check_image(tmp_path / "a.png")
    with open(tmp_path / "a.png", "ab") as file:  # as many bytes as there may be, without room on the disk
        file.truncate(3 * 16384 * 12288 // images.WARRANTED)
    assert check_image(tmp_path / "a.png").size == (16384, 12288)


def test_a_picture_of_the_largest_size_is_read(tmp_path):
    (tmp_path / "a.png").write_bytes(png(16384, 8192))
    assert check_image(tmp_path / "a.png").bytes == images.DECODED_BYTES


@pytest.mark.parametrize("window", [(0, 0, 1 << 20, 1 << 20), (-(1 << 31), 0, (1 << 31) - 1, 0), (5, 0, 4, 1)])
def test_data_windows_of_exr_are_bounded(tmp_path, window):
    write_exr(tmp_path / "a.exr", {"Y": np.zeros((2, 3), np.float32)})
    raw = (tmp_path / "a.exr").read_bytes()
    at = raw.index(b"dataWindow\0box2i\0") + 21
    (tmp_path / "a.exr").write_bytes(raw[:at] + struct.pack("<4i", *window) + raw[at + 16 :])
    with pytest.raises(NergError, match="a.exr"):
        check_image(tmp_path / "a.exr")


def test_what_a_photo_carries_besides_its_pixels_is_not_taken_for_scans(rgb, tmp_path):
    rgb.Bitmap(np.zeros((5, 7, 3), np.uint8)).write(str(tmp_path / "a.jpg"))
    raw = (tmp_path / "a.jpg").read_bytes()
    # A note, and, as telephones append it, a film: any bytes.
    noted = raw[:2] + b"\xff\xe5" + struct.pack(">H", 2 + 600) + b"\xff\xda\0\2\0\0" * 100 + raw[2:]
    (tmp_path / "b.jpg").write_bytes(noted + b"\xff\xda\0\2" * 1000)
    assert check_image(tmp_path / "b.jpg").size == (7, 5)


def test_scans_of_a_jpeg_are_counted(rgb, tmp_path):
    rgb.Bitmap(np.zeros((5, 7, 3), np.uint8)).write(str(tmp_path / "a.jpg"))
    raw = (tmp_path / "a.jpg").read_bytes()
    at = raw.index(b"\xff\xda")
    (tmp_path / "b.jpg").write_bytes(raw[:at] + raw[at:-2] * 101 + raw[-2:])
    with pytest.raises(NergError, match="b.jpg.*100"):
        check_image(tmp_path / "b.jpg")


@pytest.mark.parametrize(
    "raw",
    [
        b"",
        b"hello",
        b"\x89PNG\r\n\x1a\n",
        b"\xff\xd8",
        b"\xff\xd8\xff\xe0\0\0" * 3,
        b"\xff\xd8" + b"\xff\xda\0\2" * 101,
        b"\x76\x2f\x31\x01\2\0\0\0",
        b"\x76\x2f\x31\x01\2\0\0\0abc\0int\0\xff\xff\xff\x7f",
        b"\x76\x2f\x31\x01\2\x08\0\0",
        b"BM",
        b"P6 x y",
        b"#?RADIANCE\n",
        png(0, 3),
    ],
)
def test_damaged_headers_are_told_with_the_file(tmp_path, raw):
    (tmp_path / "picture").write_bytes(raw)
    with pytest.raises(NergError, match="picture"):
        check_image(tmp_path / "picture")
