import numpy as np
import pytest

from nerg_mi.formats import ray_tables
from nerg_mi.formats.ray_tables import ColumnMap, iterate_table


def test_column_map_round_trip():
    text = "origin=x,y,z direction=dx,dy,dz hit=hx,hy,hz t=time person=id confidence=c"
    columns = ColumnMap.parse(text)
    assert columns.origin == ("x", "y", "z") and columns.t == "time" and str(columns) == text
    assert ColumnMap.parse("direction=a,b,c origin=d,e,f").hit is None


@pytest.mark.parametrize(
    "text, message",
    [
        ("origin=x,y,z", "direction is missing"),
        ("origin=x,y direction=a,b,c", "origin needs 3"),
        ("origin=x,y,z direction=a,b,c speed=v", "'speed' is unknown"),
        ("origin=x,y,z origin=x,y,z direction=a,b,c", "given twice"),
    ],
)
def test_column_map_refuses(text, message):
    with pytest.raises(ValueError, match=message):
        ColumnMap.parse(text)


def read(path, numbers, texts=()):
    return list(iterate_table(path, numbers, texts))


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_columns_gaps_and_lines(tmp_path, separator):
    path = tmp_path / "t.csv"
    rows = ["name,b,a,c", '"Ann, B",1,2,3', "", "bo,,,", "cy,7,NaN,null"]
    path.write_text("\n".join(r if '"' in r and separator == "," else r.replace('"Ann, B"', "Ann").replace(",", separator) for r in rows))
    (block,) = read(path, ["a", "b", "c"], ["name"])
    assert np.array_equal(block.numbers, [[2, 1, 3], [np.nan] * 3, [np.nan, 7, np.nan]], equal_nan=True)
    assert list(block.texts[:, 0]) == ["Ann, B" if separator == "," else "Ann", "bo", "cy"]
    assert list(block.lines) == [2, 4, 5]


def test_blocks_keep_line_numbers(tmp_path, monkeypatch):
    monkeypatch.setattr(ray_tables, "BLOCK", 4)
    path = tmp_path / "t.csv"
    path.write_text("a,b\n" + "".join(f"{i},{-i}\n" for i in range(10)))
    blocks = read(path, ["a"])
    assert [len(b.lines) for b in blocks] == [4, 4, 2] and blocks[-1].lines[-1] == 11
    assert np.array_equal(np.concatenate([b.numbers for b in blocks])[:, 0], np.arange(10))


def test_errors_name_line_and_column(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("a,b\n1,2\n3,four\n")
    with pytest.raises(ValueError, match="line 3, column 'b': 'four'"):
        read(path, ["a", "b"])
    path.write_text("a,b\n1,2\n3\n")
    with pytest.raises(ValueError, match="line 3: 1 cells"):
        read(path, ["a", "b"])
    with pytest.raises(ValueError, match="no column q; its columns are a, b"):
        read(path, ["a", "q"])


def test_parquet(tmp_path):
    pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed (pip install pyarrow)")
    import pyarrow.parquet as pq

    path = tmp_path / "t.parquet"
    pq.write_table(pa.table({"a": [1.0, None, 3.0], "who": ["x", "y", "z"], "n": [1, 2, 3]}), path)
    (block,) = read(path, ["n", "a"], ["who"])
    assert np.array_equal(block.numbers, [[1, 1], [2, np.nan], [3, 3]], equal_nan=True)
    assert list(block.texts[:, 0]) == ["x", "y", "z"]
