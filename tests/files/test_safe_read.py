"""Tests of `nerg_mi.files.safe_read`."""

from __future__ import annotations

import gzip
import io
import math
import os
import struct
import zipfile
import zlib

import numpy as np
import pytest

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.files import safe_read
from nerg_mi.files import safe_read as module
from nerg_mi.files.safe_read import (
    check_regular_file,
    compute_inflation_limit,
    map_bytes,
    open_gzip,
    open_npz,
    open_zip,
    parse_json,
    read_bytes,
    read_json,
    read_line_blocks,
    read_member,
    read_npy,
    read_npz,
    read_text,
    sanitize,
    translate_read_errors,
)
from nerg_mi.formats.boxes import Region
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.photos.colmap import read_image_poses

# ---- Damaged and malicious files are refused before memory is allocated ----


@pytest.mark.parametrize(
    "content, remedy",
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", "git lfs pull"),
        (b"\n<!DOCTYPE html><html></html>", "web page; download"),
        (gzip.compress(b"v 0 0 0", mtime=0), "gzip; decompress"),
        (b"BZh91AY&SY", "bzip2; decompress"),
    ],
    ids=["pointer", "page", "gzip", "bzip2"],
)
def test_files_with_other_content_than_their_name_says(tmp_path, content, remedy):
    for name, read in {
        "a.csv": lambda path: list(read_line_blocks(path, "table", 10)) and parse_json(path.read_bytes(), path),
        "a.json": read_json,
        "a.npy": read_npy,
        "a.obj": read_mesh_file,
        "a.ply": read_mesh_file,
        "cameras.bin": lambda path: read_image_poses(path.parent),
    }.items():
        (tmp_path / "images.bin").write_bytes(content)
        (tmp_path / name).write_bytes(content)
        with pytest.raises(NergError, match=f"{name if name != 'cameras.bin' else 'images.bin'}.*{remedy}"):
            read(tmp_path / name)


@pytest.mark.parametrize(
    "error",
    [
        EOFError(),
        KeyError("frames"),
        OverflowError("too large"),
        RecursionError(),
        MemoryError(),
        struct.error("4 bytes needed"),
        zlib.error("incorrect header"),
        UnicodeDecodeError("utf-8", b"\xff", 0, 1, "bad"),
        OSError(5, "Input/output error"),
        ValueError("two\nlines \x1b[31m"),
    ],
)
def test_errors_of_damaged_files_are_translated(error):
    with pytest.raises(NergError) as message, translate_read_errors("a.bin", "depth file", "copy it again"):
        raise error
    said = str(message.value)
    assert 'the depth file "a.bin" cannot be read: ' in said and said.endswith("; copy it again")
    assert said.isprintable() and message.value.__cause__ is error


def test_bugs_and_nerg_errors_pass():
    with pytest.raises(TypeError), translate_read_errors("a.bin"):
        _ = None + 1
    with pytest.raises(NergError, match="^as it is$"), translate_read_errors("a.bin"):
        raise NergError("as it is")
    with pytest.raises(AttributeError), translate_read_errors("a.bin"):
        _ = None.shape
    with pytest.raises(NergError), translate_read_errors("a.bin", extra_errors=(AttributeError,)):
        _ = None.shape


def test_safetensors_error_is_recognized_by_name(tmp_path):
    safetensors = pytest.importorskip("safetensors")
    with pytest.raises(NergError, match="a.safetensors"), translate_read_errors("a.safetensors"):
        raise safetensors.SafetensorError("header too large")


def test_missing_file_is_nerg_error_and_file_not_found(tmp_path):
    for kind in (MissingFile, FileNotFoundError, NergError):
        with pytest.raises(kind, match=r'there is no checkpoint ".*a\.bin"'):
            read_bytes(tmp_path / "a.bin", "checkpoint", 9)


