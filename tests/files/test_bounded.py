"""Damaged and hostile files get one sentence, before anything is allocated for what they claim."""

from __future__ import annotations

import math
import os
import struct
import zlib

import pytest

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.files import safe_read
from nerg_mi.files.safe_read import map_bytes, parse_json, plain, read_bytes, read_json, reading, size_of
from nerg_mi.formats.areas import Region


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
def test_what_a_damaged_file_raises_becomes_one_sentence(error):
    with pytest.raises(NergError) as told, reading("a.bin", "depth file", "copy it again"):
        raise error
    said = str(told.value)
    assert 'the depth file "a.bin" cannot be read: ' in said and said.endswith("; copy it again")
    assert said.isprintable() and told.value.__cause__ is error


def test_programming_errors_and_finished_sentences_pass():
    with pytest.raises(TypeError), reading("a.bin"):
        _ = None + 1
    with pytest.raises(NergError, match="^as it is$"), reading("a.bin"):
        raise NergError("as it is")
    with pytest.raises(AttributeError), reading("a.bin"):
        _ = None.shape
    with pytest.raises(NergError), reading("a.bin", also=(AttributeError,)):
        _ = None.shape


def test_the_safetensors_library_is_known_by_name(tmp_path):
    safetensors = pytest.importorskip("safetensors")
    with pytest.raises(NergError, match="a.safetensors"), reading("a.safetensors"):
        raise safetensors.SafetensorError("header too large")


def test_a_missing_file_is_both_kinds_of_error(tmp_path):
    for kind in (MissingFile, FileNotFoundError, NergError):
        with pytest.raises(kind, match=r'there is no checkpoint ".*a\.bin"'):
            read_bytes(tmp_path / "a.bin", "checkpoint", 9)


def test_only_ordinary_files_of_bounded_size_are_read(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", "file", 5) == b"12345" and size_of(tmp_path / "a") == 5
    with pytest.raises(NergError, match="5 bytes, more than the 4"):
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


def test_mapped_files_begin_as_they_should(tmp_path):
    (tmp_path / "a").write_bytes(b"ply 345")
    assert bytes(map_bytes(tmp_path / "a", "mesh", 7, b"ply")) == b"ply 345"
    with pytest.raises(NergError, match="7 bytes, more than the 6"):
        map_bytes(tmp_path / "a", "mesh", 6, b"ply")
    with (tmp_path / "a").open("wb") as out:
        for size in (0, 64 << 30):
            out.truncate(size)
            with pytest.raises(NergError, match='"ply"'):
                map_bytes(tmp_path / "a", "mesh", 1 << 40, b"ply", "export it again")


def test_json_is_read_as_before(tmp_path):
    path = tmp_path / "a.json"
    path.write_bytes('{"a": [1, 2.5, "é"], "a": 3}'.encode("utf-16"))
    assert read_json(path) == {"a": 3}
    deep = "[" * 60 + "]" * 60
    assert parse_json(
        '{"brackets": "' + "[" * 500 + '", "escaped": "\\"' + "{" * 500 + '", "deep": ' + deep + "}", path
    )


@pytest.mark.parametrize("raw", [b"[" * 200_000, b'{"a":' * 70 + b"1" + b"}" * 70, b"[" * 65 + b"]" * 65])
def test_deep_json_is_refused_before_it_is_parsed(tmp_path, raw, monkeypatch):
    monkeypatch.setattr(safe_read.json, "loads", lambda text: pytest.fail("it was parsed"))
    (tmp_path / "a.json").write_bytes(raw)
    with pytest.raises(NergError, match="nested"):
        read_json(tmp_path / "a.json")


def test_json_of_very_many_values_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(safe_read, "JSON_VALUES", 100)
    assert len(parse_json("[" + "[]," * 40 + "1]", "a.json")) == 41
    with pytest.raises(NergError, match="more than the 100 values"):
        parse_json("[" + "{}," * 99 + "1]", "a.json")


@pytest.mark.parametrize("raw", [b"", b"{", b"\xff\xfe\xfa", b'{"a": NaNN}', b'"' + b'\\"' * 50_000])
def test_what_is_no_json_is_told_with_the_file(tmp_path, raw):
    (tmp_path / "a.json").write_bytes(raw)
    with pytest.raises(NergError, match=r"a\.json"):
        read_json(tmp_path / "a.json")


def test_words_of_a_file_are_made_fit_for_a_message():
    assert plain("a\x1b[2J\nb") == "a?[2J?b" and plain("x" * 400) == "x" * 300 + "..."


def test_limits_themselves_are_within(tmp_path, monkeypatch):
    monkeypatch.setattr(safe_read, "JSON_VALUES", 100)
    monkeypatch.setattr(safe_read, "JSON_DEPTH", 3)
    # As many values as brackets are opened and commas stand there.
    assert parse_json("[[[" + "1," * 97 + "1]]]", "a.json") == [[[1] * 98]]
    for beyond in ("[[[" + "1," * 98 + "1]]]", "[[[[1]]]]"):
        with pytest.raises(NergError, match="more than the 100 values|nested 4 deep"):
            parse_json(beyond, "a.json")
    assert [safe_read.is_count(v) for v in (0, (1 << 62) - 1, 1 << 62, -1, True, 1.0)] == [True, True, *[False] * 4]


@pytest.mark.parametrize("digits", [309, 400, 5000])
def test_integers_that_no_float_holds_are_infinite(digits):
    found = parse_json(f"[{digits * '9'}, -{digits * '9'}, {'9' * 20}]", "a.json")
    assert found == [math.inf, -math.inf, 10**20 - 1]
    with pytest.raises(NergError, match="reaches to inf; its corners must be finite, and at most 1e.07"):
        Region("shelf", (0, 0, 0), (1, 1, found[0]))


def test_documents_within_other_files_have_the_same_limit():
    with pytest.raises(NergError, match="12 bytes, more than the 11"):
        parse_json(b'{"a": [1,2]}', "a.glb", most=11)
