"""Tests of `nerg_mi.files.images`."""

from __future__ import annotations

import os
import resource
import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files import images
from nerg_mi.files.images import check_image, ensure_two_threads, read_exr, write_bitmap_exr, write_exr, write_png
from tests.pictures import mitsuba_bitmap

# ---- EXR files contain the written channels, also if Dr.Jit has one thread ----


def test_channels_round_trip_in_another_reader(tmp_path, rgb):
    random = np.random.default_rng(1)
    names = ("R", "G", "B", "depth.T", "position.X", "position.Y", "position.Z", "n.R", "n.G", "n.B", "gaze.Y")
    channels = {name: random.normal(size=(7, 5)).astype(np.float32) for name in names}
    channels["depth.T"][2, 3] = np.inf
    write_exr(tmp_path / "a.exr", channels, {"seed": "3"})
    bitmap = mitsuba_bitmap(tmp_path / "a.exr")
    read = dict(zip([f.name for f in bitmap.struct_()], np.moveaxis(np.array(bitmap), 2, 0)))
    assert read.keys() == channels.keys()
    assert all(np.array_equal(read[name], channels[name]) for name in names)
    assert bitmap.metadata()["seed"] == "3"


def test_bitmap_equals_file_of_mitsuba(tmp_path, rgb):
    pixels = np.random.default_rng(2).random((6, 4, 3)).astype(np.float32)
    with ensure_two_threads():
        rgb.Bitmap(pixels).write(str(tmp_path / "theirs.exr"))
    write_bitmap_exr(tmp_path / "ours.exr", rgb.Bitmap(pixels))
    theirs, ours = (mitsuba_bitmap(tmp_path / f"{name}.exr") for name in ("theirs", "ours"))
    assert np.array_equal(np.array(theirs), np.array(ours))
    assert ours.pixel_format() == theirs.pixel_format() == rgb.Bitmap.PixelFormat.RGB


def test_reserved_attribute_is_refused(tmp_path):
    with pytest.raises(ValueError, match="dataWindow"):
        write_exr(tmp_path / "a.exr", {"R": np.zeros((2, 2), np.float32)}, {"dataWindow": "x"})


