"""Compressed files are inflated no further than their size warrants."""

from __future__ import annotations

import gzip
import io
import struct
import zipfile

import pytest

from nerg_mi.errors import NergError
from nerg_mi.files import safe_read
from nerg_mi.files.safe_read import inflated_limit, open_gzip, open_zip, read_member


def _zip(path, **members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def test_what_is_sound_is_read(tmp_path):
    path = tmp_path / "a.csv.gz"
    path.write_bytes(gzip.compress(b"x,y\n1,2\n" * 1000))
    with open_gzip(path) as stream:
        assert io.TextIOWrapper(stream).read() == "x,y\n1,2\n" * 1000
    with open_zip(_zip(tmp_path / "a.zip", a=b"1" * 3_000_000, b=b"")) as archive:
        assert read_member(archive, "a", "a.zip") == b"1" * 3_000_000 and read_member(archive, "b", "a.zip") == b""
    assert inflated_limit(10) == safe_read.FREE and inflated_limit(1 << 30) == 100 << 30


def test_inflation_stops_at_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(safe_read, "FREE", 1 << 20)
    path = tmp_path / "a.gz"
    path.write_bytes(gzip.compress(bytes(20 << 20)))
    taken = 0
    with open_gzip(path, "table") as stream, pytest.raises(NergError, match='the table ".*a.gz" inflates to more than'):
        while data := stream.read(1 << 16):
            taken += len(data)
    assert taken <= inflated_limit(path.stat().st_size)
    with pytest.raises(NergError, match="inflates to more than"), open_zip(_zip(tmp_path / "a.zip", a=bytes(20 << 20))):
        pytest.fail("it was opened")


def test_a_member_that_is_larger_than_it_claims_is_cut(tmp_path):
    """Both the claim in the list and that before the member say 10; asked for all at once, zlib would make 50 MB."""
    path = _zip(tmp_path / "a.zip", a=bytes(50 << 20))
    raw = path.read_bytes().replace(struct.pack("<I", 50 << 20), struct.pack("<I", 10))
    path.write_bytes(raw)
    import tracemalloc

    tracemalloc.start()
    with open_zip(path) as archive, pytest.raises(NergError, match="a.zip"):
        read_member(archive, "a", path)
    assert tracemalloc.get_traced_memory()[1] < 5 << 20
    tracemalloc.stop()


@pytest.mark.parametrize("claim", [1 << 27, (1 << 32) - 2])
def test_a_member_that_claims_more_than_it_can_hold_is_refused(tmp_path, claim):
    path = _zip(tmp_path / "a.zip", a=b"123")
    raw = bytearray(path.read_bytes())
    at = raw.rindex(b"PK\1\2")
    raw[at + 24 : at + 28] = struct.pack("<I", claim)
    path.write_bytes(raw)
    with pytest.raises(NergError, match="a.zip"), open_zip(path) as archive:
        read_member(archive, "a", path)


@pytest.mark.parametrize("cut", [0, 1, 30, 60, 99])
def test_damaged_archives_are_told_with_their_name(tmp_path, cut):
    path = _zip(tmp_path / "a.zip", a=b"1234567890" * 20)
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(NergError, match="a.zip"), open_zip(path) as archive:
        read_member(archive, "a", path)
    path.write_bytes(gzip.compress(b"1234567890" * 20)[: -1 - cut // 10])
    with pytest.raises(NergError, match="a.zip"), open_gzip(path) as stream:
        stream.read()


def test_a_changed_byte_is_found_by_its_checksum(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a", b"1234567890")
    path.write_bytes(path.read_bytes().replace(b"345", b"346"))
    with open_zip(path) as archive, pytest.raises(NergError, match="a.zip"):
        read_member(archive, "a", path)


def test_encrypted_doubled_and_missing_members_are_refused(tmp_path):
    path = _zip(tmp_path / "a.zip", a=b"1", b=b"2")
    raw = path.read_bytes()
    path.write_bytes(raw.replace(b"PK\1\2\x14\x03\x14\0\0\0", b"PK\1\2\x14\x03\x14\0\1\0"))
    with pytest.raises(NergError, match="encrypted"), open_zip(path):
        pass
    at = raw.rindex(b"PK\1\2") + 46
    path.write_bytes(raw[:at] + b"a" + raw[at + 1 :])
    with pytest.raises(NergError, match="two members of one name"), open_zip(path):
        pass
    path.write_bytes(raw)
    with open_zip(path) as archive, pytest.raises(NergError, match="c"):
        read_member(archive, "c", path)


def test_a_long_list_of_members_is_refused_before_it_is_read(tmp_path, monkeypatch):
    path = _zip(tmp_path / "a.zip", **{f"member{k}": b"" for k in range(50)})
    monkeypatch.setattr(safe_read, "DIRECTORY_BYTES", 1000)
    monkeypatch.setattr(zipfile, "ZipFile", lambda path: pytest.fail("it was read"))
    with pytest.raises(NergError, match="fewer members"), open_zip(path):
        pass


def test_an_archive_with_two_lists_of_members_is_refused(tmp_path):
    """Readers differ in which list they take where the end of the archive and its records disagree."""
    first, second = (_zip(tmp_path / f"{name}.zip", **{name: b"1"}).read_bytes() for name in "ab")
    at = len(second) - 22
    count, size, start = struct.unpack_from("<2xHII", second, at + 8)
    wide = struct.pack("<4sQHHIIQQQQ", b"PK\6\6", 44, 45, 45, 0, 0, count, count, size, start)
    locate = lambda place: struct.pack("<4sIQI", b"PK\6\7", 0, place, 1)
    whole = second[:at] + wide + locate(at) + second[at:]
    elsewhere = second[:at] + wide + wide + locate(at) + second[at:]
    for data, is_whole in ((second, True), (whole, True), (first + second, False), (elsewhere, False)):
        (tmp_path / "c.zip").write_bytes(data)
        if is_whole:
            with open_zip(tmp_path / "c.zip") as archive:
                assert archive.namelist() == ["b"]
        else:
            with pytest.raises(NergError, match="c.zip"), open_zip(tmp_path / "c.zip"):
                pass


def test_errors_of_the_block_are_its_own(tmp_path):
    path = _zip(tmp_path / "a.zip", a=b"1")
    with pytest.raises(KeyError), open_zip(path):
        raise KeyError("mine")


def test_limits_themselves_are_within(tmp_path, monkeypatch):
    path = tmp_path / "a.gz"
    path.write_bytes(gzip.compress(bytes(1000)))
    with open_gzip(path, most=1000) as stream:
        assert stream.read() == bytes(1000)
    with open_gzip(path, most=999) as stream, pytest.raises(NergError, match="inflates to more than 999"):
        stream.read()
    archive = _zip(tmp_path / "a.zip", a=b"1", b=b"23")
    with open_zip(archive, most=3) as found:
        assert found.read("b") == b"23"
    with pytest.raises(NergError, match="inflates to more than 2 bytes"), open_zip(archive, most=2):
        pass
    listed = safe_read._directory_bytes(archive, archive.stat().st_size)
    monkeypatch.setattr(safe_read, "DIRECTORY_BYTES", listed)
    with open_zip(archive) as found:
        assert found.namelist() == ["a", "b"]
    monkeypatch.setattr(safe_read, "DIRECTORY_BYTES", listed - 1)
    with pytest.raises(NergError, match="fewer members"), open_zip(archive):
        pass


def test_what_nothing_comes_out_of_is_bounded(tmp_path, monkeypatch):
    """Zeros may follow each member, and names may be long; not for gigabytes."""
    path, member = tmp_path / "a.gz", gzip.compress(b"1")
    for idle in (0, 1, 5000):
        path.write_bytes(member + bytes(idle) + member + bytes(idle))
        with open_gzip(path) as stream:
            assert stream.read() == b"11"
    named = member[:3] + b"\x08" + member[4:10] + b"n" * (1 << 26)
    for start in (member, named):
        with path.open("wb") as out:
            out.write(start)
            out.truncate(64 << 30)
        with open_gzip(path) as stream, pytest.raises(NergError, match="a.gz.*16,777,216"):
            stream.read()
    path.write_bytes(member + b"and more")
    with open_gzip(path) as stream, pytest.raises(NergError, match="a.gz"):
        stream.read()
