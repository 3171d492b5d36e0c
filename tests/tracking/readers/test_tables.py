"""Tests of `nerg_mi.tracking.readers.tables`."""

import csv
import re
from decimal import Decimal

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.tracking.readers import tables as ray_tables
from nerg_mi.tracking.readers.cells import parse_vector
from nerg_mi.tracking.readers.tables import find_vector_columns, iterate_table, read_table_columns


def read(path, numbers, texts=()):
    return list(iterate_table(path, numbers, texts))


def choose_reader(monkeypatch, fast):
    """With pyarrow, or without it."""
    if fast:
        pytest.importorskip("pyarrow")
    else:
        monkeypatch.setattr(ray_tables, "_make_arrow_converter", lambda layout: None)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_columns_gaps_and_lines(tmp_path, separator):
    path = tmp_path / "t.csv"
    rows = ["name,b,a,c", '"Ann, B",1,2,3', "", "bo,,,", "cy,7,NaN,null"]
    path.write_text(
        "\n".join(
            r if '"' in r and separator == "," else r.replace('"Ann, B"', "Ann").replace(",", separator) for r in rows
        )
    )
    (block,) = read(path, ["a", "b", "c"], ["name"])
    assert np.array_equal(block.numbers, [[2, 1, 3], [np.nan] * 3, [np.nan, 7, np.nan]], equal_nan=True)
    assert list(block.texts[:, 0]) == ["Ann, B" if separator == "," else "Ann", "bo", "cy"]
    assert list(block.lines) == [2, 4, 5]


def test_blocks_keep_line_numbers(tmp_path, monkeypatch):
    monkeypatch.setattr(ray_tables, "BLOCK_ROWS", 4)
    path = tmp_path / "t.csv"
    path.write_text("a,b\n" + "".join(f"{i},{-i}\n" for i in range(10)))
    blocks = read(path, ["a"])
    assert [len(b.lines) for b in blocks] == [3, 4, 3] and blocks[-1].lines[-1] == 11
    assert np.array_equal(np.concatenate([b.numbers for b in blocks])[:, 0], np.arange(10))


def test_parquet(tmp_path):
    pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed (pip install pyarrow)")
    import pyarrow.parquet as pq

    path = tmp_path / "t.parquet"
    pq.write_table(pa.table({"a": [1.0, None, 3.0], "who": ["x", "y", "z"], "n": [1, 2, 3]}), path)
    (block,) = read(path, ["n", "a"], ["who"])
    assert np.array_equal(block.numbers, [[1, 1], [2, np.nan], [3, 3]], equal_nan=True)
    assert list(block.texts[:, 0]) == ["x", "y", "z"]


