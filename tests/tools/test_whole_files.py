"""Whether a file is whole, and what is lost."""

from __future__ import annotations

import numpy as np
import pytest

from tools import tiny, whole_files


def test_a_file_that_is_cut_off_is_lost(tmp_path):
    tiny.looks(50).save(tmp_path / "rays.npz")
    whole, before = (tmp_path / "rays.npz").read_bytes(), whole_files.contents(tmp_path)
    assert whole_files.lost_files(before, whole_files.contents(tmp_path)) == []
    tiny.looks(60).save(tmp_path / "rays.npz")
    assert whole_files.lost_files(before, whole_files.contents(tmp_path)) == []
    (tmp_path / "rays.npz").write_bytes(whole[:-30])
    (said,) = whole_files.lost_files(before, whole_files.contents(tmp_path))
    assert "rays.npz is not whole" in said
    (tmp_path / "rays.npz").unlink()
    (said,) = whole_files.lost_files(before, whole_files.contents(tmp_path))
    assert "rays.npz is gone" in said


@pytest.mark.parametrize(
    "name, data",
    [
        ("a.vol", b"VOL\3" + np.array([1, 2, 2, 2, 1], "<i4").tobytes() + bytes(24) + bytes(31)),
        ("a.json", b'{"a": 1'),
        ("a.csv", b"a,b\n1,"),
        ("a.safetensors", b"\x20\0\0\0\0\0\0\0{}"),
        ("a.ply", b"ply\nformat ascii 1.0\n"),
        ("a.exr", b"v/1\1"),
    ],
)
def test_what_is_no_whole_file(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    (said,) = whole_files.lost_files({}, whole_files.contents(tmp_path))
    assert f"{name} is not whole" in said


def test_a_file_being_written_is_hidden_and_no_result(tmp_path):
    (tmp_path / ".rays.12-ab.part.npz").write_bytes(b"half")
    assert whole_files.contents(tmp_path) == {}
