"""Tests of `nerg_mi.environment.rendering_files`."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.environment import rendering_files
from nerg_mi.environment.rendering_files import (
    check_mesh,
    check_ply_points,
    check_vol,
    frame_path,
    open_image_rows,
    read_frames,
    write_frames,
)
from nerg_mi.errors import NergError
from tests.pictures import mitsuba_bitmap

# ---- Frames files ----


def test_frames_round_trip(tmp_path):
    frames = [{"eye": "1, 2, 3", "falloff": "0.1"}, {"eye": 'a "b"', "falloff": ""}]
    write_frames(tmp_path / "a.csv", frames)
    assert read_frames(tmp_path / "a.csv") == frames
    (tmp_path / "b.csv").write_text('\ufeffeye,ahead\r\n\r\n"1,2,3","4,5,6"\r\n')
    assert read_frames(tmp_path / "b.csv") == [{"eye": "1,2,3", "ahead": "4,5,6"}]
    # As Excel writes them
    for text in ("sep=;\r\neye;fov\r\n1, 2, 3;40\r\n", "eye\tfov\n1, 2, 3\t40\n", "eye;fov\n1, 2, 3;40\n"):
        for encoding in ("utf-8", "utf-16"):
            (tmp_path / "c.csv").write_bytes(text.encode(encoding))
            assert read_frames(tmp_path / "c.csv") == [{"eye": "1, 2, 3", "fov": "40"}]


@pytest.mark.parametrize(
    "text, said",
    [
        ("", "contains no frames"),
        ("eye\n", "contains no frames"),
        ("eye,ahead\n1,2,3\n", r"line 2\) has 3 values for 2 columns; values with commas"),
        ("1,2\n3,4\n", 'header of .* contains "1"'),
        ("eye,eye\n1,2\n", "contains a name twice"),
        ('eye\n"1\n', "is not valid CSV"),
        (",".join(f"a{i}" for i in range(65)) + "\n", "65 names"),
    ],
)
def test_invalid_frames_file_is_refused(tmp_path, text, said):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(NergError, match=said):
        read_frames(tmp_path / "a.csv")


def test_frames_limits(tmp_path, monkeypatch):
    (tmp_path / "a.csv").write_bytes(b"eye\n\xff\n")
    with pytest.raises(NergError, match="frames file.*UTF-8"):
        read_frames(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("eye\n1\n2\n")
    monkeypatch.setattr(rendering_files, "MAX_FRAMES", 1)
    with pytest.raises(NergError, match="more than 1 frames"):
        read_frames(tmp_path / "b.csv")
    with pytest.raises(NergError, match="there is no frames file"):
        read_frames(tmp_path / "nowhere.csv")


def test_frame_paths():
    assert frame_path(Path("a/walk.png"), 7, 12) == Path("a/walk_0007.png")
    assert frame_path(Path("walk.exr"), 7, 12345) == Path("walk_00007.exr")


# ---- Checks of meshes and volumes ----

CORNERS = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)


def make_ply(vertices: int, faces: int, body: bytes, kind="binary_little_endian", extra_header="") -> bytes:
    return (
        f"ply\nformat {kind} 1.0\ncomment of nothing\nelement vertex {vertices}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {faces}\nproperty list uchar int vertex_indices\n{extra_header}end_header\n"
    ).encode() + body


def pack_face(*corners: int) -> bytes:
    return bytes([len(corners)]) + struct.pack(f"<{len(corners)}i", *corners)


TEXT = b"0 0 0\n1 0 0\n0 1 0\n"
BIG = struct.pack(">9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + b"\x03" + struct.pack(">3i", 0, 1, 2)


@pytest.mark.parametrize(
    "data",
    [
        make_ply(3, 1, CORNERS + pack_face(0, 1, 2)),
        make_ply(
            3,
            2,
            CORNERS + pack_face(0, 1, 2) + b"\x07" + pack_face(2, 1, 0) + b"\x08",
            extra_header="property uchar mark\n",
        ),
        make_ply(3, 1, TEXT + b"3 0 1 2\n", "ascii"),
        make_ply(3, 1, TEXT + b"\n3 0 1 2", "ascii"),
        make_ply(3, 1, BIG, "binary_big_endian"),
    ],
)
def test_complete_meshes_pass(rgb, tmp_path, data):
    (tmp_path / "a.ply").write_bytes(data)
    check_mesh(tmp_path / "a.ply", "ply")
    assert rgb.load_dict({"type": "ply", "filename": str(tmp_path / "a.ply")}).vertex_count() == 3


@pytest.mark.parametrize(
    "data, said",
    [
        (make_ply(3, 0, CORNERS), "has no faces"),
        (make_ply(0, 1, pack_face(0, 1, 2)), "has no vertices"),
        (make_ply(3, 1, CORNERS + pack_face(0, 1, 999999999)), "its 3 vertices"),
        (make_ply(3, 1, CORNERS + pack_face(0, -1, 2)), "its 3 vertices"),
        (make_ply(3, 1, TEXT + b"3 0 1 3\n", "ascii"), "its 3 vertices"),
        (make_ply(2000000000, 1, CORNERS + pack_face(0, 1, 2)), "rows of"),
        (make_ply(3, 2**62, CORNERS + pack_face(0, 1, 2)), "rows of"),
        (make_ply(3, 2**62, TEXT + b"3 0 1 2\n", "ascii"), "rows of"),
        (make_ply(3, 1, CORNERS + pack_face(0, 1)), "fewer than three"),
        (make_ply(3, 1, CORNERS + pack_face(0, 1, 2) + b"\n"), "its rows"),
        (make_ply(3, 1, struct.pack("<f", np.nan) + CORNERS[4:] + pack_face(0, 1, 2)), "vertex 1 is not finite"),
        (make_ply(3, 2, TEXT + b"3 0 1 2\n" + b" " * 40, "ascii"), "before row 2 of face"),
        (make_ply(-3, 1, CORNERS), "-3 rows"),
        (make_ply(4, 1, CORNERS + bytes(12) + pack_face(0, 1, 2, 3)), "three corners"),
        (make_ply(3, 1, TEXT + b"4 0 1 2 1\n", "ascii"), "three corners"),
        (b"ply\n", "header"),
        (b"", "does not begin"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex\nend_header\n", "a.ply"),
        (b"ply\nformat odd 1.0\nend_header\n", "a.ply"),
    ],
)
def test_invalid_meshes_are_refused(tmp_path, data, said):
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(NergError, match=said) as error:
        check_mesh(tmp_path / "a.ply", "ply")
    assert "a.ply" in str(error.value) and "\n" not in str(error.value)


def test_points_need_no_faces(tmp_path):
    (tmp_path / "a.ply").write_bytes(make_ply(3, 0, CORNERS))
    check_ply_points(tmp_path / "a.ply")


@pytest.mark.parametrize(
    "faces, said",
    [
        ("f 1 2 3", None),
        ("f 1 2 3 4", None),
        ("", "no faces"),
        ("f -4 -3 -2", "negative indices"),
        ("f 1 2 \\\n 3", "after a"),
        ("f 1 2 9", "its 4 vertices"),
    ],
)
def test_obj(tmp_path, faces, said):
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n{faces}\n")
    if said is None:
        check_mesh(tmp_path / "a.obj", "obj")
        return
    with pytest.raises(NergError, match=f"a.obj.*{said}"):
        check_mesh(tmp_path / "a.obj", "obj")


def make_vol(*size: int, kind: int = 1, values: int = 8) -> bytes:
    return b"VOL\x03" + struct.pack("<5i6f", kind, *size, 0, 0, 0, 1, 1, 1) + bytes(4 * values)


@pytest.mark.parametrize(
    "data",
    [
        make_vol(2, 2, 2, -1),
        make_vol(0, 2, 2, 1),
        make_vol(2, 2, 2, 2),
        make_vol(2000, 2000, 2000, 1),
        make_vol(2**31 - 1, 2**31 - 1, 2**31 - 1, 1),
        make_vol(2, 2, 2, 1, kind=7),
        make_vol(2, 2, 2, 1)[:30],
        b"VOX" + make_vol(2, 2, 2, 1)[3:],
        b"",
    ],
)
def test_invalid_volumes_are_refused(tmp_path, data):
    (tmp_path / "a.vol").write_bytes(data)
    with pytest.raises(NergError, match="a.vol"):
        check_vol(tmp_path / "a.vol")


def test_valid_volume_passes(tmp_path):
    from nerg_mi.formats.surfaces import write_volume

    write_volume(tmp_path / "a.vol", np.ones((2, 3, 4)), (0, 0, 0), (1, 1, 1))
    check_vol(tmp_path / "a.vol")


# ---- Image files ----


@pytest.fixture
def pixels():
    return np.random.default_rng(4).uniform(-0.1, 1.2, (601, 20, 3)).astype(np.float32)


@pytest.mark.parametrize("step", [601, 300, 37])
def test_png_equals_mitsuba(rgb, tmp_path, pixels, step):
    rgb.util.write_bitmap(str(tmp_path / "whole.png"), rgb.Bitmap(pixels), write_async=False)
    with open_image_rows(tmp_path / "parts.png", 20, 601) as write:
        for top in range(0, 601, step):
            part = np.zeros((step, 20, 3), np.float32)
            rows = min(step, 601 - top)
            part[:rows] = pixels[top : top + rows]
            write(rgb.Bitmap(part), rows)
    assert np.array_equal(*(np.array(mitsuba_bitmap(tmp_path / f"{n}.png")) for n in ("whole", "parts")))


def test_exr_contains_all_rows(rgb, tmp_path, pixels):
    with open_image_rows(tmp_path / "parts.exr", 20, 601) as write:
        for top in range(0, 601, 100):
            write(rgb.Bitmap(pixels[top : top + 100]), min(100, 601 - top))
    assert np.array_equal(np.array(mitsuba_bitmap(tmp_path / "parts.exr")), pixels)


@pytest.mark.parametrize("name", ["a.exr", "a.png"])
def test_missing_rows_are_an_error(rgb, tmp_path, pixels, name):
    with pytest.raises(ValueError, match="100 of 601|0 of 601"):
        with open_image_rows(tmp_path / name, 20, 601) as write:
            write(rgb.Bitmap(pixels[:100]), 100)
    assert not list(tmp_path.iterdir())


def test_unknown_format_is_refused(tmp_path):
    with pytest.raises(NergError, match=".exr or .png"):
        with open_image_rows(tmp_path / "a.bmp", 2, 2):
            pass


@pytest.mark.parametrize("short_by", [1, 3000])
def test_truncated_file_is_detected(tmp_path, short_by):
    # As on a full disk; the limit applies to a process, hence the child process.
    script = """
import resource, signal, sys
import numpy as np
from nerg_mi.files.images import open_exr_writer
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
if sys.argv[2] != "0":
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), resource.RLIM_INFINITY))
pixels = np.random.default_rng(0).random((90, 40)).astype(np.float32)
with open_exr_writer(sys.argv[1], 40, 90) as write:
    for top in range(0, 90, 40):
        write({"Y": pixels[top : top + 40]})
"""
    run = [sys.executable, "-c", script, str(tmp_path / "a.exr")]
    subprocess.run([*run, "0"], check=True, timeout=120)
    size = (tmp_path / "a.exr").stat().st_size
    (tmp_path / "a.exr").unlink()
    failed = subprocess.run([*run, str(size - short_by)], capture_output=True, text=True, timeout=120)
    assert "NergError" in failed.stderr and "could not be written" in failed.stderr
    assert not list(tmp_path.iterdir())
