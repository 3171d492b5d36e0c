"""Meshes and volumes are refused where their counts or corners are wrong, before Mitsuba believes them."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rendering.files import check_mesh, check_points, check_vol

CORNERS = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)


def ply(vertices: int, faces: int, body: bytes, kind="binary_little_endian", more="") -> bytes:
    return (
        f"ply\nformat {kind} 1.0\ncomment of nothing\nelement vertex {vertices}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {faces}\nproperty list uchar int vertex_indices\n{more}end_header\n"
    ).encode() + body


def face(*corners: int) -> bytes:
    return bytes([len(corners)]) + struct.pack(f"<{len(corners)}i", *corners)


TEXT = b"0 0 0\n1 0 0\n0 1 0\n"
BIG = struct.pack(">9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + b"\x03" + struct.pack(">3i", 0, 1, 2)


@pytest.mark.parametrize(
    "data",
    [
        ply(3, 1, CORNERS + face(0, 1, 2)),
        ply(3, 2, CORNERS + face(0, 1, 2) + b"\x07" + face(2, 1, 0) + b"\x08", more="property uchar mark\n"),
        ply(3, 1, TEXT + b"3 0 1 2\n", "ascii"),
        ply(3, 1, TEXT + b"\n3 0 1 2", "ascii"),
        ply(3, 1, BIG, "binary_big_endian"),
    ],
)
def test_whole_meshes_pass_here_and_in_mitsuba(rgb, tmp_path, data):
    (tmp_path / "a.ply").write_bytes(data)
    check_mesh(tmp_path / "a.ply", "ply")
    assert rgb.load_dict({"type": "ply", "filename": str(tmp_path / "a.ply")}).vertex_count() == 3


@pytest.mark.parametrize(
    "data, said",
    [
        (ply(3, 0, CORNERS), "has no faces"),
        (ply(0, 1, face(0, 1, 2)), "has no vertices"),
        (ply(3, 1, CORNERS + face(0, 1, 999999999)), "none of its 3 vertices"),
        (ply(3, 1, CORNERS + face(0, -1, 2)), "none of its 3 vertices"),
        (ply(3, 1, TEXT + b"3 0 1 3\n", "ascii"), "none of its 3 vertices"),
        (ply(2000000000, 1, CORNERS + face(0, 1, 2)), "ends before"),
        (ply(3, 2**62, CORNERS + face(0, 1, 2)), "ends before"),
        (ply(3, 2**62, TEXT + b"3 0 1 2\n", "ascii"), "ends before"),
        (ply(3, 1, CORNERS + face(0, 1)), "fewer than three"),
        (ply(3, 1, CORNERS + face(0, 1, 2) + b"\n"), "more follows its rows"),
        (ply(3, 1, struct.pack("<f", np.nan) + CORNERS[4:] + face(0, 1, 2)), "vertex 1 is not finite"),
        (ply(3, 2, TEXT + b"3 0 1 2\n" + b" " * 40, "ascii"), "ends before row 2 of face"),
        (ply(-3, 1, CORNERS), "-3 rows"),
        (ply(4, 1, CORNERS + bytes(12) + face(0, 1, 2, 3)), "three corners"),
        (ply(3, 1, TEXT + b"4 0 1 2 1\n", "ascii"), "three corners"),
        (b"ply\n", "no header"),
        (b"", "does not begin"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex\nend_header\n", "a.ply"),
        (b"ply\nformat odd 1.0\nend_header\n", "a.ply"),
    ],
)
def test_wrong_meshes_are_a_sentence(tmp_path, data, said):
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(NergError, match=said) as error:
        check_mesh(tmp_path / "a.ply", "ply")
    assert "a.ply" in str(error.value) and "\n" not in str(error.value)


def test_points_need_no_faces(tmp_path):
    (tmp_path / "a.ply").write_bytes(ply(3, 0, CORNERS))
    check_points(tmp_path / "a.ply")


@pytest.mark.parametrize(
    "faces, said",
    [
        ("f 1 2 3", None),
        ("f 1 2 3 4", None),
        ("", "no faces"),
        ("f -4 -3 -2", "negative indices"),
        ("f 1 2 \\\n 3", "go on after"),
        ("f 1 2 9", "none of its 4 vertices"),
    ],
)
def test_obj(tmp_path, faces, said):
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n{faces}\n")
    if said is None:
        check_mesh(tmp_path / "a.obj", "obj")
        return
    with pytest.raises(NergError, match=f"a.obj.*{said}"):
        check_mesh(tmp_path / "a.obj", "obj")


def vol(*size: int, kind: int = 1, values: int = 8) -> bytes:
    return b"VOL\x03" + struct.pack("<5i6f", kind, *size, 0, 0, 0, 1, 1, 1) + bytes(4 * values)


@pytest.mark.parametrize(
    "data",
    [
        vol(2, 2, 2, -1),
        vol(0, 2, 2, 1),
        vol(2, 2, 2, 2),
        vol(2000, 2000, 2000, 1),
        vol(2**31 - 1, 2**31 - 1, 2**31 - 1, 1),
        vol(2, 2, 2, 1, kind=7),
        vol(2, 2, 2, 1)[:30],
        b"VOX" + vol(2, 2, 2, 1)[3:],
        b"",
    ],
)
def test_wrong_volumes_are_a_sentence(tmp_path, data):
    (tmp_path / "a.vol").write_bytes(data)
    with pytest.raises(NergError, match="a.vol"):
        check_vol(tmp_path / "a.vol")


def test_a_volume_of_ours_passes(tmp_path):
    from nerg_mi.formats.surfaces import write_volume

    write_volume(tmp_path / "a.vol", np.ones((2, 3, 4)), (0, 0, 0), (1, 1, 1))
    check_vol(tmp_path / "a.vol")
