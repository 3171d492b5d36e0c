"""The first rows of a table."""

import numpy as np
import pytest

from nerg_mi.rays.guess import TableSample

NAMES = ["a", "word", "b", "empty", "late"]
ROWS = [["1", "x", "", "", "7"], ["2.5", "y", "-3e2", "nan", "7"], ["3", "z", "1", "", "7"]]


def test_columns_of_numbers(tmp_path):
    path = tmp_path / "t.csv"
    rows = ROWS + [["1", "x", "1", "", "7"]] * 60 + [["1", "x", "1", "", "word"], ["1"]]
    path.write_text(";".join(NAMES) + "\n" + "\n".join(";".join(r) for r in rows) + "\n")
    sample = TableSample(path, NAMES)
    # What comes late is left out by line, as is a line that is cut off.
    assert list(sample.numbers) == ["a", "b", "late"] and sample.rows == 63
    assert np.array_equal(
        sample.vector(["b", "word"])[:3], [[np.nan, np.nan], [-300, np.nan], [1, np.nan]], equal_nan=True
    )


def test_parquet(tmp_path):
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    path = tmp_path / "t.parquet"
    pq.write_table(pa.table({"a": [1.0, 2.0], "word": ["x", "y"], "k": [3, 4]}), path)
    sample = TableSample(path, ["a", "word", "k"])
    assert list(sample.numbers) == ["a", "k"] and sample.rows == 2


@pytest.mark.parametrize("text", ["", "a,b\n", "a,b\nx,y\n"])
def test_no_numbers(tmp_path, text):
    path = tmp_path / "t.csv"
    path.write_text(text)
    sample = TableSample(path, ["a", "b"] if text else [])
    assert sample.rows == 0 and sample.vector(["a", "b", "c"]).shape == (0, 3)
