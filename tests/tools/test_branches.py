"""The table of the coverage: sums by part, and what is reached least."""

from tools import branches


def entry(statements, lines, total, reached, missing):
    summary = {
        "num_statements": statements,
        "covered_lines": lines,
        "num_branches": total,
        "covered_branches": reached,
        "percent_covered": 100 * (lines + reached) / (statements + total),
    }
    return {"summary": summary, "missing_lines": missing}


REPORT = {
    "files": {
        "nerg_mi/field/a.py": entry(10, 10, 4, 2, []),
        "nerg_mi/field/b.py": entry(30, 20, 0, 0, [3, 4]),
        "plugins/nerg.py": entry(50, 50, 6, 6, []),
        "nerg_mi/llvm.py": entry(4, 4, 0, 0, []),
    }
}


def test_sums_of_each_part():
    rows = {row[0]: row[1:] for row in branches.summarise(REPORT)}
    assert list(rows) == ["nerg_mi", "nerg_mi/field", "plugins", "all"]
    assert rows["nerg_mi/field"] == ["40", "75.0 %", "4", "50.0 %", "72.7 %"]
    assert rows["nerg_mi"] == ["4", "100.0 %", "0", "-", "100.0 %"]
    assert rows["all"] == ["94", "89.4 %", "10", "80.0 %", "88.5 %"]


def test_what_is_reached_least_comes_with_its_lines():
    assert branches.least(REPORT) == ["nerg_mi/field/b.py: 66.7 %, lines 3, 4"]