def test_decimal_numbers_of_parquet(tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    pq.write_table(pa.table({"t": pa.array([Decimal("0.25"), None])}), tmp_path / "t.parquet")
    for clocks in ({}, {"t": 1.0}):
        (block,) = iterate_table(tmp_path / "t.parquet", ["t"], clocks=clocks)
        np.testing.assert_array_equal(block.numbers, [[0.25], [np.nan]])


def test_table_without_a_header_and_its_columns(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("1,2,3\n4,,6\n")
    (block,) = list(iterate_table(path, ["c", "b"], header=["a", "b", "c"]))
    assert np.array_equal(block.numbers, [[3, 2], [6, np.nan]], equal_nan=True) and list(block.lines) == [1, 2]
    path.write_text("\ufeffx; y ;z\n")
    assert read_table_columns(path) == ["x", "y", "z"]


def test_with_and_without_pyarrow(tmp_path, monkeypatch):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed (pip install pyarrow)")
    rng = np.random.default_rng(0)
    path = tmp_path / "t.csv"
    values = rng.normal(size=(50, 3)) * 10.0 ** rng.integers(-12, 12, (50, 3))
    cells = [[repr(float(v)) for v in row] for row in values]
    cells[3][1], cells[7][0], cells[9][2], cells[11][1] = "", "NaN", "null", "inf"
    rows = [f'{a},"p {i % 3}",{b},{c}' + ("\n" if i == 20 else "") for i, (a, b, c) in enumerate(cells)]
    path.write_text("\n".join(["a,who,b,c", *rows]))
    wanted = [(["b", "a"], ["who"]), ([], ["who"])]
    fast = [read(path, *columns)[0] for columns in wanted]
    choose_reader(monkeypatch, False)
    slow = [read(path, *columns)[0] for columns in wanted]
    for one, other in zip(fast, slow):
        assert np.array_equal(one.numbers, other.numbers, equal_nan=True) and np.array_equal(one.texts, other.texts)
        assert np.array_equal(one.lines, other.lines) and one.lines[21] == 24
    assert np.isinf(fast[0].numbers[11, 0])


BAD = ["1,x\n", "1\n", "nonsense\n", '"1,2\n', "1,2e\n", "\x00\n", "1,1 2\n"]


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("fast", [True, False])
def test_bad_lines_are_reported_and_skipped(tmp_path, monkeypatch, bad, fast):
    choose_reader(monkeypatch, fast)
    path, bad_lines = tmp_path / "t.csv", []
    path.write_text("a,b\n" + "".join(f"{i},{i}\n" for i in range(5)) + bad + "7,7\n")
    blocks = list(iterate_table(path, ["a", "b"], on_bad_line=lambda line, why: bad_lines.append((line, why))))
    assert np.concatenate([block.numbers for block in blocks])[:, 0].tolist() == [0, 1, 2, 3, 4, 7]
    assert np.concatenate([block.lines for block in blocks]).tolist() == [2, 3, 4, 5, 6, 8]
    assert [line for line, _ in bad_lines] == [7]
    with pytest.raises(NergError, match="t.csv, line 7[:,].*skip_bad_lines"):
        read(path, ["a", "b"])


def test_bad_line_in_text_columns(tmp_path):
    """Texts and numbers of the other lines remain aligned."""
    path, bad_lines = tmp_path / "t.csv", []
    path.write_text("who,a\nann,1\nbo\ncy,3\n")
    (block,) = iterate_table(path, ["a"], ["who"], on_bad_line=lambda line, why: bad_lines.append(line))
    assert block.texts[:, 0].tolist() == ["ann", "cy"] and block.numbers[:, 0].tolist() == [1, 3] and bad_lines == [3]
    path.write_text("a,who\n1,ann\n2\n3,cy\n")
    with pytest.raises(NergError, match="line 3: 1 cells"):
        read(path, ["a"], ["who"])


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "column b; it is empty"),
        ("," * (ray_tables.MAX_COLUMNS + 1) + "\n", "more columns than"),
        ("a" * 200_000 + ",b\n1,2\n", "not a header"),
        ("a,b\n1,2\n3,four\n", "3.*'b'.*'four'"),
        ("a,b\n1,2\n3\n", "line 3: 1 cells"),
        ("a,q\n1,2\n", "column b; its columns"),
        ("b,y,b\n1,2,3\n", "several columns called 'b'"),
    ],
)
def test_damaged_tables_are_refused(tmp_path, text, message):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(NergError, match=message):
        read(tmp_path / "t.csv", ["b"])


def test_damaged_parquet_tables(tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "t.parquet"
    pq.write_table(pa.table({"a": np.arange(500.0), "who": ["x"] * 500}), path)
    data, rng = path.read_bytes(), np.random.default_rng(0)
    for at in rng.integers(0, len(data), 60).tolist():
        for hurt in (data[:at], data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :]):
            path.write_bytes(hurt)
            try:
                read(path, ["a"], ["who"])
            except NergError as error:
                assert "t.parquet" in str(error)
    long = pa.table({"a": [1.0, 2.0], "who": ["ann", "w" * 1001]})
    for table, numbers, texts, message in (
        (long, ["who"], [], "'who'.* does not contain numbers"),
        (long, ["a"], ["who"], "'who'.*1,000"),
        (pa.Table.from_arrays([pa.array([1.0]), pa.array([2.0])], ["a", "a"]), ["a"], [], "several columns called 'a'"),
        (pa.table({"a": np.zeros(20_000_000, np.int8)}), ["a"], [], "20,000,000 rows, too many for its size"),
    ):
        pq.write_table(table, path)
        with pytest.raises(NergError, match=message):
            read(path, numbers, texts)


