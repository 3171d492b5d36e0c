"""Files of frames: what is written is read, and what is none is told in a sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerg_mi.errors import NergError
from nerg_mi.rendering import files
from nerg_mi.rendering.files import numbered, read_frames, write_frames


def test_what_is_written_is_read(tmp_path):
    frames = [{"eye": "1, 2, 3", "falloff": "0.1"}, {"eye": 'a "b"', "falloff": ""}]
    write_frames(tmp_path / "a.csv", frames)
    assert read_frames(tmp_path / "a.csv") == frames
    (tmp_path / "b.csv").write_text('\ufeffeye,ahead\r\n\r\n"1,2,3","4,5,6"\r\n')
    assert read_frames(tmp_path / "b.csv") == [{"eye": "1,2,3", "ahead": "4,5,6"}]


@pytest.mark.parametrize(
    "text, said",
    [
        ("", "holds no frames"),
        ("eye\n", "holds no frames"),
        ("eye,ahead\n1,2,3\n", r"line 2\) has 3 values for 2 names; positions have commas"),
        ("1,2\n3,4\n", 'begins with "1"'),
        ("eye,eye\n1,2\n", "names a <default> twice"),
        ('eye\n"1\n', "is no CSV"),
        (",".join(f"a{i}" for i in range(65)) + "\n", "65 names"),
    ],
)
def test_what_is_none(tmp_path, text, said):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(NergError, match=said):
        read_frames(tmp_path / "a.csv")


def test_bounds(tmp_path, monkeypatch):
    (tmp_path / "a.csv").write_bytes(b"eye\n\xff\n")
    with pytest.raises(NergError, match="cannot be read"):
        read_frames(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("eye\n1\n2\n")
    monkeypatch.setattr(files, "FRAMES", 1)
    with pytest.raises(NergError, match="more than 1 frames"):
        read_frames(tmp_path / "b.csv")
    with pytest.raises(NergError, match="there is no file of frames"):
        read_frames(tmp_path / "nowhere.csv")


def test_numbers_in_names():
    assert numbered(Path("a/walk.png"), 7, 12) == Path("a/walk_0007.png")
    assert numbered(Path("walk.exr"), 7, 12345) == Path("walk_00007.exr")