def test_only_regular_files_of_bounded_size_are_read(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", "file", 5) == b"12345" and check_regular_file(tmp_path / "a") == 5
    with pytest.raises(NergError, match="5 bytes; the limit is 4"):
        read_bytes(tmp_path / "a", "file", 4)
    with pytest.raises(NergError, match="is a folder"):
        read_bytes(tmp_path, "file", 9)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(NergError, match="is a pipe"):
        read_bytes(tmp_path / "pipe", "file", 9)
    with pytest.raises(NergError, match="is a device"):
        read_bytes("/dev/zero", "file", 9)
    with pytest.raises(NergError):
        read_bytes("a\0b", "file", 9)


def test_mapped_files_need_magic(tmp_path):
    (tmp_path / "a").write_bytes(b"ply 345")
    assert bytes(map_bytes(tmp_path / "a", "mesh", 7, b"ply")) == b"ply 345"
    with pytest.raises(NergError, match="7 bytes; the limit is 6"):
        map_bytes(tmp_path / "a", "mesh", 6, b"ply")
    with (tmp_path / "a").open("wb") as out:
        for size in (0, 64 << 30):
            out.truncate(size)
            with pytest.raises(NergError, match='"ply"'):
                map_bytes(tmp_path / "a", "mesh", 1 << 40, b"ply", "export it again")


@pytest.mark.parametrize(
    "reason, end",
    [
        ("its triangles are compressed; export it without compression", "compressed; export it without compression"),
        ("it has 7 bytes; the limit is 6", "the limit is 6; export it again"),
    ],
)
def test_one_remedy(tmp_path, reason, end):
    with pytest.raises(NergError) as error, safe_read.translate_read_errors(tmp_path / "a", "mesh", "export it again"):
        raise ValueError(reason)
    assert str(error.value).endswith(end)


def test_json_equals_json_module(tmp_path):
    path = tmp_path / "a.json"
    path.write_bytes('{"a": [1, 2.5, "é"], "b": 3}'.encode("utf-16"))
    assert read_json(path) == {"a": [1, 2.5, "é"], "b": 3}
    deep = "[" * 60 + "]" * 60
    assert parse_json(
        '{"brackets": "' + "[" * 500 + '", "escaped": "\\"' + "{" * 500 + '", "deep": ' + deep + "}", path
    )


@pytest.mark.parametrize("raw", [b"[" * 200_000, b'{"a":' * 70 + b"1" + b"}" * 70, b"[" * 65 + b"]" * 65])
def test_deep_json_is_refused_before_parsing(tmp_path, raw, monkeypatch):
    monkeypatch.setattr(safe_read.json, "loads", lambda text: pytest.fail("it was parsed"))
    (tmp_path / "a.json").write_bytes(raw)
    with pytest.raises(NergError, match="nested"):
        read_json(tmp_path / "a.json")


def test_json_with_too_many_values_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(safe_read, "MAX_JSON_VALUES", 100)
    assert len(parse_json("[" + "[]," * 40 + "1]", "a.json")) == 41
    with pytest.raises(NergError, match="more than 100 values"):
        parse_json("[" + "{}," * 99 + "1]", "a.json")


@pytest.mark.parametrize("raw", [b"", b"{", b"\xff\xfe\xfa", b'{"a": NaNN}', b'"' + b'\\"' * 50_000])
def test_invalid_json_error_names_file(tmp_path, raw):
    (tmp_path / "a.json").write_bytes(raw)
    with pytest.raises(NergError, match=r"a\.json"):
        read_json(tmp_path / "a.json")


def test_text_of_files_is_sanitized():
    assert sanitize("a\x1b[2J\nb") == "a?[2J?b" and sanitize("x" * 400) == "x" * 300 + "..."


def test_json_with_a_repeated_key_is_refused():
    with pytest.raises(NergError, match='"shelf"'):
        parse_json('{"regions": {"shelf": 1, "wall": 2, "shelf": 3}}', "a.json")
    assert parse_json('[{"a": 1}, {"a": {"a": 2}}]', "a.json") == [{"a": 1}, {"a": {"a": 2}}]


def test_json_limits_are_inclusive(tmp_path, monkeypatch):
    monkeypatch.setattr(safe_read, "MAX_JSON_VALUES", 100)
    monkeypatch.setattr(safe_read, "MAX_JSON_DEPTH", 3)
    # The number of values is that of opening brackets and commas.
    assert parse_json("[[[" + "1," * 97 + "1]]]", "a.json") == [[[1] * 98]]
    for beyond in ("[[[" + "1," * 98 + "1]]]", "[[[[1]]]]"):
        with pytest.raises(NergError, match="more than 100 values|nested 4 levels deep"):
            parse_json(beyond, "a.json")
    assert [safe_read.is_count(v) for v in (0, (1 << 62) - 1, 1 << 62, -1, True, 1.0)] == [True, True, *[False] * 4]


@pytest.mark.parametrize("digits", [309, 400, 5000])
def test_integers_that_no_float_holds_are_infinite(digits):
    value = parse_json(f"[{digits * '9'}, -{digits * '9'}, {'9' * 20}]", "a.json")
    assert value == [math.inf, -math.inf, 10**20 - 1]
    with pytest.raises(NergError, match="has a coordinate of inf; the corners must be finite, and at most 1e.07"):
        Region("shelf", (0, 0, 0), (1, 1, value[0]))


def test_embedded_json_has_same_limit():
    with pytest.raises(NergError, match="12 bytes; the limit is 11"):
        parse_json(b'{"a": [1,2]}', "a.glb", max_bytes=11)


# ---- The inflated size of compressed files is limited ----


def _zip(path, **members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def test_valid_archives_are_read(tmp_path):
    path = tmp_path / "a.csv.gz"
    path.write_bytes(gzip.compress(b"x,y\n1,2\n" * 1000))
    with open_gzip(path) as stream:
        assert io.TextIOWrapper(stream).read() == "x,y\n1,2\n" * 1000
    with open_zip(_zip(tmp_path / "a.zip", a=b"1" * 3_000_000, b=b"")) as archive:
        assert read_member(archive, "a", "a.zip") == b"1" * 3_000_000 and read_member(archive, "b", "a.zip") == b""
    assert (
        compute_inflation_limit(10) == safe_read.MIN_INFLATION_LIMIT and compute_inflation_limit(1 << 30) == 100 << 30
    )


def test_inflation_stops_at_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(safe_read, "MIN_INFLATION_LIMIT", 1 << 20)
    path = tmp_path / "a.gz"
    path.write_bytes(gzip.compress(bytes(20 << 20)))
    taken = 0
    with open_gzip(path, "table") as stream, pytest.raises(NergError, match='the table ".*a.gz" inflates to more than'):
        while data := stream.read(1 << 16):
            taken += len(data)
    assert taken <= compute_inflation_limit(path.stat().st_size)
    with pytest.raises(NergError, match="inflates to more than"), open_zip(_zip(tmp_path / "a.zip", a=bytes(20 << 20))):
        pytest.fail("it was opened")


def test_member_larger_than_claimed_is_truncated(tmp_path):
    """Both the member list and the header of the member claim 10 bytes; with one large read, zlib would allocate
    50 MB.
    """
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
def test_member_with_impossible_claim_is_refused(tmp_path, claim):
    path = _zip(tmp_path / "a.zip", a=b"123")
    raw = bytearray(path.read_bytes())
    at = raw.rindex(b"PK\1\2")
    raw[at + 24 : at + 28] = struct.pack("<I", claim)
    path.write_bytes(raw)
    with pytest.raises(NergError, match="a.zip"), open_zip(path) as archive:
        read_member(archive, "a", path)


@pytest.mark.parametrize("cut", [0, 1, 30, 60, 99])
def test_damaged_archive_error_names_file(tmp_path, cut):
    path = _zip(tmp_path / "a.zip", a=b"1234567890" * 20)
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(NergError, match="a.zip"), open_zip(path) as archive:
        read_member(archive, "a", path)
    path.write_bytes(gzip.compress(b"1234567890" * 20)[: -1 - cut // 10])
    with pytest.raises(NergError, match="a.zip"), open_gzip(path) as stream:
        stream.read()


def test_changed_byte_is_detected_by_checksum(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a", b"1234567890")
    path.write_bytes(path.read_bytes().replace(b"345", b"346"))
    with open_zip(path) as archive, pytest.raises(NergError, match="a.zip"):
        read_member(archive, "a", path)


def test_encrypted_duplicate_and_missing_members_are_refused(tmp_path):
    path = _zip(tmp_path / "a.zip", a=b"1", b=b"2")
    raw = path.read_bytes()
    path.write_bytes(raw.replace(b"PK\1\2\x14\x03\x14\0\0\0", b"PK\1\2\x14\x03\x14\0\1\0"))
    with pytest.raises(NergError, match="encrypted"), open_zip(path):
        pass
    at = raw.rindex(b"PK\1\2") + 46
    path.write_bytes(raw[:at] + b"a" + raw[at + 1 :])
    with pytest.raises(NergError, match="two members with the same name"), open_zip(path):
        pass
    path.write_bytes(raw)
    with open_zip(path) as archive, pytest.raises(NergError, match="c"):
        read_member(archive, "c", path)


def test_long_member_list_is_refused_before_reading(tmp_path, monkeypatch):
    path = _zip(tmp_path / "a.zip", **{f"member{k}": b"" for k in range(50)})
    monkeypatch.setattr(safe_read, "MAX_DIRECTORY_BYTES", 1000)
    monkeypatch.setattr(zipfile, "ZipFile", lambda path: pytest.fail("it was read"))
    with pytest.raises(NergError, match="fewer members"), open_zip(path):
        pass


def test_archive_with_two_member_lists_is_refused(tmp_path):
    """Readers choose different lists if the end of the archive and its records disagree."""
    first, second = (_zip(tmp_path / f"{name}.zip", **{name: b"1"}).read_bytes() for name in "ab")
    at = len(second) - 22
    count, size, start = struct.unpack_from("<2xHII", second, at + 8)
    wide = struct.pack("<4sQHHIIQQQQ", b"PK\6\6", 44, 45, 45, 0, 0, count, count, size, start)
    locate = lambda place: struct.pack("<4sIQI", b"PK\6\7", 0, place, 1)
    content = second[:at] + wide + locate(at) + second[at:]
    elsewhere = second[:at] + wide + wide + locate(at) + second[at:]
    for data, is_whole in ((second, True), (content, True), (first + second, False), (elsewhere, False)):
        (tmp_path / "c.zip").write_bytes(data)
        if is_whole:
            with open_zip(tmp_path / "c.zip") as archive:
                assert archive.namelist() == ["b"]
        else:
            with pytest.raises(NergError, match="c.zip"), open_zip(tmp_path / "c.zip"):
                pass


def test_errors_in_block_pass_unchanged(tmp_path):
    path = _zip(tmp_path / "a.zip", a=b"1")
    with pytest.raises(KeyError), open_zip(path):
        raise KeyError("mine")


def test_inflation_limits_are_inclusive(tmp_path, monkeypatch):
    path = tmp_path / "a.gz"
    path.write_bytes(gzip.compress(bytes(1000)))
    with open_gzip(path, max_bytes=1000) as stream:
        assert stream.read() == bytes(1000)
    with open_gzip(path, max_bytes=999) as stream, pytest.raises(NergError, match="inflates to more than 999"):
        stream.read()
    archive = _zip(tmp_path / "a.zip", a=b"1", b=b"23")
    with open_zip(archive, max_bytes=3) as data:
        assert data.read("b") == b"23"
    with pytest.raises(NergError, match="inflates to more than 2 bytes"), open_zip(archive, max_bytes=2):
        pass
    listed = safe_read._count_directory_bytes(archive, archive.stat().st_size)
    monkeypatch.setattr(safe_read, "MAX_DIRECTORY_BYTES", listed)
    with open_zip(archive) as data:
        assert data.namelist() == ["a", "b"]
    monkeypatch.setattr(safe_read, "MAX_DIRECTORY_BYTES", listed - 1)
    with pytest.raises(NergError, match="fewer members"), open_zip(archive):
        pass


def test_gzip_without_output_is_bounded(tmp_path, monkeypatch):
    """Zeros may follow each member, and names may be long, but not gigabytes."""
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


# ---- Lines of large text files in blocks ----


def read_lines(path, max_lines=1000):
    return [line for block in read_line_blocks(path, "table", max_lines) for line in block]


@pytest.mark.parametrize("chunk", [1, 2, 3, 7, 1 << 20])
@pytest.mark.parametrize(
    "text", ["", "a", "a\nb", "a\r\nb\r\n", "\n\n", "a\rb\r", "\u20ac\r\n\u2028x\x0by\n", "a\n\r\nb"]
)
def test_lines_equal_those_of_python(tmp_path, monkeypatch, text, chunk):
    r"""Independent of the chunk boundaries: within characters, and between \r and \n."""
    monkeypatch.setattr(module, "_LINE_BLOCKS_CHUNK", chunk)
    (tmp_path / "t.csv").write_bytes(text.encode())
    with open(tmp_path / "t.csv", encoding="utf-8", newline="") as source:
        want = list(source)
    assert read_lines(tmp_path / "t.csv") == want
    (tmp_path / "t.csv.gz").write_bytes(gzip.compress(text.encode()))
    assert read_lines(tmp_path / "t.csv.gz", max_lines=1) == want


def test_blocks_are_bounded_by_lines_and_characters(tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    path.write_text("abc\n" * 100)
    assert [len(b) for b in read_line_blocks(path, "table", 40)] == [40, 40, 20]
    monkeypatch.setattr(module, "_LINE_BLOCKS_CHUNK", 16)
    monkeypatch.setattr(module, "_BLOCK_CHARACTERS", 40)
    sizes = [len(b) for b in read_line_blocks(path, "table", 1000)]
    assert sum(sizes) == 100 and max(sizes) <= 14


def test_binary_file_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    path.write_bytes("Jörg\n".encode("latin-1"))
    with pytest.raises(NergError, match='"[^"]*t.csv" is not UTF-8 text'):
        read_lines(path)
    path.write_bytes(b"a\xe2\x82")
    with pytest.raises(NergError, match="UTF-8"):
        read_lines(path)
    monkeypatch.setattr(module, "MAX_LINE_LENGTH", 100)
    monkeypatch.setattr(module, "_LINE_BLOCKS_CHUNK", 64)
    path.write_text("a\n" + "x" * 300)
    with pytest.raises(NergError, match="line 2 .* more than 100 characters"):
        read_lines(path)
    monkeypatch.setattr(module, "_LINE_BLOCKS_CHUNK", 4096)  # the line ends within one chunk
    path.write_text("a\n" + "x" * 300 + "\nb\n")
    with pytest.raises(NergError, match="line 2 .* more than 100 characters"):
        read_lines(path)
    with pytest.raises(NergError, match="no table"):
        read_lines(tmp_path / "absent.csv")
    with pytest.raises(NergError, match="folder"):
        read_lines(tmp_path)


def test_line_limits_are_inclusive(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MAX_LINE_LENGTH", 4)
    path = tmp_path / "t.csv"
    path.write_text("abc\n" * 4)
    assert [len(b) for b in read_line_blocks(path, "table", 2)] == [2, 2]
    path.write_text("abcd\n")
    with pytest.raises(NergError, match="line 1 of the table"):
        read_lines(path)


# ---- Arrays are allocated only for available bytes ----

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


def make_npy(shape, descr="<f8", data=b"", version=(1, 0)) -> bytes:
    head = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}".encode() + b"\n"
    return b"\x93NUMPY" + bytes(version) + struct.pack("<H" if version == (1, 0) else "<I", len(head)) + head + data


@pytest.mark.parametrize("array", _ARRAYS, ids=lambda a: f"{a.dtype}-{a.shape}")
def test_arrays_equal_those_of_numpy(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    np.savez(tmp_path / "a.npz", a=array, b=array)
    np.savez_compressed(tmp_path / "c.npz", a=array)
    arrays = [
        read_npy(tmp_path / "a.npy"),
        *read_npz(tmp_path / "a.npz").values(),
        *read_npz(tmp_path / "c.npz").values(),
    ]
    assert len(arrays) == 4
    for value in arrays:
        assert value.dtype == array.dtype and value.shape == array.shape and np.array_equal(value, array)
        assert value.flags.f_contiguous == array.flags.f_contiguous and value.flags.writeable


def test_array_headers_are_read_without_data(tmp_path):
    np.savez(tmp_path / "a.npz", rays=np.zeros((5, 3), np.float32), names=np.array(["a"]))
    with open_npz(tmp_path / "a.npz") as archive:
        assert archive.names == ["rays", "names"] and "rays" in archive and "others" not in archive
        assert archive.read_header("rays") == ((5, 3), np.float32)
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
def test_shapes_larger_than_the_file_are_refused(tmp_path, shape):
    data = make_npy(shape, data=bytes(24))
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(NergError, match="a.npy"):
        read_npy(tmp_path / "a.npy")
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x.npy", data)
    with pytest.raises(NergError, match='array "x" .*a.npz'):
        read_npz(tmp_path / "a.npz")


@pytest.mark.parametrize("descr", ["|O", "|S0", "<U0", "|V0", "<f99", "", "x" * 2000, [("a", "|O")], None, 7])
def test_non_numeric_dtypes_are_refused(tmp_path, descr):
    (tmp_path / "a.npy").write_bytes(make_npy("(1000000000000,)", descr, bytes(24)))
    with pytest.raises(NergError, match="a.npy"):
        read_npy(tmp_path / "a.npy")


def test_objects_are_not_unpickled(tmp_path):
    stream = io.BytesIO()
    np.save(stream, np.array([print], dtype=object), allow_pickle=True)
    (tmp_path / "a.npy").write_bytes(stream.getvalue())
    with pytest.raises(NergError, match="Python objects"):
        read_npy(tmp_path / "a.npy")


@pytest.mark.parametrize("cut", [0, 3, 8, 9, 20, 60, 127, 130])
def test_truncated_array_error_names_file(tmp_path, cut):
    np.save(tmp_path / "a.npy", np.arange(3.0))
    (tmp_path / "a.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:cut])
    with pytest.raises(NergError, match="a.npy"):
        read_npy(tmp_path / "a.npy")


def test_headers_and_versions_are_bounded(tmp_path):
    (tmp_path / "a.npy").write_bytes(make_npy("(1,)" + " " * 20_000, data=bytes(8), version=(2, 0)))
    with pytest.raises(NergError, match="a.npy"):
        read_npy(tmp_path / "a.npy")
    (tmp_path / "a.npy").write_bytes(make_npy("(1,)", data=bytes(8), version=(3, 0)))
    with pytest.raises(NergError, match="version 3.0"):
        read_npy(tmp_path / "a.npy")


@pytest.mark.parametrize("axes, good", [(32, True), (33, False)])
def test_number_of_axes_is_limited(tmp_path, axes, good):
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {(1,) * axes}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(8))
    if good:
        assert read_npy(tmp_path / "a.npy").shape == (1,) * axes
    else:
        with pytest.raises(NergError, match="claims the shape"):
            read_npy(tmp_path / "a.npy")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_byte_order_mark_is_no_content(tmp_path, encoding):
    path = tmp_path / "a.txt"
    path.write_text("x,y\n1,2\n", encoding=encoding)
    assert [line for block in read_line_blocks(path, "table", 9) for line in block] == ["x,y\n", "1,2\n"]
    assert read_text(path, "table", 99) == "x,y\n1,2\n"
    (tmp_path / "a.txt.gz").write_bytes(gzip.compress(path.read_bytes()))
    assert next(iter(read_line_blocks(tmp_path / "a.txt.gz", "table", 1))) == ["x,y\n"]
    path.write_text('{"a": 1}', encoding=encoding)
    assert read_json(path) == {"a": 1}


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be", "utf-32-le", "utf-32-be"])
def test_text_in_other_encodings_is_read_line_by_line_or_named(tmp_path, encoding):
    path = tmp_path / "a.txt"
    path.write_text("\ufeffx,y\n1,2\n", encoding=encoding)
    assert list(read_line_blocks(path, "table", 9)) == [["x,y\n", "1,2\n"]]
    with pytest.raises(NergError, match=f"a.txt.*{encoding[:6].upper()}"):
        read_text(path, "table", 99)


@pytest.mark.parametrize(
    "act, word",
    [
        ([].pop, "missing"),
        (lambda: {}["speed"], 'lacks "speed"'),
        (lambda: float("fast"), "fast"),
        (lambda: int("1,5"), "1,5"),
        (lambda: None["x"], "missing"),
        (lambda: (1).x, "missing"),
        (lambda: float(10**400), "too large"),
        (lambda: np.zeros(3).reshape(2, 2), "size"),
        (lambda: np.array([[1], [1, 2]], float), "size"),
        (lambda: struct.unpack("<I", b"a"), "truncated"),
        (b"\xff".decode, "UTF-8"),
        (lambda: zlib.decompress(b"a"), "compressed"),
    ],
)
def test_message_of_python_is_no_message_of_a_file(act, word):
    with (
        pytest.raises(NergError, match=word) as error,
        translate_read_errors("a", extra_errors=(TypeError, AttributeError)),
    ):
        act()
    cause = error.value.__cause__
    assert isinstance(cause, KeyError) or str(cause) not in str(error.value)


@pytest.mark.parametrize(
    "head, content",
    [
        (b"PK\x03\x04", "Excel workbook"),
        (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "Excel workbook"),
        (b"PAR1", "Parquet"),
        (b"SQLite format 3\0", "database"),
        (b"\x1f\x8b", "gzip"),
    ],
)
def test_content_of_another_kind_is_named(tmp_path, head, content):
    path = tmp_path / "a.csv"
    path.write_bytes(head + b"\xff" * 40)
    with pytest.raises(NergError, match=content):
        list(read_line_blocks(path, "table", 9))
    # A file that is of this kind by its name is only damaged.
    path = path.rename(tmp_path / "a.npz")
    with pytest.raises(NergError, match="damaged"), translate_read_errors(path):
        raise ValueError("it is damaged")


def test_message_of_a_reader_is_kept():
    def read():
        raise ValueError("it has 3 wheels")

    with pytest.raises(NergError, match="it has 3 wheels"), translate_read_errors("a"):
        read()
