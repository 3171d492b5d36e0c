"""Errors in one sentence, and which of them a user can mend."""

from __future__ import annotations

import pytest

from nerg_mi import errors
from nerg_mi.errors import NergError

TRACE = """While loading "a.xml" (line 3): could not instantiate plugin of type "nerg":
Traceback (most recent call last):
  File "nerg.py", line 7, in __init__
    raise {error}
{error}: "step" must lie in 0 .. 1, got 2
"""


def caught(code) -> BaseException:
    try:
        code()
    except BaseException as error:
        return error
    raise AssertionError("nothing was raised")


@pytest.mark.parametrize(
    "error, mendable",
    [
        (NergError("a"), True),
        (errors.MissingFile("a"), True),
        (caught(lambda: open("/nowhere/at/all")), True),
        (caught(lambda: __import__("a_module_that_is_not_there")), True),
        (caught(lambda: __import__("nerg_mi.not_there")), False),
        (MemoryError(), True),
        (OSError("a function's own"), False),
        (ValueError("wrong"), False),
        (TypeError("wrong"), False),
        (KeyboardInterrupt(), False),
    ],
)
def test_what_can_be_mended(error, mendable):
    assert errors.expected(error) is mendable


def test_values_that_were_chosen_are_the_users_to_mend():
    with pytest.raises(NergError, match=r"^a box needs a size; give other values by --aabb$"):
        with errors.chosen("--aabb"):
            raise ValueError("a box needs a size.")
    with pytest.raises(NergError, match="^as it is$"):
        with errors.chosen("--aabb"):
            raise NergError("as it is")
    with pytest.raises(TypeError):
        with errors.chosen("--aabb"):
            raise TypeError


def test_what_mitsuba_wraps_is_said_with_its_place():
    with pytest.raises(NergError) as said:
        with errors.mitsuba_says():
            raise RuntimeError(TRACE.format(error="nerg_mi.errors.NergError"))
    words = str(said.value)
    assert words.startswith('While loading "a.xml" (line 3)') and words.endswith('"step" must lie in 0 .. 1, got 2')
    assert "Traceback" not in words and "\n" not in words and "NergError" not in words


def test_what_mitsuba_quotes_may_be_no_text():
    with pytest.raises(NergError, match="is damaged"), errors.mitsuba_says():
        b"\xfe".decode()


def test_a_mistake_in_a_plugin_is_none_of_the_scene():
    with pytest.raises(RuntimeError) as said:
        with errors.mitsuba_says():
            raise RuntimeError(TRACE.format(error="TypeError"))
    assert not isinstance(said.value, NergError)


@pytest.mark.parametrize(
    "error, words",
    [
        (caught(lambda: open("/nowhere/a.txt")), 'there is no file "/nowhere/a.txt"'),
        (PermissionError(13, "Permission denied", "a.txt"), '"a.txt": permission denied'),
        (OSError(28, "No space left on device"), "no space left on device"),
        (MemoryError(), "there is not enough memory; ask for less, or close other programs"),
        (RuntimeError("[film.cpp:12] two\nlines"), "two lines"),
        (KeyError(), "KeyError"),
    ],
)
def test_one_line(error, words):
    assert errors.sentence(error) == words


def test_text_of_a_file_is_cut_and_made_printable():
    assert errors.plain("a\x1b[2Jb\n") == "a?[2Jb?"
    assert errors.plain("x" * 400, 10) == "x" * 10 + "..." and errors.plain("x" * 10, 10) == "x" * 10
