"""What a section of a report is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from nerg_mi.report.html import Html
from nerg_mi.report.run import Run


@dataclass(frozen=True)
class Section:
    """``name``: of its anchor; ``title``; ``body(run)``: what it shows; ``absent(run)``: in a sentence why it is left
    out, or None where it is shown."""

    name: str
    title: str
    body: Callable[[Run], Html]
    absent: Callable[[Run], str | None] = lambda run: None
