"""Lines of large text files in blocks."""

from __future__ import annotations

import gzip

import pytest

from nerg_mi.errors import NergError
from nerg_mi.files import safe_read as module
from nerg_mi.files.safe_read import line_blocks


def lines(path, most=1000):
    return [line for block in line_blocks(path, "table", most) for line in block]


@pytest.mark.parametrize("chunk", [1, 2, 3, 7, 1 << 20])
@pytest.mark.parametrize(
    "text", ["", "a", "a\nb", "a\r\nb\r\n", "\n\n", "a\rb\r", "\u20ac\r\n\u2028x\x0by\n", "a\n\r\nb"]
)
def test_lines_are_those_of_python(tmp_path, monkeypatch, text, chunk):
    """Wherever the file is cut into pieces: within characters, and between the two that end a line."""
    monkeypatch.setattr(module, "_LINE_BLOCKS_CHUNK", chunk)
    (tmp_path / "t.csv").write_bytes(text.encode())
    with open(tmp_path / "t.csv", encoding="utf-8", newline="") as source:
        want = list(source)
    assert lines(tmp_path / "t.csv") == want
    (tmp_path / "t.csv.gz").write_bytes(gzip.compress(text.encode()))
    assert lines(tmp_path / "t.csv.gz", most=1) == want


def test_blocks_are_bounded_by_lines_and_characters(tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    path.write_text("abc\n" * 100)
    assert [len(b) for b in line_blocks(path, "table", 40)] == [40, 40, 20]
    monkeypatch.setattr(module, "_LINE_BLOCKS_CHUNK", 16)
    monkeypatch.setattr(module, "_BLOCK_CHARACTERS", 40)
    sizes = [len(b) for b in line_blocks(path, "table", 1000)]
    assert sum(sizes) == 100 and max(sizes) <= 14


def test_what_is_no_text(tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    path.write_bytes("name\n".encode("utf-16"))
    with pytest.raises(NergError, match='"[^"]*t.csv" is no UTF-8 text'):
        lines(path)
    path.write_bytes(b"a\xe2\x82")
    with pytest.raises(NergError, match="UTF-8"):
        lines(path)
    monkeypatch.setattr(module, "LINE_CHARACTERS", 100)
    monkeypatch.setattr(module, "_LINE_BLOCKS_CHUNK", 64)
    path.write_text("a\n" + "x" * 300)
    with pytest.raises(NergError, match="line 2 .* more than the 100 characters"):
        lines(path)
    monkeypatch.setattr(module, "_LINE_BLOCKS_CHUNK", 4096)  # the line ends within what is read at once
    path.write_text("a\n" + "x" * 300 + "\nb\n")
    with pytest.raises(NergError, match="line 2 .* more than the 100 characters"):
        lines(path)
    with pytest.raises(NergError, match="no table"):
        lines(tmp_path / "absent.csv")
    with pytest.raises(NergError, match="folder"):
        lines(tmp_path)


@pytest.mark.parametrize("cut", [5, 40, -9, -1])
def test_a_gzip_file_that_is_cut_off(tmp_path, cut):
    path = tmp_path / "t.csv.gz"
    path.write_bytes(gzip.compress("".join(f"{i},{i * 7}\n" for i in range(3000)).encode())[:cut])
    with pytest.raises(NergError, match="t.csv.gz"):
        lines(path)


def test_limits_themselves_are_within(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "LINE_CHARACTERS", 4)
    path = tmp_path / "t.csv"
    path.write_text("abc\n" * 4)
    assert [len(b) for b in line_blocks(path, "table", 2)] == [2, 2]
    path.write_text("abcd\n")
    with pytest.raises(NergError, match="line 1 of the table"):
        lines(path)
