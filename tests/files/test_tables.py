"""Tables and documents of results."""

import csv
import json
import math
import os

import numpy as np
import pytest

from nerg_mi.files.tables import add_notes, format_markdown_table, unescape_formula, write_csv, write_json


def test_rows_round_trip_with_empty_cells(tmp_path):
    path = tmp_path / "new" / "a.csv"
    write_csv(path, [{"a": 1, "b": 'é, "x"'}, {"a": 2.5, "c": "2\n3"}])
    with path.open(encoding="utf-8", newline="") as file:
        assert list(csv.DictReader(file)) == [{"a": "1", "b": 'é, "x"', "c": ""}, {"a": "2.5", "b": "", "c": "2\n3"}]
    write_csv(path, [{"a": 1, "b": math.nan}], ("b", "a"))
    assert path.read_bytes() == b"b,a\r\n,1\r\n"


def test_notes_say_why_values_are_missing():
    """None, NaN, absent keys and columns without any value; the note is the last key, also the second time."""
    rows = [{"a": 1, "b": math.nan, "note": "old"}, {"a": None, "b": 2.0, "c": 0}, {"a": 0, "b": "", "c": False}]
    explain = lambda row, column: (column, "too dark" if column == "c" else f"no {column}")
    for _ in range(2):
        add_notes(rows, explain)
        assert [row["note"] for row in rows] == ["b: no b; c: too dark", "a: no a", ""]
        assert all(list(row)[-1] == "note" for row in rows)
    add_notes(rows, lambda row, column: ("all", "unknown"), ["d"])
    assert [row["note"] for row in rows] == ["all: unknown"] * 3


def test_failing_table_keeps_old_file(tmp_path):
    for name, write in (
        ("a.csv", lambda p: write_csv(p, [{"a": 1}, {"b": 1}], ("a",))),
        ("a.json", lambda p: write_json(p, math.nan, allow_nan=False)),
    ):
        (tmp_path / name).write_bytes(b"old")
        with pytest.raises(ValueError):
            write(tmp_path / name)
        assert (tmp_path / name).read_bytes() == b"old"
    assert sorted(os.listdir(tmp_path)) == ["a.csv", "a.json"]


def test_json_has_null_for_non_finite_numbers(tmp_path):
    value = {"a": [1, math.nan], "b": {"c": (np.float64("inf"), "nan")}}
    write_json(tmp_path / "a.json", value)
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": [1, None], "b": {"c": [None, "nan"]}}
    write_json(tmp_path / "a.json", value, allow_nan=True)
    assert math.isnan(json.loads((tmp_path / "a.json").read_text())["a"][1])


FORMULAS = ["=1+1", "+cmd|' /C calc'!A0", "-A1", "@SUM(A1)", "\t=1", "\r=1", "-1-2", "'=1", "''+a", "\uff1d1"]
HARMLESS = ["a=b", "-1", "+1e-3", "-inf", "-1, 2.5, -3", "'a", "-", "", "Ada", 1.5, -2, None]


@pytest.mark.parametrize("name", [*FORMULAS, *HARMLESS])
def test_cells_are_escaped_formulas(tmp_path, name):
    write_csv(tmp_path / "a.csv", [{"person": name, "b": 1}])
    with (tmp_path / "a.csv").open(encoding="utf-8", newline="") as file:
        (cell, _) = list(csv.reader(file))[1]
    assert cell == ("" if name is None else f"'{name}" if name in FORMULAS else str(name))
    assert unescape_formula(cell) == ("" if name is None else str(name))


def test_columns_are_escaped_formulas(tmp_path):
    write_csv(tmp_path / "a.csv", [{"=a": 1}])
    assert (tmp_path / "a.csv").read_bytes() == b"'=a\r\n1\r\n"


@pytest.mark.parametrize(
    "text, cell",
    [
        ("<img src=x>", "\\<img src=x>"),
        ("a</td><!-- b", "a\\</td>\\<!-- b"),
        ("![a](http://b)", "\\![a](http://b)"),
        ("`--at <path>`, [a](b.md), \\<b>", "`--at <path>`, [a](b.md), \\<b>"),
        ("\\`<b>`", "\\`\\<b>`"),
        ("\\\\<b>", "\\\\\\<b>"),
        ("p < 0.05, a<3", "p < 0.05, a<3"),
        ("a\r\nb", "a b"),
    ],
)
def test_markdown_cells_are_escaped(text, cell):
    assert format_markdown_table(["a"], [[text]]).splitlines()[-1] == f"| {cell} |"


def test_markdown_table():
    text = format_markdown_table(["what", "a|b"], [["x", 1.5], ["two\nlines", None]], right_aligned=["a|b"])
    assert text == "| what | a\\|b |\n| --- | ---: |\n| x | 1.5 |\n| two lines | None |"
    assert format_markdown_table(["a"], []) == "| a |\n| --- |"
