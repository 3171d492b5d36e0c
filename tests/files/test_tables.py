"""Tables and documents of results."""

import csv
import json
import math
import os

import pytest

from nerg_mi.files.tables import markdown_table, write_csv, write_json


def test_rows_come_back_and_what_they_lack_is_empty(tmp_path):
    path = tmp_path / "new" / "a.csv"
    write_csv(path, [{"a": 1, "b": 'é, "x"'}, {"a": 2.5, "c": "2\n3"}])
    with path.open(encoding="utf-8", newline="") as file:
        assert list(csv.DictReader(file)) == [{"a": "1", "b": 'é, "x"', "c": ""}, {"a": "2.5", "b": "", "c": "2\n3"}]
    write_csv(path, [{"a": 1}], ("b", "a"))
    assert path.read_bytes() == b"b,a\r\n,1\r\n"


def test_a_table_that_cannot_be_made_leaves_the_old_one(tmp_path):
    for name, write in (
        ("a.csv", lambda p: write_csv(p, [{"a": 1}, {"b": 1}], ("a",))),
        ("a.json", lambda p: write_json(p, math.nan, allow_nan=False)),
    ):
        (tmp_path / name).write_bytes(b"old")
        with pytest.raises(ValueError):
            write(tmp_path / name)
        assert (tmp_path / name).read_bytes() == b"old"
    write_json(tmp_path / "a.json", {"a": [1, math.nan]})
    assert math.isnan(json.loads((tmp_path / "a.json").read_text())["a"][1]) and sorted(os.listdir(tmp_path)) == [
        "a.csv",
        "a.json",
    ]


def test_a_markdown_table():
    text = markdown_table(["what", "a|b"], [["x", 1.5], ["two\nlines", None]], right=["a|b"])
    assert text == "| what | a\\|b |\n| --- | ---: |\n| x | 1.5 |\n| two lines | None |"
    assert markdown_table(["a"], []) == "| a |\n| --- |"