@pytest.mark.parametrize("shape", [(1, 3), (16, 5), (50, 40)])
def test_truncated_exr_is_refused(tmp_path, shape):
    """OpenEXR does not report a truncated last block, which is the complete data of a small image."""
    random = np.random.default_rng(3)
    channels = {"R": random.random(shape, np.float32), "A": random.random(shape).astype(np.float16)}
    path = tmp_path / "a.exr"
    write_exr(path, channels, {"seed": "3"})
    content = path.stat().st_size
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    for size in (0, 7, content // 2, content - 1, content):
        path.write_bytes(b"old")
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            if size < content:
                with pytest.raises(NergError, match="maximum file size"):
                    write_exr(path, channels, {"seed": "3"})
            else:
                write_exr(path, channels, {"seed": "3"})
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
        assert path.stat().st_size == (3 if size < content else content) and [p.name for p in tmp_path.iterdir()] == [
            "a.exr"
        ]


_ONE_THREAD = """
import sys
import nerg_mi, mitsuba as mi, drjit as dr, numpy as np
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(1)
from nerg_mi.files.images import write_bitmap_exr
write_bitmap_exr(sys.argv[1], mi.Bitmap(np.ones((64, 64, 3), np.float32)))
"""

_READ = """
import sys
import nerg_mi, mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(1)
from nerg_mi.environment.scene_loading import load_scene
load_scene(sys.argv[1])
assert dr.thread_count() == 1
"""


def test_a_scene_with_an_exr_file_is_read_with_one_thread(tmp_path):
    # Mitsuba's reader does not return either.
    write_exr(tmp_path / "sky.exr", {c: np.ones((8, 16), np.float32) for c in "RGB"})
    sky = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{sky}<sensor type="perspective"/></scene>')
    subprocess.run([sys.executable, "-c", _READ, str(tmp_path / "scene.xml")], check=True, timeout=120)


def test_one_thread_is_enough(tmp_path):
    # Mitsuba's writer does not return here.
    subprocess.run([sys.executable, "-c", _ONE_THREAD, str(tmp_path / "a.exr")], check=True, timeout=120)
    assert (tmp_path / "a.exr").stat().st_size > 0


@pytest.mark.parametrize("kind", [np.float32, np.float16])
@pytest.mark.parametrize(
    "names",
    [
        "R G B",
        "R G B A",
        "Y",
        "Y A",
        "Z",
        "depth.T",
        "R G B depth.T",
        "A B C",
        "rgba.R rgba.G rgba.B rgba.A",
        "r g b",
        "albedo.R albedo.G albedo.B nn.X nn.Y nn.Z",
        "X Y Z",
        "Z Y X A B",
        "Blue Aqua Cat",
        "left.R right.R left.G B",
    ],
)
def test_images_equal_those_of_mitsuba(rgb, tmp_path, names, kind):
    from nerg_mi.photos.images import open_bitmap

    values = np.random.default_rng(0).random((len(names.split()), 4, 3)).astype(kind)
    write_exr(tmp_path / "a.exr", dict(zip(names.split(), values)))
    mine, theirs = open_bitmap(tmp_path / "a.exr", "image"), mitsuba_bitmap(tmp_path / "a.exr")
    assert mine.pixel_format() == theirs.pixel_format() and mine.component_format() == theirs.component_format()
    if mine.pixel_format() == rgb.Bitmap.PixelFormat.MultiChannel:
        assert [f.name for f in mine.struct_()] == [f.name for f in theirs.struct_()]
    assert np.array_equal(np.array(mine), np.array(theirs)) and np.array(mine).shape == np.array(theirs).shape
    for ask in ("premultiplied_alpha", "srgb_gamma", "has_alpha"):
        assert getattr(mine, ask)() == getattr(theirs, ask)(), ask


def test_damaged_exr_error_names_file(tmp_path):
    write_exr(tmp_path / "a.exr", {c: np.random.default_rng(0).random((8, 8)).astype(np.float32) for c in "RGB"})
    raw = (tmp_path / "a.exr").read_bytes()
    for cut in (0, 3, 20, 200, len(raw) - 5):
        (tmp_path / "b.exr").write_bytes(raw[:cut])
        with pytest.raises(NergError, match="b.exr"):
            read_exr(tmp_path / "b.exr")
    write_exr(tmp_path / "c.exr", {c: np.zeros((2, 2), np.float32) for c in ("Y", "RY", "BY")})
    with pytest.raises(NergError, match="c.exr.*luminance"):
        read_exr(tmp_path / "c.exr")


# ---- Image sizes in headers ----


def make_png(width: int, height: int, bits: int = 8, color: int = 2, data: bytes = b"") -> bytes:
    chunk = lambda kind, body: struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    head = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.exr", "a.bmp", "a.ppm", "a.pfm", "a.hdr"])
def test_header_sizes_of_mitsuba_files(rgb, tmp_path, name):
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
    assert header.size == (7, 5) and header.decoded_bytes >= 105
    assert list(mitsuba_bitmap(tmp_path / name).size()) == [7, 5]


def test_exr_size_includes_all_channels(tmp_path):
    write_exr(
        tmp_path / "a.exr", {"R": np.zeros((2, 3), np.float32), "depth.T": np.zeros((2, 3), np.float16)}, {"note": "x"}
    )
    assert check_image(tmp_path / "a.exr").decoded_bytes == 36


@pytest.mark.parametrize("size, bits, color", [((30000, 30000), 1, 0), ((1 << 31, 1), 8, 2), ((16000, 8000), 16, 6)])
def test_large_images_in_small_files_are_refused(tmp_path, size, bits, color):
    (tmp_path / "a.png").write_bytes(make_png(*size, bits, color))
    with pytest.raises(NergError, match='the mask ".*a.png" has .* reduce its size'):
        check_image(tmp_path / "a.png", "mask")


def test_large_image_in_large_file_is_accepted(tmp_path):
    raw = make_png(16384, 12288)
    (tmp_path / "a.png").write_bytes(raw)
    with pytest.raises(NergError, match="reduce its size"):
        check_image(tmp_path / "a.png")
    with open(tmp_path / "a.png", "ab") as file:  # the maximum size, as a sparse file
        file.truncate(3 * 16384 * 12288 // images.MAX_EXPANSION)
    assert check_image(tmp_path / "a.png").size == (16384, 12288)


def test_image_of_maximum_size_is_accepted(tmp_path):
    (tmp_path / "a.png").write_bytes(make_png(16384, 8192))
    assert check_image(tmp_path / "a.png").decoded_bytes == images.MAX_DECODED_BYTES


@pytest.mark.parametrize("window", [(0, 0, 1 << 20, 1 << 20), (-(1 << 31), 0, (1 << 31) - 1, 0), (5, 0, 4, 1)])
def test_exr_data_windows_are_bounded(tmp_path, window):
    write_exr(tmp_path / "a.exr", {"Y": np.zeros((2, 3), np.float32)})
    raw = (tmp_path / "a.exr").read_bytes()
    at = raw.index(b"dataWindow\0box2i\0") + 21
    (tmp_path / "a.exr").write_bytes(raw[:at] + struct.pack("<4i", *window) + raw[at + 16 :])
    with pytest.raises(NergError, match="a.exr"):
        check_image(tmp_path / "a.exr")


def test_metadata_of_jpeg_is_not_counted_as_scans(rgb, tmp_path):
    rgb.Bitmap(np.zeros((5, 7, 3), np.uint8)).write(str(tmp_path / "a.jpg"))
    raw = (tmp_path / "a.jpg").read_bytes()
    # EXIF data, and a video that a telephone has appended: any bytes.
    noted = raw[:2] + b"\xff\xe5" + struct.pack(">H", 2 + 600) + b"\xff\xda\0\2\0\0" * 100 + raw[2:]
    (tmp_path / "b.jpg").write_bytes(noted + b"\xff\xda\0\2" * 1000)
    assert check_image(tmp_path / "b.jpg").size == (7, 5)


def test_jpeg_scans_are_limited(rgb, tmp_path):
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
        make_png(0, 3),
    ],
)
def test_damaged_header_error_names_file(tmp_path, raw):
    (tmp_path / "picture").write_bytes(raw)
    with pytest.raises(NergError, match="picture"):
        check_image(tmp_path / "picture")


