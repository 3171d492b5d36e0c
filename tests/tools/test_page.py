"""Tables of a page are exchanged, and nothing else of it."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

_SPEC = importlib.util.spec_from_file_location("page", Path(__file__).resolve().parents[2] / "tools" / "page.py")
page = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(page)

DOCUMENT = "# T\n\n## A\n\nwords\n\n| a |\n| --- |\n| 1 |\n\nmore\n\n## B\n\nwords of B\n"


def test_a_table_is_replaced_and_the_rest_stays():
    new = page.replace_table(DOCUMENT, "A", page.table(["x", "y"], [[1, "p|q"]]))
    assert new == DOCUMENT.replace("| a |\n| --- |\n| 1 |", "| x | y |\n| --- | --- |\n| 1 | p\\|q |")


def test_a_table_is_added_where_there_is_none():
    new = page.replace_table(DOCUMENT, "B", "| z |\n| --- |")
    assert new == DOCUMENT + "\n| z |\n| --- |\n"
    assert page.replace_table(new, "B", "| z |\n| --- |") == new
    first = "## A\n\nw\n\n## B\n"
    assert page.replace_table(first, "A", "| z |") == "## A\n\nw\n\n| z |\n\n## B\n"


def test_a_heading_that_is_missing_is_named():
    with pytest.raises(ValueError, match='"## C"'):
        page.replace_table(DOCUMENT, "C", "| z |")


def test_headings_of_the_third_level_are_found_too():
    parts = "## A\n\n### B\n\n| b |\n\n### C\n\nwords\n\n## D\n"
    assert page.replace_table(parts, "B", "| z |") == parts.replace("| b |", "| z |")
    assert page.replace_table(parts, "C", "| z |") == parts.replace("words\n", "words\n\n| z |\n")
