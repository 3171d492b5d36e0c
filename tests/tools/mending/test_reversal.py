"""Reversals: what they replace stands exactly once, and tests are named without their cases."""

from __future__ import annotations

import pytest

from tools.mending.reversal import held, undo

FILES = {"a.py": "x = 1\ny = 2\ny = 2\n", "b.py": "z = 3\n"}


def test_texts_are_replaced_in_turn_and_in_several_files():
    reversal = undo("it", ["t.py::a"], ("a.py", "x = 1", "x = 5"), ("a.py", "x = 5\ny", "w"), ("b.py", "3", "4"))
    assert reversal.sources(FILES.__getitem__) == {"a.py": "w = 2\ny = 2\n", "b.py": "z = 4\n"}


@pytest.mark.parametrize("text, count", [("y = 2", 2), ("nowhere", 0)])
def test_a_text_that_does_not_stand_there_once_is_refused(text, count):
    with pytest.raises(ValueError, match=f'a.py holds {count} times what "it" replaces'):
        undo("it", [], ("a.py", text, "")).sources(FILES.__getitem__)


def test_tests_are_named_once_and_without_their_cases():
    one, two = undo("1", ["t.py::a[x]", "t.py::b"]), undo("2", ["t.py::a[y-z]"])
    assert held("what", one, two).tests == ["t.py::a", "t.py::b"]