# ---- PNG files are written atomically; Mitsuba's writer does not report a full disk ----


def make_bitmap(rgb):
    return rgb.Bitmap(np.random.default_rng(1).integers(0, 256, (40, 50, 3)).astype(np.uint8))


def test_png_equals_file_of_mitsuba(tmp_path, rgb):
    make_bitmap(rgb).write(str(tmp_path / "theirs.png"))
    write_png(tmp_path / "new" / "ours.png", make_bitmap(rgb))
    assert (tmp_path / "new" / "ours.png").read_bytes() == (tmp_path / "theirs.png").read_bytes()


_LIMITED = """
import resource, sys
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from nerg_mi.files.images import write_png
from tests.files.test_images import make_bitmap
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
write_png(sys.argv[1], make_bitmap(mi))
"""


def test_full_disk_keeps_old_image(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(b"old")
    env = {**os.environ, "PYTHONPATH": os.getcwd()}
    done = subprocess.run([sys.executable, "-c", _LIMITED, str(path)], capture_output=True, text=True, env=env)
    assert done.returncode == 1 and "maximum file size" in done.stderr
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["a.png"]


def test_png_text_is_read_by_another_library(tmp_path, rgb):
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    text = {"Comment": '{"a": "b"}', "Title": "Läden", "Author": "Łukasz 店"}
    write_png(tmp_path / "a.png", make_bitmap(rgb), text)
    with image.open(tmp_path / "a.png") as texts:
        texts.load()
        # Mitsuba adds its version.
        assert {k: v for k, v in texts.text.items() if k != "generated_by"} == text
        np.testing.assert_array_equal(np.asarray(texts), np.array(make_bitmap(rgb)))
