"""What a check of rays is.

To add one, write ``@check("what it looks for") def check_NAME(figures)`` in a module of this folder, and add it to the
list of checks of recordings (:mod:`nerg_mi.rays.checks.recording_checks`) or of directions
(:mod:`nerg_mi.rays.checks.direction_checks`). The sanity card shows what it finds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from .figures import Figures


@dataclass(frozen=True)
class Check:
    """A look at rays for one kind of mistake."""

    name: str
    """A word, that of its function."""

    looks_for: str
    """What gives the mistake away, in a phrase of Markdown."""

    find: Callable[[Figures], list[str]]
    """Sentences about what people cannot have produced, each with the likely mistake and its remedy; none where nothing
    is wrong, or where the rays do not tell. Of millions of rays it takes a fraction of a second."""


def check(looks_for: str) -> Callable[[Callable[[Figures], list[str]]], Check]:
    """Make a check, which is called NAME, of a function ``check_NAME(figures)``."""
    return lambda find: Check(find.__name__.removeprefix("check_"), looks_for, find)
