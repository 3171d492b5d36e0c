"""Checksums of files."""

import hashlib

import pytest

from nerg_mi.errors import NergError
from nerg_mi.files import atomic


def test_of_a_file_larger_than_a_block(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic, "_BLOCK", 7)
    data = bytes(range(256)) * 3
    (tmp_path / "a").write_bytes(data)
    (tmp_path / "empty").write_bytes(b"")
    assert atomic.file_sha256(tmp_path / "a") == hashlib.sha256(data).hexdigest()
    assert atomic.file_sha256(tmp_path / "empty") == hashlib.sha256(b"").hexdigest()


def test_what_is_no_file(tmp_path):
    for path in (tmp_path / "absent", tmp_path):
        with pytest.raises(NergError, match=path.name):
            atomic.file_sha256(path)
