"""What a check of rays is.

To add one, write a module of this folder with a `Check` named ``CHECK``, and add the module to the list in
:mod:`nerg_mi.rays.checks.registry`. The sanity card shows what it finds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from .figures import Figures


@dataclass(frozen=True)
class Check:
    """A look at rays for one kind of mistake."""

    name: str
    """A word, that of its file."""

    looks_for: str
    """What gives the mistake away, in a phrase of Markdown."""

    find: Callable[[Figures], list[str]]
    """Sentences about what people cannot have produced, each with the likely mistake and its remedy; none where nothing
    is wrong, or where the rays do not tell. Of millions of rays it takes a fraction of a second."""
