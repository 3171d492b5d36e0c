"""Tables as CSV, Markdown and Parquet."""

from __future__ import annotations

import csv

import pytest

from nerg_mi.jobs.counting import writing

ROWS = [
    {"cell": "all", "value": "", "thing": "a|b", "n": 3, "x": 0.125},
    {"cell": "zone", "value": "z", "thing": "c", "n": None, "x": None},
]


def test01_all_kinds(tmp_path):
    files = writing.write_rows(tmp_path, "t", ROWS, *writing.plain_columns(ROWS, ()))
    with files[0].open() as file:
        rows = list(csv.DictReader(file))
    assert rows[0]["x"] == "0.125" and rows[1]["n"] == "" and rows[0]["thing"] == "a|b"
    assert "| all |  | a\\|b | 3 | 0.125 |" in files[1].read_text()
    pq = pytest.importorskip("pyarrow.parquet")
    assert pq.read_table(files[2]).to_pylist() == ROWS


def test02_without_pyarrow(tmp_path, monkeypatch):
    monkeypatch.setattr(writing, "find_spec", lambda name: None)
    files = writing.write_rows(tmp_path, "t", ROWS, *writing.plain_columns(ROWS, ()))
    assert [f.suffix for f in files] == [".csv", ".md"]


def test03_things_show_what_is_known():
    row = {"cell": "cohort", "value": "x", "thing": "a", "source": "tracked", "people": None, "share": 0.5}
    head, cells = writing.thing_columns([row])
    assert head == ["cell", "thing", "source", "people", "share of time"]
    assert cells(row) == ["cohort x", "a", "tracked", "", "50.0 %"] and writing.cell_name({"cell": "all"}) == "all"
