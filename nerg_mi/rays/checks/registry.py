"""Which checks there are, and what all of them find."""

from __future__ import annotations

from .direction_checks import DIRECTION_CHECKS
from .figures import Figures
from .recording_checks import RECORDING_CHECKS

CHECKS = (*RECORDING_CHECKS, *DIRECTION_CHECKS)
"""What is looked for, in the order of the card."""


def find_warnings(figures: Figures) -> list[str]:
    """Sentences about what people cannot have produced, each with the likely mistake and its remedy: those of all
    `CHECKS`."""
    return [warning for check in CHECKS for warning in check.find(figures)]


def check_table() -> str:
    """The checks as a table in Markdown, for the manual."""
    rows = ["| check | looks for |", "|---|---|"]
    return "\n".join([*rows, *(f"| {check.name} | {check.looks_for} |" for check in CHECKS)]) + "\n"
