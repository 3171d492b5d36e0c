"""Which tests reach a line, also when lines have moved since that was recorded."""

from __future__ import annotations

import json

import pytest

from tools.mutation import reach, sites

SOURCE = """\
import math


def f(x):
    if x > 1:
        return x + 2
    return x


def g(x):
    return x - 1
"""


class Copy:
    """A copy of a repository in which nothing has to be run: what each test executes is given."""

    def __init__(self, tree, executed):
        self.tree, self.executed, self.log, self.recorded = tree, executed, tree / "log", []

    def source(self, file):
        return (self.tree / file).read_text()

    def run(self, tests, limit, record):
        (file,) = tests
        self.recorded.append(file)
        lines = {c: found for c, found in self.executed.items() if c.split("::")[0] == file}
        entries = {c: {"seconds": 1.0, "outcome": "passed"} for c in lines if "::" in c}
        record.write_text(json.dumps({"tests": entries, "lines": {"nerg_mi/a.py": lines}}))
        return {"outcome": "passed", "seconds": 1.0}


@pytest.fixture
def copy(tmp_path, monkeypatch):
    monkeypatch.setattr(reach, "BUILD", tmp_path)
    monkeypatch.setattr(reach, "_FOLDER", tmp_path / "reach")
    for file, text in (("nerg_mi/a.py", SOURCE), ("tests/test_a.py", "A"), ("tests/test_b.py", "B")):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text(text)
    executed = {
        "tests/test_a.py::test_if": [5, 6],
        "tests/test_a.py::test_else": [5, 7],
        "tests/test_b.py": [11],
        "tests/test_b.py::test_g": [11],
    }
    return Copy(tmp_path, executed)


def mutants(copy, before):
    return [m for m in sites.find("nerg_mi/a.py", copy.source("nerg_mi/a.py")) if m.before == before]


def test_the_tests_of_a_line(copy):
    found = reach.Reach(copy)
    assert set(found.of(mutants(copy, "x > 1")[0])) == {"tests/test_a.py::test_if", "tests/test_a.py::test_else"}
    assert found.of(mutants(copy, "x + 2")[0]) == ["tests/test_a.py::test_if"]
    # What a fixture of the whole file executes serves all of its tests.
    assert found.of(mutants(copy, "x - 1")[0]) == ["tests/test_b.py::test_g"]


def test_lines_that_moved_need_no_new_record(copy):
    reach.Reach(copy)
    (copy.tree / "nerg_mi/a.py").write_text("LIMIT = 5\n" + SOURCE)
    found = reach.Reach(copy)
    assert copy.recorded == ["tests/test_a.py", "tests/test_b.py"]
    assert found.of(mutants(copy, "x + 2")[0]) == ["tests/test_a.py::test_if"]


def test_a_changed_file_of_tests_is_recorded_again(copy):
    reach.Reach(copy)
    (copy.tree / "tests/test_b.py").write_text("other")
    reach.Reach(copy)
    assert copy.recorded == ["tests/test_a.py", "tests/test_b.py", "tests/test_b.py"]
