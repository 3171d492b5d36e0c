"""Notebooks run from top to bottom, by the library alone, and what they show is what is stored."""

from __future__ import annotations

import json
import re

import pytest

from tests.conftest import ROOT
from tools import notebooks

BOOKS = notebooks.notebooks()
MOST = 300_000
"""Bytes of a notebook with its pictures."""


def stored(path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


def test_there_are_three():
    assert [path.stem for path in BOOKS] == ["find_observer", "quickstart", "shares_of_attention"]


@pytest.mark.parametrize("path", BOOKS, ids=lambda p: p.stem)
def test_what_is_stored_is_whole_and_small(path):
    book = stored(path)
    assert path.stat().st_size < MOST and book == notebooks.clean(json.loads(json.dumps(book)))
    outputs = [output for cell in book["cells"] for output in cell.get("outputs", ())]
    assert not [output for output in outputs if output["output_type"] == "error" or output.get("name") == "stderr"]
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 1
    # Nothing of the machine that ran it.
    assert not re.search(r"/(?:home|root|tmp|work|Users)/", json.dumps(outputs))


@pytest.mark.parametrize("path", BOOKS, ids=lambda p: p.stem)
def test_the_library_is_used_and_not_the_command_line(path):
    code = "\n".join("".join(cell["source"]) for cell in stored(path)["cells"] if cell["cell_type"] == "code")
    assert "import nerg_mi as nerg" in code
    assert not re.search(r"^\s*[!%]|subprocess|os\.system|nerg_mi\.cli", code, re.M)


@pytest.mark.slow
@pytest.mark.parametrize("path", BOOKS, ids=lambda p: p.stem)
def test_it_runs_and_gives_what_is_stored(path, tmp_path):
    pytest.importorskip("nbclient", reason="nbclient, of the extra test, is not installed")
    pytest.importorskip("ipykernel", reason="ipykernel, of the extra test, is not installed")
    again = notebooks.run(path, tmp_path)
    assert notebooks.structure(again) == notebooks.structure(stored(path)), "run python -m tools.notebooks"


def test_a_cell_that_fails_is_an_error(tmp_path):
    pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    book = {"cells": [], "metadata": {}, "nbformat": 4, "nbformat_minor": 5}
    cell = {"cell_type": "code", "id": "a", "execution_count": None, "metadata": {}, "outputs": [], "source": "1 / 0"}
    (tmp_path / "a.ipynb").write_text(json.dumps({**book, "cells": [cell]}))
    with pytest.raises(Exception, match="ZeroDivisionError"):
        notebooks.run(tmp_path / "a.ipynb", tmp_path)


def test_the_examples_stand_in_the_index():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    assert [path.name for path in BOOKS if f"../examples/{path.name})" not in index] == []