@pytest.mark.parametrize("fast", [True, False])
def test_one_long_cell_does_not_exhaust_memory(tmp_path, monkeypatch, fast):
    """In an array of text, each cell takes the space of the longest one."""
    choose_reader(monkeypatch, fast)
    path, rows = tmp_path / "t.csv", 2000
    long = "w" * (ray_tables._MAX_TEXT_BLOCK // rows)
    path.write_text("a,who\n" + "1,ann\n" * rows + f"2,{long}\n" + "3,bo\n")
    with pytest.raises(NergError, match="2002.*'who'.*1,000"):
        read(path, ["a"], ["who"])
    reported = []
    (block,) = iterate_table(path, ["a"], ["who"], on_bad_line=lambda line, why: reported.append(line))
    assert (
        reported == [2002] and len(block.lines) == 2001 and block.texts[-1, 0] == "bo" and block.texts.nbytes < 1 << 20
    )
    # Numbers of such lines are read as usual.
    assert read(path, ["a"])[0].numbers[-2:, 0].tolist() == [2, 3]


ROWS = "a,b,c\n1,2,3\n4,5,6\n"


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize(
    "text, why",
    [
        ("a,b,c\n1,2,3\n4,5\n", "line 3: 2 cells, the header has 3; correct"),
        ("a,b,c\n1,2,3\n4.5,5.5,6,x\n", "line 3: 4 cells, the header has 3; correct"),
        ('a,b,c\n"1,2",3\n', "line 2: 2 cells, the header has 3"),  # as many commas as the header
        ("a,b,c\n1,2,3,\n4,5,6,,\n", "line 3: 5 cells"),
        ("i,a,b,c\n1,2,3\n", "line 2: 3 cells, the header has 4; correct"),
        ("a,b,c\n0,5,1,25,-0,1\n", "line 2: 6 cells, the header has 3; are these decimal commas"),
        ("a,b,c\n0,5,1.5,2.5\n", "line 2: 4 cells, the header has 3; are these decimal commas"),
        ("a,b,c\n2024-05-01 12:00:00,016,2,3\n", "line 2: 4 cells, the header has 3; are these decimal commas"),
    ],
)
def test_rows_that_do_not_match_the_header_are_refused(tmp_path, monkeypatch, text, why, fast):
    choose_reader(monkeypatch, fast)
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(NergError, match=why):
        read(tmp_path / "t.csv", ["b"])


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize(
    "text",
    [
        ROWS,
        ROWS.replace("3\n", "3,\n").replace("6\n", "6,\n"),
        ROWS.replace("6\n", "6,\n"),
        ROWS.replace("c\n", "c,\n"),
        ROWS.replace("\n", ",\n"),
        ROWS.replace(",", ";").replace("\n", ";\n"),
        ROWS.replace("a,b,c", "a,b,c,").replace("3\n", "3,9\n").replace("6\n", "6,9\n"),  # an unnamed column
    ],
)
def test_one_separator_may_end_a_row(tmp_path, monkeypatch, text, fast):
    choose_reader(monkeypatch, fast)
    (tmp_path / "t.csv").write_text(text)
    (block,) = read(tmp_path / "t.csv", ["c", "a"])
    assert block.numbers.tolist() == [[3, 1], [6, 4]]


@pytest.mark.parametrize("fast", [True, False])
def test_decimal_commas_with_other_separators(tmp_path, monkeypatch, fast):
    choose_reader(monkeypatch, fast)
    path = tmp_path / "t.csv"
    for text in (
        "a;who;b\n1;Li, A;0,5\n-2,25;bo;1e3\n",
        "a\twho\tb\n1\tLi, A\t0,5\n-2,25\tbo\t1000,0\n",
        'a,who,b\n1,"Li, A","0,5"\n"-2,25",bo,1000\n',
    ):
        path.write_text(text)
        (block,) = read(path, ["a", "b"], ["who"])
        assert block.numbers.tolist() == [[1, 0.5], [-2.25, 1000]] and block.texts[0, 0] == "Li, A"
    path.write_text("a;b\n1,5;2\n2.5;3\n")
    with pytest.raises(NergError, match="3.*'a'.*'2.5'"):
        read(path, ["a"])
    path.write_text("a;b\n1.5;2\n1,000;3\n")
    with pytest.raises(NergError, match="3.*'a'.*'1,000'"):
        read(path, ["a"])


def test_repeated_columns_and_two_roles(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("x,y,x\n1,2,3\n")
    assert read(path, ["y"])[0].numbers.tolist() == [[2]]
    with pytest.raises(NergError, match="'y'.*t.csv"):
        read(path, ["y"], ["y"])


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize(
    "cells, seconds",
    [
        (["2024-05-01T12:00:00", "2024-05-01T12:00:00.25"], [1714564800, 1714564800.25]),
        (["2024-05-01 14:00:00,5+02:00", "2024/05/01 12:00:01Z"], [1714564800.5, 1714564801]),
        (["12:00:00.1234567", "", "9:00:01"], [43200.1234567, np.nan, 32401]),
        (["01.05.2024 12:00:00,5", "01.05.2024, 12:00:01"], [1714564800.5, 1714564801]),
        (["20240501T120000.5Z", "20240501T140001+0200"], [1714564800.5, 1714564801]),
        (["11:59:59 AM", "12:00:00 PM", "1:00:00.5 p.m."], [43199, 43200, 46800.5]),
        (["2024-05-01 12:00:00 AM", "2024-05-01 12:00:01 am"], [1714521600, 1714521601]),
        (["1.5", "2"], [1.5 * 1e-3, 2e-3]),
        (["2024-05-01 14:00:00.5+02", "2024-05-01t12:00:01z"], [1714564800.5, 1714564801]),
        (["2024-05-01 12:00:00.5 UTC", "2024-05-01 12:00:01 GMT"], [1714564800.5, 1714564801]),
        (["0 days 00:00:01.500000", "1 days 00:00:00", "-1 days +23:59:59"], [1.5, 86400, -1]),
        (["1 day, 0:00:01", "2 days, 0:00:01.5"], [86401, 172801.5]),
    ],
)
def test_times_as_text(tmp_path, monkeypatch, cells, seconds, fast):
    choose_reader(monkeypatch, fast)
    (tmp_path / "t.csv").write_text("a\tt\n" + "".join(f"{k}\t{cell}\n" for k, cell in enumerate(cells)))
    (block,) = iterate_table(tmp_path / "t.csv", ["t", "a"], clocks={"t": 1e-3})
    assert np.allclose(block.numbers[:, 0] * 1e-3, seconds, rtol=0, atol=5e-7, equal_nan=True)
    assert block.numbers[:, 1].tolist() == list(range(len(cells)))


@pytest.mark.parametrize(
    "cells",
    [
        ["12:00:00", "5.5"],
        ["12:00:00", "2024-05-01 12:00:00"],
        ["5/1/2024 12:00:00"],
        ["2024-02-30T00:00:00"],
        ["13:00:00 PM"],
        ["01/05/2024 12:00:00"],
        ["12:00"],
        ["31.02.2024 12:00:00"],
        ["12:00:00:500"],
    ],
)
def test_mixed_notations_of_time_are_refused(tmp_path, cells):
    (tmp_path / "t.csv").write_text("a,t\n" + "".join(f"1,{cell}\n" for cell in cells))
    with pytest.raises(NergError, match="column 't'.*is (not a time|not a number)"):
        list(iterate_table(tmp_path / "t.csv", ["t", "a"], clocks={"t": 1.0}))


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize("block", [2, 100])
@pytest.mark.parametrize(
    "cells, hours",
    [
        (
            ["23:30:00", "23:59:59", "", "00:00:01", "11:00:00", "22:30:00", "23:45:00", "0:30:00"],
            [23.5, 24, 24, 35, 46.5, 47.75, 48.5],
        ),
        (["23:59:59", "00:00:01", "23:59:59.5", "00:00:02"], [24, 24, 24, 24]),  # rows that are not quite sorted
        (["23:30:00", "00:10:00", "22:30:00", "23:50:00", "00:20:00"], [23.5, 24.1667, 22.5, 23.8333, 24.3333]),
        (["10:00:00", "20:00:00", "06:00:00", "20:00:00"], [10, 20, 6, 20]),  # another recording of the same day
        (["2024-05-01T23:59:59", "2024-05-02T00:00:01"], [24 * 19845, 24 * 19845]),
    ],
    ids=["two nights", "unsorted", "two recordings over midnight", "two recordings", "dated"],
)
def test_times_of_day_continue_past_midnight(tmp_path, monkeypatch, cells, hours, block, fast):
    choose_reader(monkeypatch, fast)
    monkeypatch.setattr(ray_tables, "BLOCK_ROWS", block)
    (tmp_path / "t.csv").write_text("a,t\n" + "".join(f"1,{cell}\n" for cell in cells))
    notes = {}
    blocks = iterate_table(tmp_path / "t.csv", ["a", "t"], clocks={"t": 1e-3}, on_note=notes.update)
    t = np.concatenate([b.numbers[:, 1] for b in blocks])
    assert np.allclose(t[np.isfinite(t)] / 3.6e6, hours, rtol=0, atol=1e-3)
    assert notes == ({} if max(hours) < 23.9 or "T" in cells[0] else {"passes_midnight": True})


def test_times_of_parquet(tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    texts = ["2024-05-01T12:00:00", "2024-05-01T12:00:00.5"]
    for column in (pa.array(texts), pa.array(np.array(texts, "datetime64[ms]"))):
        pq.write_table(pa.table({"t": column}), tmp_path / "t.parquet")
        (block,) = iterate_table(tmp_path / "t.parquet", ["t"], clocks={"t": 0.5})
        assert np.allclose(block.numbers[:, 0], [2 * 1714564800, 2 * 1714564800 + 1])
        with pytest.raises(NergError, match="'t' .* does not contain numbers"):
            read(tmp_path / "t.parquet", ["t"])
    pq.write_table(pa.table({"t": ["23:59:59", None, "00:00:01"]}), tmp_path / "t.parquet")
    (block,) = iterate_table(tmp_path / "t.parquet", ["t"], clocks={"t": 0.5})
    assert np.allclose(block.numbers[:, 0], [2 * 86399, np.nan, 2 * 86401], equal_nan=True)


# ---- Tables for Excel, other encodings, and cells with line breaks or vectors ----


def read_all(path, numbers, texts=(), **options):
    blocks = list(iterate_table(path, numbers, texts, **options))
    return tuple(np.concatenate([block[k] for block in blocks]) for k in range(3))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32"])
@pytest.mark.parametrize("separator", [";", ",", "\t", "|"])
@pytest.mark.parametrize("first", ["sep={}", "SEP={}", '"sep={}"', "sep={0}{0}{0}"])
def test_line_that_names_the_separator(tmp_path, encoding, separator, first):
    text = f"{first.format(separator)}\nwho;a;b\nann;1;2\nbo;3;4\n".replace(";", separator)
    (tmp_path / "t.csv").write_bytes(text.replace("\n", "\r\n").encode(encoding))
    assert read_table_columns(tmp_path / "t.csv") == ["who", "a", "b"]
    numbers, texts, lines = read_all(tmp_path / "t.csv", ["b", "a"], ["who"])
    assert numbers.tolist() == [[2, 1], [4, 3]] and texts.tolist() == [["ann"], ["bo"]] and lines.tolist() == [3, 4]


def test_bytes_of_another_encoding_are_named(tmp_path):
    (tmp_path / "t.csv").write_bytes("a,b\n1,2\n".encode("utf-16")[:-1])
    with pytest.raises(NergError, match="UTF-16"):
        read(tmp_path / "t.csv", ["a"])


MISSING = ["1.#QNAN", "-1.#IND00", "1.#INF", "#N/A", "#NUM!", "#VALUE!", ".", "--", "-", "NULL", "None", "n/a", "NaN"]
MISSING += ["#NV", "#WERT!", "#N/D", "#VALEUR!", "#NOM?", "#¡DIV/0!", "#####", "\u2013", "\u2014"]
MISSING += ["", "#DIV/0!", "<NA>", "nan(ind)", "-nan(ind)", "N/A", "NaT", "1,#QNAN", " - "]


def test_ambiguous_times_are_named_as_such(tmp_path):
    """Day and month, or minutes and hours; other columns have no times."""
    for cell in ("05/01/2024 12:00:00", "00:01.5"):
        (tmp_path / "t.csv").write_text(f"a,t\n1,{cell}\n")
        with pytest.raises(NergError, match="hours:minutes:seconds"):
            list(iterate_table(tmp_path / "t.csv", ["t", "a"], clocks={"t": 1.0}))
        with pytest.raises(NergError, match="correct the cell"):
            list(iterate_table(tmp_path / "t.csv", ["t", "a"]))


def test_invisible_characters_around_names_of_columns(tmp_path):
    (tmp_path / "t.csv").write_text("\u00a0a,b\u200b\n1,2\n")
    np.testing.assert_array_equal(read(tmp_path / "t.csv", ["a", "b"])[0].numbers, [[1, 2]])


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize("word", MISSING)
def test_words_for_missing_values(tmp_path, monkeypatch, fast, word):
    choose_reader(monkeypatch, fast)
    (tmp_path / "t.csv").write_text(f"a;b;t\n{word};0,5;12:00:00\n1,5;{word};{word}\n")
    numbers, _, _ = read_all(tmp_path / "t.csv", ["a", "b", "t"], clocks={"t": 1.0})
    np.testing.assert_array_equal(numbers, [[np.nan, 0.5, 43200], [1.5, np.nan, np.nan]])


@pytest.mark.parametrize("fast", [True, False])
def test_line_breaks_in_quoted_cells(tmp_path, monkeypatch, fast):
    choose_reader(monkeypatch, fast)
    monkeypatch.setattr(ray_tables, "BLOCK_ROWS", 3)
    rows = ['1,"a\nb",2', '3,"c",4', '5,"d\n\n""e"",\nf",6', "7,g,8", '9,"h\r\ni",10', '11,5" h,12']
    (tmp_path / "t.csv").write_text("\n".join(['x,"te\nxt",y', *rows, ""]), newline="")
    assert read_table_columns(tmp_path / "t.csv") == ["x", "te xt", "y"]
    numbers, texts, lines = read_all(tmp_path / "t.csv", ["x", "y"], ["te xt"])
    np.testing.assert_array_equal(numbers, np.arange(1.0, 13).reshape(6, 2))
    assert [text.split() for text in texts[:, 0].tolist()] == [
        *(["a", "b"], ["c"], ["d", '"e",', "f"], ["g"], ["h", "i"], ['5"', "h"])
    ]
    assert lines.tolist() == [3, 5, 6, 10, 11, 13]


def test_a_stray_quotation_mark_joins_no_lines(tmp_path):
    rows = [f"{k},{k}\n" for k in range(300)]
    rows[7], rows[150] = '"7,7\n', '"150,150\n'
    (tmp_path / "t.csv").write_text("a,b\n" + "".join(rows))
    bad_lines = []
    numbers, _, _ = read_all(tmp_path / "t.csv", ["a"], on_bad_line=lambda line, why: bad_lines.append(line))
    assert bad_lines == [9, 152] and len(numbers) == 298


VECTORS = [
    ("({}, {}, {})", ","),
    ("({}, {}, {})", ";"),
    ("[{} {} {}]", ","),
    ("[{}, {}, {}]", "\t"),
    ("{};{};{}", ","),
    ("{} {} {}", ";"),
    ("X={} Y={} Z={}", ","),
    ("Vector3({},{},{})", ","),
    ('{{"x": {}, "y": {}, "z": {}}}', ","),
    ("<{}|{}|{}>", ","),
]


@pytest.mark.parametrize("is_quoted", [True, False])
@pytest.mark.parametrize(("form", "separator"), VECTORS)
def test_vectors_in_cells(tmp_path, form, separator, is_quoted):
    values = np.random.default_rng(0).normal(size=(30, 2, 3)).round(4)
    spell = lambda v: form.format(*(repr(float(x)) for x in v))
    rows = [[str(k), spell(a), spell(b), "x"] for k, (a, b) in enumerate(values)]
    rows[4][1], rows[5][2] = "", "NaN"
    values[4, 0] = values[5, 1] = np.nan
    with open(tmp_path / "t.csv", "w", newline="") as file:
        if is_quoted:
            csv.writer(file, delimiter=separator).writerows([["t", "Gaze Origin", "dir", "s"], *rows])
        else:
            file.write("\n".join(separator.join(row) for row in [["t", "Gaze Origin", "dir", "s"], *rows]) + "\n")
    names = ["Gaze Origin.x", "Gaze Origin.y", "Gaze Origin.z", "dir.x", "dir.y", "dir.z"]
    assert find_vector_columns(tmp_path / "t.csv") == names
    numbers, texts, _ = read_all(tmp_path / "t.csv", ["t", *names[::-1]], ["s"])
    np.testing.assert_array_equal(numbers[:, 0], np.arange(30))
    np.testing.assert_allclose(numbers[:, :0:-1], values.reshape(30, 6))
    assert set(texts[:, 0].tolist()) == {"x"}


@pytest.mark.parametrize("cells", ["(0,100, 0,200, -0,300)", "0,1;0,2;-0,3", "(0,1; 0,2; -0,3)", "0,1 0,2 -0,3"])
def test_vectors_with_decimal_commas(cells):
    np.testing.assert_allclose(parse_vector(cells), [0.1, 0.2, -0.3])


@pytest.mark.parametrize("cell", ["1,5", "0.5", "12:00:00", "Shelf (1)", "(1)", "a b c", "(1, 2, 3, 4, 5)", "", "x"])
def test_other_cells_are_no_vectors(cell):
    assert parse_vector(cell) is None


@pytest.mark.parametrize("cell", ["1_5", "(1_5, 2, 3)", "(1, 2_0, 3)"])
def test_digits_joined_by_underscores_are_no_number(tmp_path, cell):
    """They name a trial, such as the fifth one of participant 1; Python takes them for 15."""
    names, good = (["p.x", "p.y", "p.z"], "(4, 5, 6)") if "(" in cell else (["p"], "4")
    (tmp_path / "t.csv").write_text(f'p,s\n"{good}",x\n"{cell}",x\n')
    with pytest.raises(NergError, match="line 3, column 'p'"):
        read(tmp_path / "t.csv", names)


def test_cells_with_other_vectors_are_refused_by_line(tmp_path):
    rows = ['"(1, 2, 3)"', '"(1, 2, 3, 4)"', "7", '"(5, 6, 7)"']
    (tmp_path / "t.csv").write_text("p,s\n" + "".join(f"{row},x\n" for row in rows))
    names = ["p.x", "p.y", "p.z"]
    with pytest.raises(NergError, match=r"t\.csv, line 3, column 'p'.*\(1, 2, 3, 4\).*3 numbers"):
        read(tmp_path / "t.csv", names)
    bad_lines = []
    numbers, texts, lines = read_all(
        tmp_path / "t.csv", names, ["s"], on_bad_line=lambda line, why: bad_lines.append(line)
    )
    assert numbers.tolist() == [[1, 2, 3], [5, 6, 7]] and lines.tolist() == [2, 5] and bad_lines == [3, 4]
    assert texts.tolist() == [["x"], ["x"]]
    with pytest.raises(NergError, match=r"q\.x"):
        read(tmp_path / "t.csv", ["q.x"])


def test_vectors_in_cells_of_parquet(tmp_path):
    pa = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    lists = [[1.0, 2.0, 3.0], None, [4.0, 5.0, 6.0]]
    columns = {"p": lists, "d": ["(1, 2, 3)", "(4, 5, 6)", ""], "who": ["a", "b", "c"], "n": [1, 2, 3]}
    parquet.write_table(pa.table(columns), tmp_path / "t.parquet")
    names = find_vector_columns(tmp_path / "t.parquet")
    assert names == ["p.x", "p.y", "p.z", "d.x", "d.y", "d.z"]
    numbers, texts, _ = read_all(tmp_path / "t.parquet", [*names, "n"], ["who"])
    nan = np.nan
    np.testing.assert_array_equal(
        numbers, [[1, 2, 3, 1, 2, 3, 1], [nan, nan, nan, 4, 5, 6, 2], [4, 5, 6, nan, nan, nan, 3]]
    )
    assert texts[:, 0].tolist() == ["a", "b", "c"]


@pytest.mark.parametrize(
    "text, remedy",
    [
        ("", "it is empty; export"),
        ("\n\n", "it is empty; export"),
        ("<!DOCTYPE html>\n<title>404, not found</title>\n", "HTML"),
        ("version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
        ('[{"x": 1, "y": 2}]\n', "JSON; convert"),
        ("PK\x03\x04\x14\x00", "export it as CSV"),
        ("# recorded by a program\nx,y\n1,2\n", "remove the lines above"),
        ("t x y z\n0 1 2 3\n", '"t x y z", has neither commas'),
        ("t|x|y|z\n0|1|2|3\n", "between its columns"),
        ('Recorder;2.1\nDate;1.5.2024\n\n"t";speed\n0;1\n', "line 4 has these columns; remove the lines above it"),
        ("t,x\n0,1\n", "columns are t, x; choose some of them with columns"),
    ],
)
def test_files_without_a_header_are_named_with_a_remedy(tmp_path, text, remedy):
    (tmp_path / "t.csv").write_bytes(text.encode())
    with pytest.raises(NergError, match=re.escape(remedy)):
        list(iterate_table(tmp_path / "t.csv", ["speed"]))


@pytest.mark.parametrize("top", ["\n", "\r\n \r\n", "\nsep=;\n"])
def test_empty_lines_may_precede_the_header(tmp_path, top):
    (tmp_path / "t.csv").write_bytes(f"{top}x;y\n1;2\n3;4\n".encode())
    (block,) = iterate_table(tmp_path / "t.csv", ["y"])
    assert block.numbers[:, 0].tolist() == [2, 4] and block.lines.tolist() == [
        len(top.splitlines()) + k for k in (2, 3)
    ]


def test_columns_are_compared_in_the_compatible_form(tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    text, table = tmp_path / "a.csv", tmp_path / "a.parquet"
    text.write_text("t [\u03bcs],name,Gaze \uff11\n5,Ada,2\n")
    pq.write_table(pa.table({"t [\u03bcs]": [5], "name": ["Ada"], "Gaze \uff11": [2]}), table)
    for path in (text, table):
        (block,) = iterate_table(path, ["Gaze 1", "t [\u00b5s]"], ["name"], clocks={"t [\u00b5s]": 1e-6})
        assert block.numbers.tolist() == [[2, 5]] and block.texts.tolist() == [["Ada"]]
        with pytest.raises(NergError, match="no column"):
            next(iterate_table(path, ["t [ms]"]))


def test_durations_and_ids_of_parquet(tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "a.parquet"
    durations = pa.array(np.array([0, 16_000], "timedelta64[us]"))
    pq.write_table(pa.table({"t": durations, "x": [1.0, 2.0], "id": pa.array([1.0, None]), "d": durations}), path)
    (block,) = iterate_table(path, ["t", "x"], ["id"], clocks={"t": 1e-3})
    np.testing.assert_allclose(block.numbers, [[0, 1], [16, 2]])
    assert block.texts.tolist() == [["1"], [""]]
    with pytest.raises(NergError, match="'d'"):
        next(iterate_table(path, ["d"]))
