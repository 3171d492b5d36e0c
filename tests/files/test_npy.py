"""Arrays are made only of bytes that are there."""

from __future__ import annotations

import io
import struct
import zipfile

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import open_npz, read_npy, read_npz

_ARRAYS = [
    np.arange(12.0).reshape(3, 4),
    np.asfortranarray(np.arange(12, dtype="<u2").reshape(3, 4)),
    np.zeros((0, 3)),
    np.array(2.5),
    np.array(["a", "bcd"]),
    np.array([True, False]),
    np.zeros(3, [("x", "<f4"), ("n", "<i8")]),
    np.arange(3, dtype=">f4"),
    np.array([1, 2], "M8[s]"),
]


def npy(shape, descr="<f8", data=b"", version=(1, 0)) -> bytes:
    head = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}".encode() + b"\n"
    return b"\x93NUMPY" + bytes(version) + struct.pack("<H" if version == (1, 0) else "<I", len(head)) + head + data


@pytest.mark.parametrize("array", _ARRAYS, ids=lambda a: f"{a.dtype}-{a.shape}")
def test_arrays_come_back_as_numpy_reads_them(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    np.savez(tmp_path / "a.npz", a=array, b=array)
    np.savez_compressed(tmp_path / "c.npz", a=array)
    found = [
        read_npy(tmp_path / "a.npy"),
        *read_npz(tmp_path / "a.npz").values(),
        *read_npz(tmp_path / "c.npz").values(),
    ]
    assert len(found) == 4
    for value in found:
        assert value.dtype == array.dtype and value.shape == array.shape and np.array_equal(value, array)
        assert value.flags.f_contiguous == array.flags.f_contiguous and value.flags.writeable


def test_an_archive_tells_of_its_arrays_without_reading_them(tmp_path):
    np.savez(tmp_path / "a.npz", rays=np.zeros((5, 3), np.float32), names=np.array(["a"]))
    with open_npz(tmp_path / "a.npz") as archive:
        assert archive.names == ["rays", "names"] and "rays" in archive and "others" not in archive
        assert archive.about("rays") == ((5, 3), np.float32)
        with pytest.raises(KeyError):
            archive["others"]


@pytest.mark.parametrize(
    "shape",
    [
        "(1000000000000,)",
        "(10, 10)",
        "(-3,)",
        "(0, 1000000000000000000000000)",
        "(1,) * 3",
        "(2.5,)",
        "3",
        "'x'",
        "(9223372036854775807, 9223372036854775807)",
        "(" + "1," * 70 + ")",
        "[3]",
        "(" * 500,
    ],
)
def test_shapes_that_the_bytes_do_not_hold_are_refused(tmp_path, shape):
    data = npy(shape, data=bytes(24))
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(NergError, match="a.npy"):
        read_npy(tmp_path / "a.npy")
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x.npy", data)
    with pytest.raises(NergError, match='array "x" .*a.npz'):
        read_npz(tmp_path / "a.npz")


@pytest.mark.parametrize("descr", ["|O", "|S0", "<U0", "|V0", "<f99", "", "x" * 2000, [("a", "|O")], None, 7])
def test_types_that_are_no_numbers_are_refused(tmp_path, descr):
    (tmp_path / "a.npy").write_bytes(npy("(1000000000000,)", descr, bytes(24)))
    with pytest.raises(NergError, match="a.npy"):
        read_npy(tmp_path / "a.npy")


def test_objects_are_never_unpickled(tmp_path):
    stream = io.BytesIO()
    np.save(stream, np.array([print], dtype=object), allow_pickle=True)
    (tmp_path / "a.npy").write_bytes(stream.getvalue())
    with pytest.raises(NergError, match="Python objects"):
        read_npy(tmp_path / "a.npy")


@pytest.mark.parametrize("cut", [0, 3, 8, 9, 20, 60, 127, 130])
def test_what_is_cut_off_is_told_with_its_name(tmp_path, cut):
    np.save(tmp_path / "a.npy", np.arange(3.0))
    (tmp_path / "a.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:cut])
    with pytest.raises(NergError, match="a.npy"):
        read_npy(tmp_path / "a.npy")


def test_headers_and_versions_are_bounded(tmp_path):
    (tmp_path / "a.npy").write_bytes(npy("(1,)" + " " * 20_000, data=bytes(8), version=(2, 0)))
    with pytest.raises(NergError, match="a.npy"):
        read_npy(tmp_path / "a.npy")
    (tmp_path / "a.npy").write_bytes(npy("(1,)", data=bytes(8), version=(3, 0)))
    with pytest.raises(NergError, match="version 3.0"):
        read_npy(tmp_path / "a.npy")


@pytest.mark.parametrize("axes, good", [(32, True), (33, False)])
def test_arrays_have_so_many_axes(tmp_path, axes, good):
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {(1,) * axes}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(8))
    if good:
        assert read_npy(tmp_path / "a.npy").shape == (1,) * axes
    else:
        with pytest.raises(NergError, match="claims the shape"):
            read_npy(tmp_path / "a.npy")
