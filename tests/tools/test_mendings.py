"""The list of mendings fits the sources, the tests and the page; a reversal that no test notices is told."""

from __future__ import annotations

import re

import pytest

from tests.conftest import ROOT
from tools import mendings
from tools.mending import MENDINGS
from tools.mending.reversal import held, undo

REVERSALS = [r for m in MENDINGS for r in m.reversals]


def rows_of_the_page() -> list[list[str]]:
    """The cells of each row of the table under the heading of the mendings."""
    text = (ROOT / "docs" / "trust.md").read_text(encoding="utf-8")
    part = text.split(f"## {mendings.HEADING}\n")[1].split("\n## ")[0]
    return [line.strip("| ").split(" | ") for line in part.splitlines() if line.startswith("| ")][2:]


@pytest.mark.parametrize("reversal", REVERSALS, ids=lambda r: r.undone)
def test_what_is_replaced_stands_once_in_the_sources(reversal):
    for file, text in reversal.sources(lambda file: (ROOT / file).read_text(encoding="utf-8")).items():
        assert file.split("/")[0] in ("nerg_mi", "plugins", "scenes", "benchmarks", "docs", "README.md")
        if file.endswith(".py"):
            compile(text, file, "exec")


def test_tests_that_are_named_exist():
    for name in {t.partition("[")[0] for r in REVERSALS for t in r.tests}:
        file, _, function = name.partition("::")
        assert re.search(rf"^def {function}\(", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE), name


def test_every_reversal_is_one_of_its_own_and_has_tests():
    assert len({m.held for m in MENDINGS}) == len(MENDINGS) and all(r.tests and r.changes for r in REVERSALS)
    assert len({r.changes for r in REVERSALS}) == len(REVERSALS)


def test_the_page_has_the_rows_of_the_list():
    """Its last column is what a run came to: every test passes with its mending and fails without."""
    rows = rows_of_the_page()
    assert [r[0] for r in rows] == [m.held for m in MENDINGS]
    for cells, mending in zip(rows, MENDINGS):
        count = sum(len(r.tests) for r in mending.reversals)
        trials = [mendings.Trial("", True, True)] * count
        assert cells == mendings.row(mending, trials)


class Told:
    """In the place of a bench: a file of one line, and tests that end as they are told to where it was changed."""

    def __init__(self, tmp_path, **outcomes):
        self.log, self.text, self.outcomes, self.stopped = tmp_path / "log", "x = 1\n", outcomes, 0

    def source(self, file):
        return self.text

    def write(self, file, text):
        self.text = text

    def stop(self):
        self.stopped += 1

    def run(self, tests, limit):
        (name,) = tests
        plain, undone, by = self.outcomes[name.split("::")[1]]
        # pytest has nothing against tests that are skipped.
        plain, ran = ("passed", 0) if plain == "skipped" else (plain, 1)
        return {"outcome": plain if self.text == "x = 1\n" else undone, "by": by, "ran": ran, "seconds": 0.1}


def tried(tmp_path, file="nerg_mi/maths/a.py", **outcomes):
    """The rows and the complaints about a mending whose tests end so, without its reversal and with it."""
    bench = Told(tmp_path, **outcomes)
    mending = held("things", undo("it is gone", [f"t.py::{name}" for name in outcomes], (file, "1", "2")))
    found = mendings.run([mending], bench)
    assert bench.text == "x = 1\n"
    return *found, bench


@pytest.mark.parametrize("outcome", ["failed", "hang", "crash"])
def test_a_reversal_that_is_noticed_is_proof(tmp_path, outcome):
    rows, wrong, _ = tried(tmp_path, a=("passed", outcome, "t.py::a"))
    assert rows == [["things", "it is gone", "`t.py::a`", "1 pass / 1 fail"]] and not wrong


@pytest.mark.parametrize("outcome", [("passed", None), ("failed", "t.py"), ("none", None), ("error", None)])
def test_a_reversal_that_no_test_notices_is_told(tmp_path, outcome):
    """A test that cannot be collected has not failed."""
    rows, wrong, _ = tried(tmp_path, a=("passed", "failed", "t.py::a"), b=("passed", *outcome))
    assert rows[0][-1] == "2 pass / 1 of 2 fail"
    assert wrong == ['t.py::b does not notice "it is gone"; make it look for that.']


@pytest.mark.parametrize("plain", ["failed", "skipped"])
def test_a_test_that_does_not_pass_as_things_are_is_no_proof(tmp_path, plain):
    rows, wrong, _ = tried(tmp_path, a=(plain, "failed", "t.py::a"))
    assert rows[0][-1] == "0 of 1 pass / 1 fail"
    assert wrong == ["t.py::a does not pass as things are, or is skipped; give it what it asks for first."]


def test_what_is_imported_with_the_package_is_imported_again(tmp_path):
    """The worker has it already: with the change, and once more without it."""
    assert tried(tmp_path, a=("passed", "failed", "t.py::a"))[2].stopped == 0
    assert tried(tmp_path, "nerg_mi/llvm.py", a=("passed", "failed", "t.py::a"))[2].stopped == 2


def test_a_part_of_the_rows_is_not_put_on_the_page(capsys):
    for arguments, said in ((["--only", "core", "--update", "p.md"], "leave out one"), (["--only", "xyzzy"], "no row")):
        with pytest.raises(SystemExit) as end:
            mendings.main(arguments)
        assert end.value.code == 2 and said in capsys.readouterr().err


def test_the_reason_of_a_failure_is_shown(tmp_path):
    log = tmp_path / "log"
    assert mendings.why(log) == ""
    log.write_text("....F\nE       assert 1 == 2\nE        +  where 1 = f()\nFAILED t.py::a - assert...\n")
    assert mendings.why(log) == "assert 1 == 2"
