"""By what a source is known again."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.dataset_write import Marks
from nerg_mi.rays.readers.base import NoOptions

from .making import settings


@pytest.fixture
def file(tmp_path) -> Path:
    (tmp_path / "a.csv").write_text("x")
    os.utime(tmp_path / "a.csv", (1e9, 1e9))
    return tmp_path / "a.csv"


def test_path_content_and_name(file, tmp_path):
    marks = Marks()
    before = marks.where(file), marks.stamp(file), marks.source(file, "r")
    assert len(set(before)) == 3 and all(len(mark) == 32 for mark in before)
    file.write_text("y")
    os.utime(file, (1e9, 1e9))
    # What the time of change does not tell the content does.
    assert marks.stamp(file) == before[1] and marks.source(file, "r") != before[2]
    (tmp_path / "b.csv").write_text("y")
    assert marks.source(tmp_path / "b.csv", "r") != marks.source(file, "r") != marks.source(file, "s")
    (tmp_path / "link.csv").symlink_to(file)
    assert marks.where(tmp_path / "link.csv") == before[0]
    with pytest.raises(NergError, match="no tracking file"):
        marks.stamp(tmp_path / "absent.csv")


def test_what_was_changed_just_now_has_no_stamp(file):
    os.utime(file)
    assert Marks().stamp(file) is None


def test_folders(tmp_path):
    for name in ("b/2.csv", "a.csv"):
        (tmp_path / "session" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "session" / name).write_text(name)
        os.utime(tmp_path / "session" / name, (1e9, 1e9))
    marks, folder = Marks(), tmp_path / "session"
    one = marks.stamp(folder), marks.source(folder, "r")
    os.utime(folder / "b/2.csv", (1e9, 2e8))
    assert marks.stamp(folder) != one[0] and marks.source(folder, "r") == one[1]
    (folder / "b/2.csv").rename(folder / "b/3.csv")
    assert marks.source(folder, "r") != one[1]


def test_how_sources_are_read(tmp_path):
    marks = Marks()
    assert marks.recipe("table", settings()) == marks.recipe("table", settings())
    found = {marks.recipe("table", settings()), marks.recipe("other", settings()), marks.recipe("table", NoOptions())}
    assert len(found | {marks.recipe("table", settings(), day="2024-01-01")}) == 4


def test_marks_under_a_salt_tell_nothing_to_those_without(file):
    one, two = Marks(bytes(16)), Marks(bytes(range(16)))
    for name in ("where", "stamp"):
        assert len({getattr(marks, name)(file) for marks in (Marks(), one, two)}) == 3
    assert len({marks.source(file, "r") for marks in (Marks(), one, two)}) == 3
