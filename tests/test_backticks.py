"""The check of names in sentences finds those that do not exist, and no others; names of slow tests exist."""

from __future__ import annotations

import re

import pytest

from tests.conftest import ROOT, listed_as_slow
from tools import backticks


@pytest.fixture
def names(tmp_path, monkeypatch):
    (tmp_path / "module.py").write_text(
        "class Parent:\n    width: int\n\nclass Child(Parent):\n    def read(self, path):\n"
        "        local = {'file_name': 1}\n        return 'a sentence with words'\n\nVALUE = 'key'\n"
    )
    (tmp_path / "Makefile").write_text("target:\n")
    monkeypatch.setattr(backticks, "ROOT", tmp_path)
    return backticks.Names(["module.py", "Makefile"])


@pytest.mark.parametrize(
    "sentence",
    [
        "`Child.read`, ``path``, ``VALUE``, ``key``, `file_name`, module.py, `target`",
        "`Child.width`, `np.mean`, `mi.render`, `OSError`",
        "``NAME``, ``gaze_KIND``, ``p_od``, ``origin_x``, ``(a phrase, of words)``, `--file-name`, `\\\\missing{x}`",
    ],
)
def test01_existing_names(names, sentence):
    assert not list(names.find_missing(sentence, {"np", "mi"}))


@pytest.mark.parametrize(
    ("sentence", "missing"),
    [
        ("`remove_all`", "remove_all"),
        ("as ``remove_all`` does", "remove_all"),
        ("as remove_all does", "remove_all"),
        ("`Child.height`", "Child.height"),
        ("`module.remove_all`", "remove_all"),
        ("``local``", "local"),
        ("`sentence`", "sentence"),
        ("`--no-old-file`", "old_file"),
        ("module_old.py", "module_old.py"),
    ],
)
def test02_missing_names(names, sentence, missing):
    assert [name for _, name in names.find_missing(sentence, set())] == [missing]


def test03_sentences_are_docstrings_and_comments():
    file = backticks.PythonFile('"""One."""\nx = "two"  # three\n# four\n# five\ny = 1\n"""Six."""\n')
    assert sorted(file.sentences) == [(1, "One."), (2, "three"), (3, "four\nfive"), (6, "Six.")]


def test_slow_tests_exist():
    for entry in listed_as_slow():
        file, _, name = entry.partition("::")
        assert re.search(rf"^def {name}\(" if name else "", (ROOT / file).read_text(), re.M), entry
