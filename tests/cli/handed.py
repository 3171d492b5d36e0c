"""What a command hands to its workflow, which does not run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from nerg_mi.workflows.base import COMMANDS


def keep_handed(monkeypatch, name: str) -> list[dict[str, Any]]:
    """The keywords of each call of the command ``name``, whose module is imported, but for the reporter."""
    handed: list[dict[str, Any]] = []

    def run(*, reporter, **values) -> None:
        handed.append(values)

    monkeypatch.setitem(COMMANDS, name, replace(COMMANDS[name], run=run))
    return handed
